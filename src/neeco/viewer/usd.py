"""`neeco export --format usdc`: a scene that moves, as OpenUSD: an Xform for every instrument, and below it, for every
part of a link, a ParticleField3DGaussianSplat with time samples of its transform (`neeco.viewer.moving`).

The stage has y up and the capture's mm; its default prim turns the world (right, down, front) by 180 degrees about x.
Schema: OpenUSD 26.03 and newer, openusd.org/release/api/class_usd_vol_particle_field3_d_gaussian_splat.html
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError, install_hint
from neeco.base.files import write_atomically
from neeco.viewer.moving import MovingScene
from neeco.viewer.splats import Splats

SCHEMA = "ParticleField3DGaussianSplat"
PRIM = "/Scene"


@dataclass(frozen=True, kw_only=True)
class UsdSettings:
    """Settings of the stage."""

    meters_per_unit: float = 0.001
    extent_sd: float = 3.0  # standard deviations to which a Gaussian counts for the extent
    codes_per_second: float = 1000.0  # time codes: states keep their times to the ms


USD = UsdSettings()


def require_usd() -> None:
    """Raise NeecoError where OpenUSD is missing, or older than the schema."""
    try:
        from pxr import Usd, UsdVol
    except ImportError:
        raise NeecoError(f"--format: usdc needs usd-core; {install_hint('usd')}") from None
    if not hasattr(UsdVol, SCHEMA):
        version = ".".join(map(str, Usd.GetVersion()[1:]))
        raise NeecoError(f"--format: usdc needs OpenUSD 26.03 or newer, this is {version}; {install_hint('usd')}")


def write_usd(scene: MovingScene, path: Path) -> None:
    """Write a binary file, .usdc. Raises NeecoError where OpenUSD is missing or too old, or the disk refuses."""
    require_usd()
    from pxr import Gf, Tf, Usd, UsdGeom

    codes = scene.times * USD.codes_per_second
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, USD.meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetTimeCodesPerSecond(USD.codes_per_second)
    stage.SetStartTimeCode(float(codes[0]))
    stage.SetEndTimeCode(float(codes[-1]))
    root = UsdGeom.Xform.Define(stage, PRIM)
    root.AddRotateXOp().Set(180.0)
    stage.SetDefaultPrim(root.GetPrim())
    places: list[str] = []
    for node in scene.nodes:
        name = re.sub(r"^(\d)|\W", r"_\1", node.name)  # a prim's name
        place = f"{PRIM if node.parent is None else places[node.parent]}/{name}"
        places.append(f"{place}_{node.facts['link']}" if stage.GetPrimAtPath(place) and "link" in node.facts else place)
        if node.splats is None:
            prim = UsdGeom.Xform.Define(stage, places[-1])
            prim.GetPrim().SetCustomDataByKey("neeco:instrument", node.name)
        else:
            prim = _define_field(stage, places[-1], node.splats, node.name)
        if node.poses is not None:
            operation = prim.AddTransformOp()
            matrices = [Gf.Matrix4d(*pose.T.ravel().tolist()) for pose in node.poses]  # USD multiplies rows
            if np.ptp(node.poses, axis=0).max() == 0:
                operation.Set(matrices[0])
            else:
                for code, matrix in zip(codes.tolist(), matrices, strict=True):
                    operation.Set(matrix, code)

    def write(temporary: Path) -> None:
        try:
            stage.GetRootLayer().Export(str(temporary))
        except Tf.ErrorException as error:
            raise OSError(f"OpenUSD: {str(error).splitlines()[-1]}") from error

    write_atomically(path, write)


def _define_field(stage: Any, path: str, splats: Splats, label: str) -> Any:
    """Return a new prim with these Gaussians in its own frame, of the semantic class `label`."""
    from pxr import UsdSemantics, UsdVol, Vt

    field = getattr(UsdVol, SCHEMA).Define(stage, path)
    scales = np.exp(splats.log_scales)
    reach = USD.extent_sd * scales.max(1, keepdims=True)
    extent = np.stack([(splats.means - reach).min(0), (splats.means + reach).max(0)])
    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(splats.means))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(np.ascontiguousarray(splats.quats[:, [1, 2, 3, 0]])))  # w last
    field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(splats.opacities))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(splats.degree)
    coefficients = np.ascontiguousarray(splats.sh.reshape(-1, 3))
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(coefficients))
    field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
    UsdSemantics.LabelsAPI.Apply(field.GetPrim(), "class").CreateLabelsAttr([label])
    return field
