"""Images stabilised along an instrument's shaft, and its cylindrical part unrolled about its axis.

The instrument's frame: z along the shaft towards the tip, the origin where the shaft ends and the wrist begins. In
every frame two unit vectors across the shaft belong to the view: `towards` the camera, and `across` = z x towards. Roll
is the angle about z from `towards` to the instrument's x axis; at roll 0 that points at the camera.

Textures of the unrolled part, compared between pairs of frames, tell how far the instrument rolled from one to the
other; silhouettes beyond the wrist, their widths and which of them are similar, tell of joints. Both are kept in the
capture: solving again then takes seconds.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file

from neeco.base.errors import NeecoError
from neeco.base.files import require_content, require_like, write_atomically
from neeco.capture.images import open_image
from neeco.capture.model import Capture, Instrument
from neeco.geometry.lines import unit
from neeco.geometry.projection import project


@dataclass(frozen=True, kw_only=True)
class TextureSettings:
    """Settings of unrolled textures and of their comparison.

    Frames closer than those of `near_frames` rotate by less than a column, and residual shading biases the peak to 0
    (gains of 0.3 to 0.6 against the truth at 1 to 3 frames, about 1 from 5 on).
    """

    column_rad: float = math.radians(3.0)  # spacing of columns of the unrolled texture
    max_azimuth: float = math.radians(63.0)  # maximum azimuth from the view; beyond, the surface is too oblique
    row_mm: float = 0.3  # spacing of rows
    band: tuple[float, float] = (-0.1, 0.4)  # of the working length, from the origin: beyond it jaws move independently
    max_columns: int = 20  # maximum relative shift of two textures, which then overlap by half
    max_rows: int = 4  # maximum shift along the shaft, whose end is known to 0.5 mm
    row_step: int = 2  # step of these shifts
    min_visible: float = 0.9  # minimum share of a texture in the image
    max_contrast: float = 0.8  # maximum contrast of logarithmic colour: a glint is clipped
    shading_frames: float = 15.0  # standard deviation of the window over which shading is averaged
    min_score: float = 0.3  # minimum correlation of a hypothesis
    max_hypotheses: int = 3  # maximum number of hypotheses per pair
    near_frames: tuple[int, ...] = (5, 6, 8, 10, 12, 15, 20, 30, 60)  # frame distances that are always compared
    far_frames: int = 20  # distance beyond which similar frames are compared, to bound drift
    far_pairs: int = 8  # number of these per frame
    block: int = 256  # number of frames compared with all others at a time
    nearest_mm: float = 1.0  # minimum depth in front of the camera


SETTINGS = TextureSettings()

FILE, FORMAT = "from_video.safetensors", "neeco-from-video/1"  # what is kept in a capture
JAWS = "jaw_angle"  # name of a joint that nothing logged
Load = Callable[[int], np.ndarray]  # frame's index -> image uint8 [H, W, 3]


@dataclass(frozen=True, eq=False)
class Shafts:
    """Poses of an instrument's shaft in every frame, in the camera's axes (OpenCV)."""

    origins: np.ndarray  # [F, 3] mm, on the axis where the shaft ends
    directions: np.ndarray  # [F, 3] unit, towards the tip
    world_from_camera: np.ndarray  # [F, 3, 3] rotations
    intrinsics: np.ndarray  # [F, 4] fx, fy, cx, cy, px
    diameter_mm: float
    working_length_mm: float

    def __len__(self) -> int:
        return len(self.origins)

    @classmethod
    def of(cls, capture: Capture, instrument: Instrument) -> Shafts:
        """Return the shafts of an instrument found in the video. Raises NeecoError for another, or without poses in
        every frame."""
        shaft_video = instrument.from_video
        if shaft_video is None:
            raise NeecoError(
                f"{capture.root}: instrument {instrument.name}: was not found in the video, its poses are known; "
                "give a capture made by `neeco ingest --shaft-diameter`"
            )
        if any(instrument.name not in frame.state.instruments for frame in capture.frames):
            raise NeecoError(f"{capture.root}: frames: {instrument.name} has no pose in some; leave those frames out")
        cameras = [frame.camera for frame in capture.frames]
        world_from_camera = np.stack([camera.world_from_camera.double().cpu().numpy() for camera in cameras])
        pose = np.stack([frame.state.instruments[instrument.name].pose.cpu().numpy() for frame in capture.frames])
        camera_from_instrument = np.linalg.inv(world_from_camera) @ pose
        return cls(
            camera_from_instrument[:, :3, 3],
            camera_from_instrument[:, :3, 2],
            world_from_camera[:, :3, :3],
            np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras], np.float64),
            shaft_video.shaft_diameter_mm,
            shaft_video.working_length_mm,
        )

    @cached_property
    def view_axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors `towards` the camera and `across` [F, 3], both orthogonal to the shaft, in the camera's axes."""
        across = np.cross(self.directions, -self.origins)
        across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
        return np.cross(across, self.directions), across

    def rotation(self, frame: int, roll: float) -> np.ndarray:
        """world_from_instrument [3, 3] of one frame at a roll, rad."""
        towards, across = (axis[frame] for axis in self.view_axes)
        z, x = unit(self.directions[frame]), np.cos(roll) * towards + np.sin(roll) * across
        x = unit(x - (x @ z) * z)
        return np.asarray(self.world_from_camera[frame] @ np.stack([x, np.cross(z, x), z], -1))

    def carried(self) -> np.ndarray:
        """Changes [F - 1] rad of the roll from each frame to the next under parallel transport in the world: the view's
        share in a roll's change."""
        towards, across = (np.einsum("fij,fj->fi", self.world_from_camera, axis) for axis in self.view_axes)
        directions = np.einsum("fij,fj->fi", self.world_from_camera, self.directions)
        before, after, moved = directions[:-1], directions[1:], towards[:-1]
        normal = np.cross(before, after)
        # Rodrigues' formula with sine and cosine given by the two directions
        cosine = (before * after).sum(-1, keepdims=True)
        inner = (normal * moved).sum(-1, keepdims=True)
        moved = cosine * moved + np.cross(normal, moved) + normal * inner / np.maximum(1 + cosine, 1e-9)
        return np.arctan2((moved * across[1:]).sum(-1), (moved * towards[1:]).sum(-1))

    def sample(self, frame: int, image: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Sample an image [H, W(, C)] where points [A, B, 3] mm in the camera's axes of a frame are observed:
        [A, B(, C)], black outside the image and behind the camera."""
        fx, fy, cx, cy = self.intrinsics[frame]
        pixels = np.stack(project(points, fx, fy, cx, cy, nearest=SETTINGS.nearest_mm), -1)
        places = (np.where(points[..., 2:] < SETTINGS.nearest_mm, -1e4, pixels) - 0.5).astype(np.float32)
        return np.asarray(
            cv2.remap(image, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        )


def crop(shafts: Shafts, frame: int, image: np.ndarray, along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Sample an image [H, W(, C)] in the plane through the shaft that faces the camera: [A, B(, C)] at `along` [A] mm
    from the origin towards the tip and `across` [B] mm."""
    middle = shafts.origins[frame] + along[:, None, None] * shafts.directions[frame]
    return shafts.sample(frame, image, middle + across[None, :, None] * shafts.view_axes[1][frame])


@dataclass(frozen=True, eq=False)
class RollPairs:
    """Frames first, second [P], and hypotheses of the roll from one to the other: `turns` [P, H] rad with correlations
    `scores` [P, H], best first; unused ones have score 0."""

    first: np.ndarray
    second: np.ndarray
    turns: np.ndarray
    scores: np.ndarray


def unrolled_textures(shafts: Shafts, load: Load) -> tuple[np.ndarray, np.ndarray]:
    """Return textures [F, A, B, C] float32 without the view's shading, and which frames [F] show enough of theirs."""
    along = np.arange(
        SETTINGS.band[0] * shafts.working_length_mm, SETTINGS.band[1] * shafts.working_length_mm, SETTINGS.row_mm
    )
    azimuths = np.arange(-SETTINGS.max_azimuth, SETTINGS.max_azimuth + 0.01, SETTINGS.column_rad)
    visible = np.empty(len(shafts), bool)
    textures = np.empty((len(shafts), len(along), len(azimuths), 3), np.float32)
    for frame, (towards, sideways) in enumerate(zip(*shafts.view_axes, strict=True)):
        radial = np.cos(azimuths)[:, None] * towards + np.sin(azimuths)[:, None] * sideways
        middle = shafts.origins[frame] + along[:, None, None] * shafts.directions[frame]
        pixels = shafts.sample(frame, load(frame), middle + shafts.diameter_mm / 2 * radial)
        visible[frame] = (pixels.max(-1) > 0).mean() > SETTINGS.min_visible
        textures[frame] = np.log(pixels.astype(np.float32) + 10)
    textures -= np.median(textures, axis=(1, 2), keepdims=True)
    if visible.any():  # the temporal mean, over which the instrument has rotated, is the view's shading
        frames = np.arange(len(textures))
        weights = np.exp(-0.5 * ((frames[:, None] - frames) / SETTINGS.shading_frames) ** 2) * visible
        weights += 1e-3 * visible  # a frame without neighbours: the mean over the whole video
        flat = textures.reshape(len(textures), -1)
        flat -= (weights / weights.sum(1, keepdims=True)).astype(np.float32) @ flat
    np.clip(textures, -SETTINGS.max_contrast, SETTINGS.max_contrast, out=textures)
    for texture in textures:
        cv2.GaussianBlur(texture, (0, 0), 0.8, dst=texture)
        # light from elsewhere varies slowly across the shaft
        texture -= cv2.blur(texture, (15, 1), borderType=cv2.BORDER_REPLICATE)
    return textures, visible


def _normalised(textures: np.ndarray) -> np.ndarray:
    flat = textures.reshape(len(textures), -1)
    flat = flat - flat.mean(1, keepdims=True)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6))


