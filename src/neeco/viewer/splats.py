"""`neeco export`: a scene in one state, as files that other viewers of Gaussians open.

They know neither joints nor lamps nor labels: instruments stand still, and the light is baked into the colours as one
camera has it. Coordinates are those of the capture's world (mm), right, down and front by the custom of PLY; in SPZ,
whose axes are right, up and back, they are turned about x by 180 degrees, so that both overlay.
"""

from __future__ import annotations

import gzip
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize
from zstandard import ZstdCompressor

from neeco.base.errors import NeecoError
from neeco.base.files import write_atomically
from neeco.capture.model import Camera, State
from neeco.capture.readers import read_states
from neeco.evaluation.image_metrics import to_uint8
from neeco.geometry.rotations import quat_to_matrix, spread_directions
from neeco.raster import depth_maps
from neeco.raster.reference import brightened, headlight_factor, sh_basis
from neeco.raster.shadow import shadowed
from neeco.raster.types import Gaussians
from neeco.scene import GaussianScene

Format = Literal["ply", "spz"]
SpzVersion = Literal[3, 4]
DIRECTIONS = 64  # by which harmonics are rotated: four times as many as there are harmonics
MIN_SCALE = 1e-30  # mm: the logarithm of 0 is no number of a file
SPZ_MAGIC = 0x5053474E
SPZ_FRACTION = 12  # bits of a mm: positions reach 2 m
SPZ_COLOR = 0.15  # of the first harmonic, per unit of what is stored
# signs of harmonics whose y and z are negated, by degree and order
SPZ_TURNED = [(-1) ** (degree + order + (order < 0)) for degree in range(4) for order in range(-degree, degree + 1)]
SPZ_STEPS = (8, 16, 16)  # of 256, by which harmonics of degree 1, 2 and 3 are rounded
SPZ_ROTATION = 511  # steps of a component of a rotation, up to 2 ** -0.5


@dataclass(frozen=True)
class Splats:
    """Gaussians as other programs know them, float32."""

    means: np.ndarray  # [N, 3] mm
    quats: np.ndarray  # [N, 4] wxyz, unit
    log_scales: np.ndarray  # [N, 3]
    logits: np.ndarray  # [N] of the opacities
    sh: np.ndarray  # [N, K, 3], world frame

    @property
    def opacities(self) -> np.ndarray:
        """Return the opacities [N] in (0, 1)."""
        return 1 / (1 + np.exp(-self.logits))

    @property
    def degree(self) -> int:
        """Return the degree of the harmonics."""
        return int(self.sh.shape[1] ** 0.5) - 1


def exported_state(scene: GaussianScene, frame: int, states: Path | None) -> tuple[State, Camera]:
    """State and camera of a frame trained on; of the first line of a file of states where that is given, whose camera
    is the frame's unless it names one. Raises NeecoError for a file that does not fit."""
    state, camera = scene.recorded.states[frame], scene.recorded.cameras[frame]
    if states is None:
        return state, camera
    instruments = scene.recorded.with_limits(scene.instruments)
    line = read_states(states, instruments)[0]
    if line.world_from_camera is not None:
        camera = replace(camera, world_from_camera=torch.from_numpy(line.world_from_camera))
    return line.state, camera


@torch.no_grad()
def splats_of(scene: GaussianScene, state: State, camera: Camera, *, moving: bool = False) -> Splats:
    """The scene in `state`, lit as `camera` has it; moving: without shadows, harmonics in the frames of their parts."""
    posed = scene.at(state) if moving else shadowed(scene.at(state), camera, depth_maps)
    sh = posed.sh if moving else _in_world(posed)
    if posed.headlight is not None:
        view = camera.world_from_camera.to(posed.means)
        in_camera = (posed.means - view[:3, 3]) @ view[:3, :3]
        sh = brightened(sh, headlight_factor(posed.headlight, camera, in_camera)[:, None, None])
    opacities = posed.opacities.clamp(1e-6, 1 - 1e-6)
    scales = posed.scales.clamp_min(MIN_SCALE).log()
    tensors = (posed.means, normalize(posed.quats, dim=1), scales, torch.logit(opacities), sh)
    if not all(bool(tensor.isfinite().all()) for tensor in tensors):
        raise NeecoError("the scene's Gaussians are not finite in this state; give another state, or train again")
    return Splats(*(tensor.float().cpu().numpy() for tensor in tensors))


def write_splats(splats: Splats, path: Path, format: Format, spz_version: SpzVersion = 4) -> None:
    """Write a file of that format. Raises NeecoError where the format cannot hold them, or the disk refuses."""
    data = ply_bytes(splats) if format == "ply" else spz_bytes(splats, spz_version)
    write_atomically(path, lambda temporary: temporary.write_bytes(data))


