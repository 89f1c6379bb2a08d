"""`neeco export`: a scene as files that other viewers of Gaussians open.

In one state, as PLY or SPZ: viewers know neither joints nor lamps nor labels, so instruments stand still, and the light
is baked into the colours as one camera has it. Coordinates are those of the capture's world (mm), right, down and front
by the custom of PLY; in SPZ, whose axes are right, up and back, they are turned about x by 180 degrees, so that both
overlay.

A scene that moves, as binary glTF 2.0 with the extension KHR_gaussian_splatting, or as OpenUSD: one node (or prim) per
instrument, and below it one per part of each link, with which its Gaussians and their harmonics turn; the poses and
joints of a sequence of states are an animation (or time samples of transforms). Each part's Gaussians are rigid: those
that blend links follow the link of most weight from the first state on. Lamps and shadows are left out: light is baked
as one camera observes the first state, and the tissue stays in that.
"""

from __future__ import annotations

import gzip
import json
import math
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize
from zstandard import ZstdCompressor

from neeco.base.errors import NeecoError, install_hint
from neeco.base.files import write_atomically
from neeco.capture.model import Camera, InstrumentState, State
from neeco.capture.points import encoded_ply
from neeco.capture.readers import read_states
from neeco.evaluation.image_metrics import to_uint8
from neeco.geometry.rotations import matrix_to_quat, quat_multiply, quat_to_matrix, rotate_about, spread_directions
from neeco.raster import depth_maps
from neeco.raster.reference import SH_C0, brightened, headlight_factor, sh_basis
from neeco.raster.shadow import shadowed
from neeco.raster.types import Gaussians
from neeco.scene import GaussianScene
from neeco.scene.drawable import ArticulatedMotion

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


def ply_bytes(splats: Splats) -> bytes:
    """The file that 3D Gaussian splatting's own code writes (Kerbl et al. 2023), binary, little-endian."""
    count, coefficients = splats.sh.shape[:2]
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(count, -1)  # red's coefficients first, then green's, then blue's
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{k}" for k in range(3 * (coefficients - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    columns = [splats.means, np.zeros_like(splats.means), splats.sh[:, 0], rest, splats.logits[:, None]]
    table = np.concatenate([*columns, splats.log_scales, splats.quats], 1).astype("<f4")
    return encoded_ply(table.view([(name, "<f4") for name in names])[:, 0])


def spz_bytes(splats: Splats, version: Literal[3, 4] = 4) -> bytes:
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


EXTENSION, SCHEMA = "KHR_gaussian_splatting", "ParticleField3DGaussianSplat"  # of glTF, of OpenUSD
Unit = Literal["m", "cm", "mm"]
UNITS: Mapping[Unit, float] = {"m": 1e-3, "cm": 0.1, "mm": 1.0}  # of the file, per mm
COMPONENTS = {"float32": 5126, "uint8": 5121, "int16": 5122}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
TURN = np.array([0.0, 0.0, 1.0, 0.0])  # xyzw: 180 degrees about z, from the capture's axes to glTF's
CAMERA_TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))  # glTF's cameras look along -z


@dataclass(frozen=True, kw_only=True)
class MovingNode:
    """The tissue, an instrument, or a part of one of its links: rigid in itself."""

    name: str
    parent: int | None = None  # its number among the scene's nodes; None: the world
    poses: np.ndarray | None = None  # [T, 4, 4] parent_from_node in every state, mm; None: it stays in the world
    splats: Splats | None = None  # its Gaussians, in its own frame
    # of an instrument: joints, their limits, and the axes by which they move links; of a part: instrument, part, link
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class MovingScene:
    """A scene in a sequence of states."""

    nodes: tuple[MovingNode, ...]  # parents before their children
    times: np.ndarray  # [T] s, from 0 on; `frame_s` apart where the states have none that increase
    blended: float  # share of the instruments' Gaussians that blend links: right in the first state only
    frame_s: ClassVar[float] = 1 / 15  # between states without increasing times
    least_weight: ClassVar[float] = 0.9  # of a link, below which a Gaussian blends links
    meters_per_unit: ClassVar[float] = 0.001  # of OpenUSD's stage
    extent_sd: ClassVar[float] = 3.0  # standard deviations to which a Gaussian counts for the extent
    codes_per_second: ClassVar[float] = 1000.0  # time codes: states keep their times to the ms