def roll_pairs(textures: np.ndarray, visible: np.ndarray) -> RollPairs:
    """Compare frames close in time, and every frame with the most similar distant ones; only `visible` ones."""
    blocks = []
    height, width = textures.shape[1:3]
    for start in range(0, len(textures), SETTINGS.block):
        # the normalised cross-correlation [R, F, 2 M + 1] with this frame and those after it, as pairs are counted
        # once; at [i, j, M + q] for a shift by q columns, and the best shift within `max_rows` rows
        others, some = textures[start:], textures[start : start + SETTINGS.block]
        scores = np.full((len(some), len(others), 2 * SETTINGS.max_columns + 1), -1.0, np.float32)
        for down in range(-SETTINGS.max_rows, SETTINGS.max_rows + 1, SETTINGS.row_step):
            upper, lower = slice(max(-down, 0), height - max(down, 0)), slice(max(down, 0), height - max(-down, 0))
            for shift in range(-SETTINGS.max_columns, SETTINGS.max_columns + 1):
                left, right = slice(max(-shift, 0), width - max(shift, 0)), slice(max(shift, 0), width - max(-shift, 0))
                correlation = _normalised(some[:, upper, left]) @ _normalised(others[:, lower, right]).T
                best = scores[:, :, SETTINGS.max_columns + shift]
                np.maximum(best, correlation, out=best)
        best, later = scores.max(-1), visible[start:]
        apart = np.arange(best.shape[1]) - np.arange(best.shape[0])[:, None]
        both = later & later[: len(best), None]
        far = np.where((apart > SETTINGS.far_frames) & both, best, -1.0)
        similar = np.argsort(-far, axis=1, kind="stable")[:, : SETTINGS.far_pairs]
        chosen = np.isin(apart, SETTINGS.near_frames)
        np.put_along_axis(chosen, similar, True, axis=1)
        first, second = np.nonzero(chosen & both & (apart > 0))
        # the highest local maxima of correlations over the shift, at subcolumn precision
        before, middle, after = (scores[first, second, low : low - 2 or None] for low in (0, 1, 2))
        ranked = np.where((middle >= before) & (middle > after), middle, 0.0)
        order = np.argsort(-ranked, axis=1, kind="stable")[:, : SETTINGS.max_hypotheses]
        a, b, c = (np.take_along_axis(values, order, 1) for values in (before, middle, after))
        fraction = 0.5 * (a - c) / np.minimum(a - 2 * b + c, -1e-6)
        turns = (order + 1 - SETTINGS.max_columns + np.clip(fraction, -0.5, 0.5)) * SETTINGS.column_rad
        peaks = np.maximum(np.take_along_axis(ranked, order, 1), 0.0)
        good = peaks[:, 0] >= SETTINGS.min_score
        blocks.append((first[good] + start, second[good] + start, turns[good], peaks[good]))
    return RollPairs(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))