def ply_bytes(splats: Splats) -> bytes:
    """The file that 3D Gaussian splatting's own code writes (Kerbl et al. 2023), binary, little-endian."""
    count, coefficients = splats.sh.shape[:2]
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(count, -1)  # red's coefficients first, then green's, then blue's
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{k}" for k in range(3 * (coefficients - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    columns = [splats.means, np.zeros_like(splats.means), splats.sh[:, 0], rest, splats.logits[:, None]]
    table = np.concatenate([*columns, splats.log_scales, splats.quats], 1).astype("<f4")
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [*(f"property float {name}" for name in names), "end_header", ""]
    return "\n".join(lines).encode() + table.tobytes()


def spz_bytes(splats: Splats, version: SpzVersion = 4) -> bytes:
    """Niantic's SPZ: about a tenth of the size of PLY; version 4 is compressed by Zstandard, 3 by gzip. Raises
    NeecoError where positions leave its range."""
    turn = np.array([1, -1, -1], np.float32)
    sh = splats.sh * np.array(SPZ_TURNED[: splats.sh.shape[1]], np.float32)[:, None]
    splats = replace(splats, means=splats.means * turn, quats=splats.quats * np.append(1, turn), sh=sh)
    fixed = np.rint(splats.means.astype(np.float64) * 2**SPZ_FRACTION).astype(np.int64)
    if fixed.size and np.abs(fixed).max() >= 2**23:
        raise NeecoError("--format: spz holds positions within 2 m of the world's origin only; use ply")
    steps = np.repeat(SPZ_STEPS, (3, 5, 7))[: sh.shape[1] - 1, None]
    columns = (
        (fixed & 0xFFFFFF).astype("<u4")[..., None].view(np.uint8)[..., :3],
        to_uint8(255 / (1 + np.exp(-splats.logits.astype(np.float64)))),
        to_uint8(splats.sh[:, 0] * (SPZ_COLOR * 255) + 127.5),
        to_uint8((splats.log_scales + 10) * 16),
        _smallest_three(splats.quats),
        np.clip((np.rint(sh[:, 1:] * 128) + 128 + steps // 2) // steps * steps, 0, 255).astype(np.uint8),
    )
    streams = [np.ascontiguousarray(column).tobytes() for column in columns if column.size]
    header = struct.pack("<IIIBB", SPZ_MAGIC, version, len(splats.means), splats.degree, SPZ_FRACTION)
    if version == 3:
        return gzip.compress(b"".join([header, bytes(2), *streams]), mtime=0)
    packed = [ZstdCompressor(level=19).compress(stream) for stream in streams]
    sizes = [struct.pack("<QQ", len(part), len(stream)) for part, stream in zip(packed, streams, strict=True)]
    return b"".join([header, struct.pack("<BBI12x", 0, len(streams), 32), *sizes, *packed])


def _smallest_three(quats: np.ndarray) -> np.ndarray:
    """Rotations uint32 [N] of quaternions [N, 4] wxyz: the place of the component of largest size (2 bits; x, y, z, w),
    which is taken as positive and left out, and of the others sign and size (10 bits each)."""
    xyzw = np.roll(quats.astype(np.float64), -1, axis=1)
    largest = np.abs(xyzw).argmax(1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    sizes = np.rint(np.abs(xyzw) * (SPZ_ROTATION * np.sqrt(2))).clip(0, SPZ_ROTATION).astype(np.uint32)
    packed = largest.astype(np.uint32)
    for place in range(4):
        component = (xyzw[:, place] < 0).astype(np.uint32) << 9 | sizes[:, place]
        packed = np.where(place == largest, packed, packed << 10 | component)
    return packed.astype("<u4")


def _in_world(posed: Gaussians) -> Tensor:
    """[N, K, 3] harmonics rotated out of the frames of their parts: a least-squares fit over DIRECTIONS directions."""
    count = posed.sh.shape[1]
    if posed.sh_frames is None or count == 1:
        return posed.sh
    directions = spread_directions(DIRECTIONS).to(posed.sh)  # [D, 3]
    back = torch.linalg.pinv(sh_basis(directions, count))  # [K, D]
    frames, which = torch.unique(posed.sh_frames, dim=0, return_inverse=True)  # most are constant and equal
    local = torch.einsum("fij,di->fdj", quat_to_matrix(frames), directions)  # [F, D, 3]
    turned = back @ sh_basis(local.reshape(-1, 3), count).reshape(*local.shape[:2], count)  # [F, K, K]
    return torch.einsum("nkl,nlc->nkc", turned[which], posed.sh)