def exported_states(scene: GaussianScene, first: State, states: Path | None) -> list[State]:
    """Return the states of a file, or those recorded for training in the order of their times, one of each instant
    that several cameras observe; `first` alone where no instrument moves, or a network moves all Gaussians."""
    if not scene.instruments or scene.motion() is None:
        return [first]
    if states is not None:
        return [line.state for line in read_states(states, scene.recorded.with_limits(scene.instruments))]
    recorded = sorted(scene.recorded.states, key=lambda state: state.time)
    instants = {state.time: state for state in recorded}
    return list(instants.values()) if len(instants) > 1 else recorded  # all equal: no times were recorded


@torch.no_grad()
def moving_scene(scene: GaussianScene, states: Sequence[State], camera: Camera) -> MovingScene:
    """Return the scene moving through `states`, lit as `camera` observes the first one; still where its method has no
    joints to move by. Raises NeecoError where its numbers are not finite."""
    motion = scene.motion()
    splats = splats_of(scene, states[0], camera, moving=motion is not None)
    times = np.array([float(state.time) for state in states])
    if not (np.diff(times) > 0).all():
        times = MovingScene.frame_s * np.arange(len(states))
    times = (times - times[0]).astype(np.float32)
    if motion is None:
        return MovingScene((MovingNode(name="tissue", splats=splats),), times, 0.0)
    tissue = local_splats(splats, np.arange(scene.canonical.counts[0]), np.eye(4))
    nodes, labels = [MovingNode(name="tissue", splats=tissue)], scene.label_channels().cpu().numpy()
    corrected = [scene.registered(state) for state in states]
    for number, instrument in enumerate(scene.instruments):
        rows = np.arange(len(scene.canonical))[scene.canonical.body(number + 1)]
        instrument_states = [state.instruments[instrument.name] for state in corrected]
        columns = [k for k, (name, _) in enumerate(scene.label_names) if name == instrument.name]
        links, body = motion.links[number][0].argmax(1).cpu().numpy(), len(nodes)
        bodies = np.stack([item.pose.double().cpu().numpy() for item in instrument_states])
        limits = {name: None if span is None else list(span) for name, span in instrument.joints.items()}
        amounts = motion.links[number][1]  # an axis turns or shifts a link by at_zero + per_unit * joint
        axes = [
            {
                "joint": axis.reading,
                "type": "prismatic" if axis.slides else "revolute",
                "pivot_mm": axis.pivot.tolist(),
                "axis": axis.axis.tolist(),
                "at_zero": amounts[:, k, 0].tolist(),
                "per_unit": amounts[:, k, 1].tolist(),
            }
            for k, axis in enumerate(motion.axes[number])
        ]
        joints = {name: {"limits": span} for name, span in limits.items()}
        facts: dict[str, Any] = {"instrument": instrument.name, "joints": joints, "axes": axes}
        nodes.append(MovingNode(name=instrument.name, poses=bodies, facts=facts))
        for link in np.unique(links).tolist():
            link_rows = rows[links == link]
            parts = labels[np.ix_(link_rows, columns)].argmax(1) if columns else np.zeros(len(link_rows), int)
            poses = np.stack([_link_pose(motion, number, link, item) for item in instrument_states])
            for part in np.unique(parts).tolist():
                name = scene.label_names[columns[part]][1] if columns else f"link {link}"
                local = local_splats(splats, link_rows[parts == part], bodies[0] @ poses[0])
                facts = {"instrument": instrument.name, "part": name, "link": link}
                nodes.append(MovingNode(name=name, parent=body, poses=poses, splats=local, facts=facts))
    blended = [weights.max(1).values < MovingScene.least_weight for weights, _ in motion.links]
    share = float(torch.cat(blended).float().mean()) if blended else 0.0
    return MovingScene(tuple(nodes), times, share)


def local_splats(splats: Splats, rows: np.ndarray, world_from_part: np.ndarray) -> Splats:
    """Return the Gaussians `rows` in the frame of a part at world_from_part [4, 4] mm; harmonics turn with it."""
    rotation, translation = world_from_part[:3, :3], world_from_part[:3, 3]
    back = matrix_to_quat(torch.from_numpy(rotation.T.copy())).expand(len(rows), 4)
    quats = quat_multiply(back, torch.from_numpy(splats.quats[rows]).double()).numpy().astype(np.float32)
    selected = {name: values[rows] for name, values in vars(splats).items()}
    means = ((selected["means"] - translation) @ rotation).astype(np.float32)
    return replace(Splats(**selected), means=means, quats=quats)