@dataclass(frozen=True, kw_only=True)
class MeasurementSettings:
    """Measures of silhouettes beyond the wrist."""

    min_opening: float = 0.5  # minimum change of the silhouettes' width of jaws, share of the shaft's diameter
    step_mm: float = 0.5  # size of a pixel of stabilised silhouettes
    along: tuple[float, float] = (0.3, 1.2)  # range of the working length, from the origin: beyond the wrist
    across: float = 0.8  # range to either side, share of the working length
    max_distance_mm: float = 1.5  # maximum distance from an outline, at which distances saturate
    width_rank: int = 3  # rank of the cross section by width that counts: the first may be a glint on the tissue
    blur_mm: float = 1.0  # standard deviation of the silhouettes' blur
    median_frames: int = 5  # frames of a median outline: glints on the tissue stay behind when the instrument moves on
    n_components: int = 24  # number of principal components


SILHOUETTE = MeasurementSettings()


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements of one instrument: pairs of frames with turns between them; widths [F] mm of the silhouettes beyond
    the wrist, across the shaft; shapes [F, C]: principal components of the stabilised outlines, mm; frames [F] that
    show its wrist; and the joints that nothing logged."""

    pairs: RollPairs
    widths: np.ndarray
    shapes: np.ndarray
    seen: np.ndarray
    joints: tuple[str, ...] = ()


def silhouette_shapes(shafts: Shafts, load_mask: Load) -> tuple[np.ndarray, np.ndarray]:
    """Return widths [F] mm and shapes [F, C] of silhouettes.

    load_mask: frame's index -> bool [H, W], where the instrument is, of any size in the image's proportions.
    """
    length = shafts.working_length_mm
    along = np.arange(SILHOUETTE.along[0] * length, SILHOUETTE.along[1] * length, SILHOUETTE.step_mm)
    across = np.arange(
        -SILHOUETTE.across * length, SILHOUETTE.across * length + SILHOUETTE.step_mm / 2, SILHOUETTE.step_mm
    )
    signed = np.empty((len(shafts), len(along), len(across)), np.float32)
    for frame in range(len(shafts)):
        inside = crop(shafts, frame, load_mask(frame).astype(np.uint8) * 255, along, across) > 127
        within, beyond = (
            cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 3) * SILHOUETTE.step_mm
            for part in (inside, ~inside)
        )
        signed[frame] = np.clip(within - beyond, -SILHOUETTE.max_distance_mm, SILHOUETTE.max_distance_mm)
    half = SILHOUETTE.median_frames // 2
    padded = np.concatenate([signed[:1]] * half + [signed] + [signed[-1:]] * half)
    widths = np.empty(len(shafts))
    outlines = np.empty((len(shafts), signed[0].size), np.float32)
    for frame in range(len(shafts)):
        usual = np.median(padded[frame : frame + SILHOUETTE.median_frames], 0)
        inside = usual > 0
        first, last = inside.argmax(1), inside.shape[1] - 1 - inside[:, ::-1].argmax(1)
        widths[frame] = np.sort(np.where(inside.any(1), (last - first + 1) * SILHOUETTE.step_mm, 0.0))[
            -SILHOUETTE.width_rank
        ]
        outlines[frame] = cv2.GaussianBlur(usual, (0, 0), SILHOUETTE.blur_mm / SILHOUETTE.step_mm).ravel()
    outlines -= outlines.mean(0)
    values, vectors = np.linalg.eigh((outlines @ outlines.T).astype(np.float64))
    order = np.argsort(-values)[: SILHOUETTE.n_components]
    shapes = vectors[:, order] * np.sqrt(np.maximum(values[order], 0.0))
    return widths, shapes / np.sqrt(outlines.shape[1])


def measure(capture: Capture, load_mask: Mapping[str, Load]) -> dict[str, Measurements]:
    """Measure all instruments found in the video. load_mask: by instrument: frame's index -> bool [H, W], where it is.
    One without a logged joint whose silhouette opens and closes has jaws. Raises NeecoError for an image that cannot be
    read."""

    def load(frame: int) -> np.ndarray:
        return np.asarray(open_image(capture.frames[frame].image_path).convert("RGB"))

    measured = {}
    for instrument in capture.instruments:
        if instrument.from_video is None:
            continue
        shafts = Shafts.of(capture, instrument)
        textures, seen = unrolled_textures(shafts, load)
        widths, shapes = silhouette_shapes(shafts, load_mask[instrument.name])
        opened = np.quantile(widths, 0.95) - np.quantile(widths, 0.05)
        joints = (JAWS,) if not instrument.joints and opened > SILHOUETTE.min_opening * shafts.diameter_mm else ()
        measured[instrument.name] = Measurements(roll_pairs(textures, seen), widths, shapes, seen, joints)
    return measured


def write_measurements(capture: Capture, measured: Mapping[str, Measurements]) -> None:
    """Write them into the capture's folder, whole or not at all. Raises NeecoError."""
    tensors: dict[str, np.ndarray] = {}
    for number, item in enumerate(measured.values()):
        arrays = {**vars(item.pairs), "widths": item.widths, "shapes": item.shapes, "seen": item.seen}
        for name, values in arrays.items():
            smaller = {"i": np.int32, "f": np.float32}.get(values.dtype.kind, values.dtype)
            tensors[f"{number}/{name}"] = np.ascontiguousarray(values.astype(smaller))
    joints = json.dumps({name: item.joints for name, item in measured.items()}, allow_nan=False)
    notes = {"format": FORMAT, "frames": _frames(capture), "joints": joints}
    write_atomically(capture.root / FILE, lambda path: save_file(tensors, path, metadata=notes))


