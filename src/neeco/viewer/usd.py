"""Gaussians as an OpenUSD file: one prim of schema ParticleField3DGaussianSplat (UsdVol, OpenUSD 26.03 and newer).

https://openusd.org/release/api/class_usd_vol_particle_field3_d_gaussian_splat.html. Scales are standard deviations,
opacities shares; harmonics are those of PLY, a particle's coefficients together. The stage counts mm.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neeco.errors import NeecoError, install_hint
from neeco.files import write_atomically
from neeco.viewer.splats import Splats

SCHEMA = "ParticleField3DGaussianSplat"
PRIM = "/Scene"
METERS_PER_UNIT = 0.001
EXTENT_SD = 3.0  # standard deviations to which a Gaussian counts for the stage's extent


def require_usd() -> None:
    """Raise NeecoError where OpenUSD is missing, or older than the schema."""
    try:
        from pxr import Usd, UsdVol
    except ImportError:
        raise NeecoError(f"--format: usdc needs usd-core; {install_hint('usd')}") from None
    if not hasattr(UsdVol, SCHEMA):
        version = ".".join(map(str, Usd.GetVersion()[1:]))
        raise NeecoError(f"--format: usdc needs OpenUSD 26.03 or newer, this is {version}; {install_hint('usd')}")


def write_usd(splats: Splats, path: Path) -> None:
    """Write a binary file, .usdc. Raises NeecoError where OpenUSD is missing or too old, or the disk refuses."""
    require_usd()
    from pxr import Sdf, Tf, Usd, UsdGeom, UsdVol, Vt

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, METERS_PER_UNIT)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, Sdf.Path(PRIM))
    stage.SetDefaultPrim(field.GetPrim())
    scales = np.exp(splats.log_scales)
    reach = EXTENT_SD * scales.max(1, keepdims=True)
    extent = np.stack([(splats.means - reach).min(0), (splats.means + reach).max(0)])
    degree = int(splats.sh.shape[1] ** 0.5) - 1
    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(splats.means))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(splats.quats[:, [1, 2, 3, 0]]))  # stored with w last
    field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(1 / (1 + np.exp(-splats.logits))))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(degree)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(splats.sh.reshape(-1, 3)))
    field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))

    def write(temporary: Path) -> None:
        try:
            stage.GetRootLayer().Export(str(temporary))
        except Tf.ErrorException as error:
            raise OSError(f"OpenUSD: {str(error).splitlines()[-1]}") from error

    write_atomically(path, write)