def _link_pose(motion: ArticulatedMotion, number: int, link: int, state: InstrumentState) -> np.ndarray:
    """Return instrument_from_link [4, 4] mm: all axes in their order, by this link's amounts."""
    points = torch.cat([torch.zeros(1, 3), torch.eye(3)]).double()
    for axis, amounts in zip(motion.axes[number], motion.links[number][1][link].double().cpu(), strict=True):
        moved = amounts[0] + amounts[1] * float(state.joints[axis.reading])
        direction, pivot = axis.axis.double().cpu(), axis.pivot.double().cpu()
        points = points + moved * direction if axis.slides else rotate_about(points, direction, pivot, moved.expand(4))
    pose = np.eye(4)
    pose[:3, 3] = points[0].numpy()
    pose[:3, :3] = (points[1:] - points[0]).T.numpy()
    return pose


@dataclass
class _Document:
    """JSON and binary chunk while they are put together."""

    content: dict[str, Any] = field(default_factory=lambda: {"accessors": [], "bufferViews": [], "meshes": []})
    nodes: list[dict[str, Any]] = field(default_factory=list)
    binary: bytearray = field(default_factory=bytearray)

    def add(self, values: np.ndarray, *, bounds: bool = False) -> int:
        """Return the number of an accessor of values [M, K] or [M], float32 or normalised integers."""
        values = np.ascontiguousarray(values)
        views, accessors = self.content["bufferViews"], self.content["accessors"]
        views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": values.nbytes})
        self.binary += values.tobytes() + bytes(-values.nbytes % 4)
        accessor = {
            "bufferView": len(views) - 1,
            "componentType": COMPONENTS[str(values.dtype)],
            "count": len(values),
            "type": TYPES[1 if values.ndim == 1 else values.shape[1]],
        }
        if values.dtype != np.float32:
            accessor["normalized"] = True
        if bounds:
            rows = values.reshape(len(values), -1)
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        accessors.append(accessor)
        return len(accessors) - 1

    def node(self, name: str, parent: int | None = None, **fields: Any) -> int:
        """Return the number of a new node."""
        self.nodes.append({"name": name} | fields)
        if parent is not None:
            self.nodes[parent].setdefault("children", []).append(len(self.nodes) - 1)
        return len(self.nodes) - 1


def write_glb(scene: MovingScene, camera: Camera, path: Path, unit: Unit = "m") -> None:
    """Write the scene and its camera as glTF, lengths in `unit`: the root turns the capture's world (right, down,
    front) by 180 degrees about z to glTF's axes. Raises NeecoError where the disk refuses."""
    document, per_mm = _Document(), UNITS[unit]
    root = document.node("neeco", rotation=TURN.tolist())
    clock: int | None = None
    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []
    for item in scene.nodes:  # numbered from 1 on in the file
        parent = root if item.parent is None else item.parent + 1
        node = document.node(item.name, parent, **({"extras": item.facts} if item.facts else {}))
        if item.poses is not None:  # the first at rest, all of them as an animation
            if clock is None and len(scene.times) > 1:
                clock = document.add(scene.times, bounds=True)
            rotations, places = _rotations(item.poses), (item.poses[:, :3, 3] * per_mm).astype(np.float32)
            document.nodes[node] |= {"rotation": rotations[0].tolist(), "translation": places[0].tolist()}
            for target, values in (("rotation", rotations), ("translation", places)):
                if clock is not None and np.ptp(values, axis=0).max() > 0:
                    samplers.append({"input": clock, "output": document.add(values), "interpolation": "LINEAR"})
                    channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": target}})
        if (splats := item.splats) is not None:  # in the node's frame
            colors = np.concatenate([splats.sh[:, 0] * SH_C0 + 0.5, splats.opacities[:, None]], 1)
            columns = {"SCALE": np.exp(splats.log_scales) * per_mm, "OPACITY": splats.opacities}
            for degree in range(splats.degree + 1):
                for order in range(2 * degree + 1):
                    columns[f"SH_DEGREE_{degree}_COEF_{order}"] = splats.sh[:, degree**2 + order]
            attributes = {"POSITION": document.add((splats.means * per_mm).astype(np.float32), bounds=True)}
            attributes["COLOR_0"] = document.add(to_uint8(255 * colors))
            turned = np.rint(splats.quats[:, [1, 2, 3, 0]] * np.iinfo(np.int16).max).astype(np.int16)  # to 0.002 deg
            attributes[f"{EXTENSION}:ROTATION"] = document.add(turned)
            attributes |= {f"{EXTENSION}:{name}": document.add(v.astype(np.float32)) for name, v in columns.items()}
            settings = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
            primitive = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: settings}}
            meshes = document.content["meshes"]
            meshes.append({"name": item.name, "primitives": [primitive]})
            document.nodes[node]["mesh"] = len(meshes) - 1
    pose = camera.world_from_camera.double().cpu()
    lens = {
        "yfov": 2 * math.atan(camera.height / (2 * camera.fy)),
        "aspectRatio": camera.width * camera.fy / (camera.height * camera.fx),
        "znear": per_mm,  # 1 mm
    }
    document.content["cameras"] = [{"name": "laparoscope", "type": "perspective", "perspective": lens}]
    rotation = _rotations((pose[:3, :3] @ CAMERA_TURN).numpy()[None])
    place = (pose[:3, 3] * per_mm).tolist()
    # glTF cannot state a principal point off the image's centre
    document.node("laparoscope", root, camera=0, rotation=rotation[0].tolist(), translation=place)
    document.content |= {"asset": {"version": "2.0", "generator": "neeco"}, "extensionsUsed": [EXTENSION]}
    document.content |= {"scene": 0, "scenes": [{"nodes": [root]}]}
    if channels:
        document.content["animations"] = [{"name": "states", "channels": channels, "samplers": samplers}]
    document.content["buffers"] = [{"byteLength": len(document.binary)}]
    text = json.dumps(document.content | {"nodes": document.nodes}, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(document.binary)
    chunks = struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(document.binary), b"BIN\0")
    data = struct.pack("<4sII", b"glTF", 2, size) + b"".join(chunks) + document.binary
    write_atomically(path, lambda temporary: temporary.write_bytes(data))