def read_measurements(capture: Capture) -> dict[str, Measurements]:
    """Read what `write_measurements` wrote. Raises NeecoError where it is missing, damaged or of other frames."""
    path = capture.root / FILE
    again = "make the capture again with `neeco ingest`"
    if not path.is_file():
        raise NeecoError(f"{path}: no such file: nothing was measured for posing by hand; {again}")
    require_content(path)
    try:
        with safe_open(path, framework="numpy") as file:
            notes = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            joints = require_like(json.loads(notes.get("joints", "")), {str: [str]}, str(path), again)
    except Exception as error:  # safetensors raises its own, undocumented types
        raise NeecoError(f"{path}: not readable: {' '.join(str(error).split())}; {again}") from error
    if notes.get("format") != FORMAT or notes.get("frames") != _frames(capture):
        raise NeecoError(f"{path}: was measured in other frames than transforms.json has; {again}")
    count = len(capture.frames)
    measurements = {}
    for number, (name, by_hand) in enumerate(joints.items()):
        part = {key.partition("/")[2]: value for key, value in tensors.items() if key.startswith(f"{number}/")}
        try:
            pairs = RollPairs(*(part.pop(key) for key in ("first", "second", "turns", "scores")))
            measurements[name] = Measurements(pairs, part["widths"], part["shapes"], part["seen"], tuple(by_hand))
            ends = np.concatenate([pairs.first, pairs.second, [0]])
            whole = pairs.turns.shape == pairs.scores.shape == (len(pairs.first), pairs.turns.shape[1])
            whole &= len(pairs.first) == len(pairs.second) and bool(0 <= ends.min() <= ends.max() < count)
            whole &= all(len(value) == count for value in part.values())
        except (KeyError, IndexError, ValueError):
            whole = False
        if not whole:
            raise NeecoError(f"{path}: {name}: is not in neeco's format; {again}")
    return measurements


def _frames(capture: Capture) -> str:
    """Hash of the capture's frames."""
    return hashlib.sha256("\n".join(frame.name for frame in capture.frames).encode()).hexdigest()
