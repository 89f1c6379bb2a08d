"""Data model of recordings, in the units and axes used throughout.

Lengths are mm, angles rad, times s. The world is right-handed and fixed to the tissue. Cameras have OpenCV axes (x
right, y down, z forward). Poses are rigid transforms [4, 4], named by both ends: `world_from_camera`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.base.plausible import Fault, joint_fault
from neeco.capture.images import area_averaged_bytes, byte_pixels, read_mask, read_pixels
from neeco.capture.kinematics import PRISMATIC, KinematicTree
from neeco.capture.points import PointCloud
from neeco.geometry.camera import Camera
from neeco.geometry.lens import Lens
from neeco.geometry.rotations import as_pose, number_text, position_text, rigid_fault

SCHEMA = "neeco-capture/1"  # of the folder that holds a capture
SEPARATE_TISSUES = "make one capture for each tissue, train each, and mix with `neeco synthesize --tissue RUN`"
TEST_EVERY = 8  # without splits, every 8th frame is a test frame (as in 3DGS and nerfstudio)
UNKNOWN_DEG = 180.0  # standard deviation of an unknown angle
REFERENCE_PIXELS = 320 * 256  # image size that pixel sizes and numbers of Gaussians refer to
HOW_TO_REGISTER = (  # if poses are not in the cameras' world
    "in recording.yaml state camera_from_base (a robot's base to a still camera; or unknown, which searches it), "
    "poses: {…, frame: camera}, or laparoscope (the tracker of a scope that moves), and ingest again"
)
MIN_DEVIATION = 1e-9  # standard deviation below which a coordinate counts as constant


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of an instrument's state."""

    translation_mm: tuple[float, float, float]  # of the origin, in the camera's axes: across, across, depth
    rotation_deg: tuple[float, float, float]  # about the instrument's x, y, z: tilt, tilt, roll; 180: unknown
    joints_deg: Mapping[str, float] = field(default_factory=dict)  # name -> degrees (mm for sliding joints)


@dataclass(frozen=True)
class BaseUncertainty:
    """Covariance of an error common to all recorded poses of an instrument, such as that of a robot's base: a rotation
    (rad) about `center` (mm) and a translation (mm), both in the world's axes."""

    center: tuple[float, ...]  # [3]
    covariance: tuple[tuple[float, ...], ...]  # [6][6]