def _rotations(poses: np.ndarray) -> np.ndarray:
    """Return quaternions [T, 4] xyzw float32 of poses [T, 4, 4] or rotations [T, 3, 3], each nearer to the one before
    than its negative."""
    quats = matrix_to_quat(torch.from_numpy(np.ascontiguousarray(poses[:, :3, :3]))).numpy()[:, [1, 2, 3, 0]]
    for k in range(1, len(quats)):
        if quats[k] @ quats[k - 1] < 0:
            quats[k] = -quats[k]
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


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
    """Write a binary file, .usdc. The stage has y up and the capture's mm; its default prim turns the world (right,
    down, front) by 180 degrees about x. Schema: OpenUSD 26.03 and newer,
    openusd.org/release/api/class_usd_vol_particle_field3_d_gaussian_splat.html

    Raises NeecoError where OpenUSD is missing or too old, or the disk refuses."""
    require_usd()
    from pxr import Gf, Tf, Usd, UsdGeom, UsdSemantics, UsdVol, Vt

    codes = scene.times * scene.codes_per_second
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, scene.meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetTimeCodesPerSecond(scene.codes_per_second)
    stage.SetStartTimeCode(float(codes[0]))
    stage.SetEndTimeCode(float(codes[-1]))
    root = UsdGeom.Xform.Define(stage, "/Scene")
    root.AddRotateXOp().Set(180.0)
    stage.SetDefaultPrim(root.GetPrim())
    places: list[str] = []
    for node in scene.nodes:
        name = re.sub(r"^(\d)|\W", r"_\1", node.name)  # a prim's name
        place = f"{root.GetPath() if node.parent is None else places[node.parent]}/{name}"
        places.append(f"{place}_{node.facts['link']}" if stage.GetPrimAtPath(place) and "link" in node.facts else place)
        if node.splats is None:
            prim = UsdGeom.Xform.Define(stage, places[-1])
            prim.GetPrim().SetCustomDataByKey("neeco:instrument", node.name)
        else:
            splats = node.splats  # in its own frame
            prim = getattr(UsdVol, SCHEMA).Define(stage, places[-1])
            scales = np.exp(splats.log_scales)
            reach = scene.extent_sd * scales.max(1, keepdims=True)
            extent = np.stack([(splats.means - reach).min(0), (splats.means + reach).max(0)])
            quats = np.ascontiguousarray(splats.quats[:, [1, 2, 3, 0]])  # w last
            coefficients = np.ascontiguousarray(splats.sh.reshape(-1, 3))
            prim.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(splats.means))
            prim.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(quats))
            prim.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
            prim.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(splats.opacities))
            prim.CreateRadianceSphericalHarmonicsDegreeAttr(splats.degree)
            prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(coefficients))
            prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
            UsdSemantics.LabelsAPI.Apply(prim.GetPrim(), "class").CreateLabelsAttr([node.name])
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