@dataclass(frozen=True)
class InstrumentState:
    """Pose and joint values of one instrument.

    The pose may be a tensor, an array or nested lists; other than tensors become float64. Raises NeecoError if it is
    not 4x4, or (unless a tensor) no rotation and translation, and for joints that are not finite numbers.
    """

    pose: Tensor  # [4, 4] float64, world_from_instrument, mm
    joints: Mapping[str, float] = field(default_factory=dict)  # name -> rad (mm for sliding joints, named *_mm)
    trust: float | None = None  # in [0, 1], confidence of `track`; None: it was recorded
    uncertainty: Uncertainty | None = None  # None: not stated

    if TYPE_CHECKING:  # what may be given

        def __init__(
            self,
            pose: ArrayLike | Tensor,
            joints: Mapping[str, float] = ...,
            trust: float | None = ...,
            uncertainty: Uncertainty | None = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", as_pose(self.pose, "InstrumentState.pose", torch.float64))
        for joint, value in self.joints.items():
            if not isinstance(value, Tensor) and not _is_finite(value):
                raise NeecoError(f"InstrumentState.joints: {joint!r} is {value!r}, not a finite number; correct it")

    def __repr__(self) -> str:
        joints = "".join(f", {name}={number_text(value)}" for name, value in self.joints.items())
        return f"InstrumentState(at {position_text(self.pose)}{joints})"


@dataclass(frozen=True)
class State:
    """Everything that moves, at one moment: each instrument's state by its name, and the time.

    Args:
        instruments: name -> InstrumentState, or (pose, joints): world_from_instrument [4, 4] in mm, and name -> rad
            (mm for sliding joints)
        time: s

        neeco.State({"maryland": (np.eye(4), {"jaw_angle": 0.4})}, time=1.2)
    """

    instruments: Mapping[str, InstrumentState] = field(default_factory=dict)
    time: float = 0.0  # s

    def __post_init__(self) -> None:
        states = {
            name: InstrumentState(*state) if isinstance(state, tuple) else state
            for name, state in self.instruments.items()
        }
        object.__setattr__(self, "instruments", states)
        if not isinstance(self.time, Tensor) and not _is_finite(self.time):
            raise NeecoError(f"State.time: is {self.time!r}, not a finite number of seconds; correct it")

    def __repr__(self) -> str:
        instruments = "".join(f"{name}: {state!r}, " for name, state in self.instruments.items())
        return f"State({instruments}time={number_text(self.time)} s)"

    def check(self, instruments: Sequence[Instrument], *, fitted: bool = False) -> None:
        """Raise NeecoError for states that are invalid for a scene's instruments: poses that are not rigid, instruments
        and joints that it does not have, joints beyond their limits.

        fitted: it may come from a fit, so joints may exceed their limits by their range and differ from the scene's;
        tensors on a GPU or with gradients are not read.
        """
        by_name = {item.name: item for item in instruments}
        for name, state in self.instruments.items():
            item, place = by_name.get(name), f"state: {name}"
            if item is None and by_name and not fitted:
                raise NeecoError(f"{place}: is not in the scene; it has {', '.join(by_name)}")
            if _is_readable(state.pose, fitted):
                fault = rigid_fault(state.pose.detach().cpu().double().numpy())
                if fault is not None:
                    raise NeecoError(f"{place}: pose {fault[0]}; {fault[1]}")
            if item is None:
                continue
            for joint, value in state.joints.items():
                if (fitted and joint not in item.joints) or not _is_readable(value, fitted):
                    continue
                fault = item.joint_fault(joint, float(value), slack=1.0 if fitted else 0.0)
                if fault is not None:
                    raise NeecoError(f"{place}: joint {joint!r} {fault[0]}; {fault[1]}")

    def to(self, device: torch.device | str) -> State:
        """The same state, its poses on `device`."""
        moved = {name: replace(state, pose=state.pose.to(device)) for name, state in self.instruments.items()}
        return replace(self, instruments=moved)


@dataclass(frozen=True)
class FromVideo:
    """Dimensions of a rigid instrument whose poses were estimated from its shaft in the images.

    Its frame then has +z along the shaft, from the handle towards the tip, and its origin on the shaft's axis,
    `working_length_mm` behind the tip as the silhouette shows it."""

    shaft_diameter_mm: float
    working_length_mm: float


@dataclass(frozen=True)
class Instrument:
    """One tracked rigid body and its links. `joints`: name of every reading -> (lower, upper) limit in rad, or None
    when not stated. `kinematics`: the links and the readings that drive their joints, if known. `unrecorded`: joints of
    these links that no sensor logged, each with limits; in a capture's states they are half way between these until
    they are estimated. `from_video`: its poses were estimated from the images. `left_out`: recorded joints that a
    learned scene does not use. `base_uncertainty`: of the error common to all poses."""

    name: str
    joints: Mapping[str, tuple[float, float] | None] = field(default_factory=dict)
    kinematics: KinematicTree | None = None
    unrecorded: tuple[str, ...] = ()
    from_video: FromVideo | None = None
    left_out: tuple[str, ...] = ()
    _: KW_ONLY
    base_uncertainty: BaseUncertainty | None = None  # None: not stated

    def __repr__(self) -> str:
        return f"Instrument({self.name!r}, joints: {', '.join(self.joints) or 'none'})"

    def joint_fault(self, joint: str, value: float, slack: float = 0.0) -> Fault | None:
        """Return the fault of a joint value, rad or mm, and its remedy; None if plausible. slack: see
        `neeco.base.plausible.joint_fault`."""
        if joint in self.joints:
            return joint_fault(value, self.joints[joint], self.slides(joint), slack)
        if joint in self.left_out:
            return None
        return f"is no joint of {self.name}", f"it has {', '.join(self.joints) or 'none'}"

    def halfway(self, joint: str) -> float:
        """The middle of a joint's limits; 0 where none are stated."""
        limits = self.joints[joint]
        return 0.0 if limits is None else (limits[0] + limits[1]) / 2

    def slides(self, joint: str) -> bool:
        """Return True if a joint's reading is a length in mm, by its kinematics, else by its name."""
        tree = self.kinematics
        if tree is None or joint not in tree.readings:
            return joint.endswith("_mm")
        return any(link.type == PRISMATIC for link in tree.joints if joint in link.value)


@dataclass(frozen=True)
class Frame:
    """One image with its camera, instrument states, time and split. Pixels are read on demand."""

    image_path: Path
    camera: Camera
    state: State
    split: str  # train, test, unseen, or any other name
    mask_path: Path | None = None  # black pixels are ignored by the loss
    background: float = 1.0  # colour behind transparent pixels: 0 black, 1 white
    _: KW_ONLY
    stored_size: tuple[int, int] | None = None  # (width, height) of the files, pixels; None: that of the camera

    def __post_init__(self) -> None:
        object.__setattr__(self, "image_path", Path(self.image_path))

    def __repr__(self) -> str:
        return f"Frame({self.name!r}, split={self.split!r}, {self.camera.width}x{self.camera.height} px)"

    @property
    def name(self) -> str:
        """The image file's stem; it names everything rendered for this frame."""
        return self.image_path.stem

    def scaled(self, scale: float) -> Frame:
        """The frame at `scale` times its size: pixels are area-averaged when they are read, and a mask pixel is set
        where all of its area is."""
        size = (self.camera.width, self.camera.height)
        return replace(self, camera=self.camera.scaled(scale), stored_size=self.stored_size or size)

    def load_image(self) -> Tensor:
        """float32 [H, W, 3] in [0, 1], sRGB as stored. Raises NeecoError when unreadable or of another size."""
        pixels = self.load_pixels()
        return torch.from_numpy(pixels / np.float32(255) if pixels.dtype == np.uint8 else pixels)

    def load_image_bytes(self) -> Tensor:
        """`load_image` in uint8 [H, W, 3]."""
        return torch.from_numpy(byte_pixels(self.load_pixels()))

    def load_pixels(self) -> np.ndarray:
        """`load_image` as an array: uint8 where that is exact or the frame is scaled, else float32."""
        pixels = read_pixels(self.image_path, self._stored_size, self.background)
        return pixels if self.stored_size is None else area_averaged_bytes(byte_pixels(pixels), self.camera)

    def load_mask(self) -> Tensor | None:
        """bool [H, W], True where the loss counts, or None when the frame has no mask. Raises NeecoError."""
        if self.mask_path is None:
            return None
        mask = read_mask(self.mask_path, self._stored_size)
        if self.stored_size is None:
            return mask
        return torch.from_numpy(area_averaged_bytes(mask.numpy().astype(np.uint8) * 255, self.camera) == 255)

    @property
    def _stored_size(self) -> tuple[int, int]:
        return self.stored_size or (self.camera.width, self.camera.height)


@dataclass(frozen=True)
class Capture:
    """A recording ready to learn from. `read_capture` reads one from a folder, `write_capture` writes one."""

    root: Path  # the folder it was read from
    frames: tuple[Frame, ...]
    instruments: tuple[Instrument, ...] = ()
    points: PointCloud = field(default_factory=lambda: PointCloud(measured=False))
    _: KW_ONLY
    registered: bool = True  # instrument poses are in the cameras' world frame
    timed: bool = True  # the recording says when each frame was taken; else `State.time` counts the frames
    lens: Lens | None = None  # through which it was recorded; its distortion is gone from the images
    still: bool = False  # the cameras stood still: nothing shows the tissue's depth from elsewhere

    def __post_init__(self) -> None:
        for name, kind in {"root": Path, "frames": tuple, "instruments": tuple}.items():
            object.__setattr__(self, name, kind(getattr(self, name)))

    def __repr__(self) -> str:
        splits = ", ".join(f"{len(self.split(name))} {name}" for name in self.splits)
        names = ", ".join(item.name for item in self.instruments) or "no instruments"
        return f"Capture({str(self.root)!r}, {len(self.frames)} frames ({splits}), {names})"

    def split(self, name: str) -> tuple[Frame, ...]:
        """The frames of one split, in recorded order."""
        return tuple(frame for frame in self.frames if frame.split == name)

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits present, in order of first appearance."""
        return tuple(dict.fromkeys(frame.split for frame in self.frames))


def _is_finite(value: object) -> bool:
    try:
        return not isinstance(value, bool) and math.isfinite(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return False


def _is_readable(value: object, only_cheaply: bool) -> bool:
    """Return True if a number or tensor may be read; `only_cheaply`: without waiting for a GPU, nor gradients."""
    if not isinstance(value, Tensor):
        return True
    return not value.is_meta and not (only_cheaply and (value.requires_grad or value.device.type != "cpu"))


def share_lamps(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Give the cameras of a still scope the lamps of the first one: the second camera of a stereo scope has none of its
    own."""
    return tuple(
        camera
        if torch.equal(camera.world_from_camera, cameras[0].world_from_camera)
        else replace(camera, world_from_lamps=cameras[0].world_from_camera)
        for camera in cameras
    )


class RecordedStates:
    """Distances of states from the recorded ones, in standard deviations of the latter.

    A state's coordinates are the instruments' positions (mm), the entries of their rotation matrices and their joints
    (rad), or the time (s) without instruments. Each is divided by its standard deviation over the recorded states;
    constant coordinates are ignored. joints: whether they count.
    """

    def __init__(self, states: Sequence[State], instruments: Sequence[str], joints: bool = True) -> None:
        self.instruments, self.joints = tuple(instruments), joints
        points = np.array([self._coordinates(state) for state in states], np.float64)
        deviation = points.std(0) if len(points) else np.zeros(0)
        self._moving = deviation > MIN_DEVIATION
        self._deviation = deviation[self._moving]
        self._points = points[:, self._moving] / self._deviation if len(points) else points

    @property
    def still(self) -> bool:
        """True if nothing moved, so that all states are equally near."""
        return not self._moving.any()

    def distances(self, state: State) -> np.ndarray:
        """[R] root mean square over the coordinates, in standard deviations, to every recorded state."""
        point = np.array(self._coordinates(state))[self._moving] / self._deviation
        return np.sqrt(((self._points - point) ** 2).mean(-1))

    def _coordinates(self, state: State) -> list[float]:
        if not self.instruments:
            return [state.time]
        values: list[float] = []
        for name in self.instruments:
            item = state.instruments[name]
            values += item.pose[:3].detach().cpu().double().numpy().ravel().tolist()
            values += [item.joints[joint] for joint in sorted(item.joints)] if self.joints else []
        return values


def evenly_spaced(count: int, most: int, *, floor: bool = False) -> list[int]:
    """Return indices of at most `most` of `count` items, evenly spaced, in order, without duplicates.

    Half positions are rounded to even, or down with `floor`.
    """
    places = np.linspace(0, count - 1, min(count, most))
    return np.unique((np.floor if floor else np.rint)(places).astype(int)).tolist()
