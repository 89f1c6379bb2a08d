"""Slider values as a state (a position in the recording, and each instrument's departure from it), the views of a
scene in a state (image, labels, depth, ...), and a run's picture in a browser's window."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.evaluation.image_metrics import Pixels, difference_map, overlay_parts, to_uint8
from neeco.geometry.camera import Camera
from neeco.geometry.lines import frame_about
from neeco.geometry.rotations import rigid
from neeco.labels.drawing import surface_depth, to_numpy
from neeco.labels.labellers import composited_labels, threshold_of
from neeco.raster import rasterize
from neeco.raster.devices import readable_failures
from neeco.raster.types import Rendering
from neeco.scene import DrawableScene
from neeco.scene.gaussian_scene import is_gaussian
from neeco.synthesis.samplers import JointRange, Shaft, interpolate_state, joint_ranges, turn_about
from neeco.viewer.runs import LoadedRun
from neeco.viewer.viser_scene import stands_at

MARGIN = 0.2  # extension of a slider without stated limits, as a share of the recorded range
STILL = math.radians(1.0)  # half range, in rad, of the slider of a joint that never moved


@dataclass(frozen=True)
class InstrumentControls:
    """Departure of one instrument from the recording; none by default."""

    joints: Mapping[str, float] = field(default_factory=dict)  # rad; others are as recorded
    slide: float = 0.0  # mm along the shaft, towards the jaws
    roll: float = 0.0  # rad about the shaft
    yaw: float = 0.0  # rad about the shaft's end, to the side
    pitch: float = 0.0  # rad, about an axis at right angles to that of yaw
    pose: np.ndarray | None = None  # [4, 4] world_from_instrument, mm, to which slides and rotations are added

    @property
    def departs(self) -> bool:
        """Whether anything differs from the recording."""
        return self.pose is not None or bool(self.joints) or any((self.slide, self.roll, self.yaw, self.pitch))


@dataclass(frozen=True)
class Controls:
    """A position in the recording, and departures from it. frame: 1.5 is half way from the second to the third."""

    frame: float = 0.0
    instruments: Mapping[str, InstrumentControls] = field(default_factory=dict)

    @property
    def recorded_frame(self) -> int | None:
        """Return the frame whose recorded state this is; None between frames and for other states."""
        departs = any(item.departs for item in self.instruments.values())
        return int(self.frame) if self.frame == int(self.frame) and not departs else None


def controlled_state(states: Sequence[State], shafts: Mapping[str, Shaft], controls: Controls) -> State:
    """Return the state set by the controls. states: the recording's, at least one; controls of other instruments are
    ignored. Frames outside the recording are clamped."""
    state = interpolated_state(states, controls.frame)
    moved = {
        name: _moved(recorded, shafts[name], controls.instruments[name]) if name in controls.instruments else recorded
        for name, recorded in state.instruments.items()
    }
    return replace(state, instruments=moved)


def interpolated_state(states: Sequence[State], frame: float) -> State:
    """Interpolate the recording between two frames: positions, joints and time linearly, rotations by slerp."""
    frame = min(max(frame, 0.0), len(states) - 1.0)
    first, share = int(frame), frame - int(frame)
    return interpolate_state(states[first], states[first + 1], share) if share else states[first]


def slider_ranges(instruments: Sequence[Instrument], states: Sequence[State]) -> dict[tuple[str, str], JointRange]:
    """Return the range of the slider of each (instrument, joint), in rad: the capture's limits, else slightly more than
    the recorded range."""
    ranges = {}
    for (name, joint), recorded in joint_ranges(states).items():
        limits = next((item.joints.get(joint) for item in instruments if item.name == name), None)
        if limits is not None and -math.inf < limits[0] < limits[1] < math.inf:
            ranges[name, joint] = JointRange(*limits)
            continue
        if recorded.upper - recorded.lower < 2 * STILL:
            middle = (recorded.upper + recorded.lower) / 2
            recorded = JointRange(middle - STILL, middle + STILL)
        ranges[name, joint] = recorded.widened(MARGIN, None)
    return ranges


def _moved(recorded: InstrumentState, shaft: Shaft, controls: InstrumentControls) -> InstrumentState:
    """Apply roll about the shaft, pitch and yaw about its end, then a slide along its original direction."""
    if not controls.departs:
        return recorded
    side, up, _ = frame_about(shaft.along).T
    turns = (
        Rotation.from_rotvec(controls.yaw * up)
        * Rotation.from_rotvec(controls.pitch * side)
        * Rotation.from_rotvec(controls.roll * shaft.along)
    )
    pose = to_numpy(recorded.pose) if controls.pose is None else controls.pose
    joints = {joint: controls.joints.get(joint, value) for joint, value in recorded.joints.items()}
    with np.errstate(invalid="ignore"):  # a browser may send infinity, which cannot be rendered
        offset = rigid(np.eye(3), controls.slide * shaft.along) @ turn_about(shaft.end, turns.as_rotvec())
        return InstrumentState(torch.from_numpy(pose @ offset), joints)


IMAGE, OVERLAY, PARTS = "image", "labels over image", "parts"
DEPTH, UNOBSERVED, DIFFERENCE = "depth", "unobserved", "difference to the recorded image"
VIEWS = (IMAGE, OVERLAY, PARTS, DEPTH, UNOBSERVED, DIFFERENCE)
LABELLED = (OVERLAY, PARTS)
ONLY_RECORDED = "difference: only of a recorded state from its camera; press “go to this frame's camera”"

UNOBSERVED_COLOR = np.array([255.0, 0.0, 255.0])  # nothing inside a body has it
DEPTH_PERCENTILES = 2, 98  # percentiles of the depth that are white and black
DIMMED = 0.35  # share of the light left to what cannot be compared


@dataclass(frozen=True)
class Picture:
    """Shown pixels and their depth."""

    pixels: Pixels  # uint8 [H, W, 3]
    depth: np.ndarray  # [H, W] mm, 0 = nothing there
    note: str = ""  # what the colours mean, where that differs from picture to picture


def views_of(scene: DrawableScene, has_images: bool) -> tuple[str, ...]:
    """The VIEWS that a scene has; has_images: the capture is at hand."""
    absent = set[str]() if scene.label_names else set(LABELLED)
    if not scene.has_gaussians:
        absent.add(UNOBSERVED)
    if not has_images:
        absent.add(DIFFERENCE)
    return tuple(view for view in VIEWS if view not in absent)


@torch.no_grad()
def picture(scene: DrawableScene, state: State, camera: Camera, view: str, labels: Tensor | None = None) -> Picture:
    """One of VIEWS but DIFFERENCE of `state` as `camera` sees it. labels [N, L]: the scene's label channels, where
    they are at hand; they take time."""
    rendering = _rendering(scene, state, camera, view, labels)
    color, depth = rendering.color.clamp(0, 1).cpu().numpy(), surface_depth(rendering)
    if view in LABELLED:
        parts = composited_labels(rendering, threshold_of(scene))[0].cpu().numpy()
        if view == PARTS:
            return Picture(overlay_parts(np.zeros_like(color), parts, 1.0), depth)
        return Picture(overlay_parts(color, parts), depth)
    if view == DEPTH:
        if not (has_depth := depth > 0).any():
            return Picture(np.zeros_like(color, np.uint8), depth, "nothing in view")
        near, far = np.percentile(depth[has_depth], DEPTH_PERCENTILES)
        grey = np.clip((far - depth) / max(far - near, 1e-6), 0, 1) * has_depth
        note = f"white {near:.1f} mm or nearer, black {far:.1f} mm"
        return Picture(to_uint8(np.repeat(grey[..., None], 3, 2) * 255), depth, note)
    if view == UNOBSERVED:
        assert rendering.channels is not None
        share = rendering.channels[..., -1:].clamp(0, 1).cpu().numpy()
        note = f"magenta: unobserved; {share.mean():.1%} of the picture"
        return Picture(to_uint8((1 - share) * color * 255 + share * UNOBSERVED_COLOR), depth, note)
    return Picture(to_uint8(color * 255), depth)


@torch.no_grad()
def difference(scene: DrawableScene, state: State, recorded_by: Camera, image: np.ndarray, window: Camera) -> Picture:
    """Difference between `image` [H, W, 3] in [0, 1] and a rendering by the camera that recorded it, as `window` shows
    it: a camera at the same place with the same vertical field of view. Outside the image it is black."""
    rendering = scene.render(state, recorded_by)
    compared = difference_map(rendering.color.clamp(0, 1).cpu().numpy(), image, legend=False)
    # the recorded pixel [H, W] that looks where each of the window's pixels does
    rows, columns = np.mgrid[0 : window.height, 0 : window.width] + 0.5
    down, right = (rows - window.cy) / window.fy, (columns - window.cx) / window.fx
    rows = np.floor(down * recorded_by.fy + recorded_by.cy).astype(int)
    columns = np.floor(right * recorded_by.fx + recorded_by.cx).astype(int)
    inside = (rows >= 0) & (rows < recorded_by.height) & (columns >= 0) & (columns < recorded_by.width)
    rows, columns = rows.clip(0, recorded_by.height - 1), columns.clip(0, recorded_by.width - 1)
    pixels = np.where(inside[..., None], compared[rows, columns], 0).astype(np.uint8)
    return Picture(pixels, np.where(inside, surface_depth(rendering)[rows, columns], 0.0))


def render_run(loaded: LoadedRun, controls: Controls, camera: Camera, view: str) -> tuple[Picture, bool]:
    """Render a run from `camera`, at the controls; return the picture, and whether state and camera are those of a
    recorded frame. Raises NeecoError."""
    scene, state = loaded.scene, controlled_state(loaded.recorded.states, loaded.shafts, controls)
    frame = controls.recorded_frame
    as_recorded = frame is not None and stands_at(camera, loaded.recorded.cameras[frame], loaded.distance)
    with scene.torch_threads(), readable_failures():
        if view == DIFFERENCE and frame is not None and as_recorded and loaded.frames:
            image = loaded.frames[frame].load_image().numpy()
            return difference(scene, state, loaded.recorded.cameras[frame], image, camera), True
        if view in views_of(scene, False):
            return picture(scene, state, camera, view, loaded.labels), as_recorded
        plain = picture(scene, state, camera, IMAGE)  # darkened, since it is not what was asked for
    note = ONLY_RECORDED if view == DIFFERENCE else f"{view}: a scene of method {scene.method} has none"
    return Picture(to_uint8(plain.pixels * DIMMED), plain.depth, note), as_recorded


def _rendering(scene: DrawableScene, state: State, camera: Camera, view: str, labels: Tensor | None) -> Rendering:
    learned = scene.recorded.as_learned(camera)
    if learned.learned_fx is not None and camera.fx > learned.learned_fx:  # averaging smaller ones would take too long
        camera = learned
    if view in LABELLED and labels is None:
        return scene.render(state, camera, labels=True)
    if view not in (*LABELLED, UNOBSERVED) or not is_gaussian(scene):
        return scene.render(state, camera)
    gaussians = scene.at(state)
    channels = labels if view in LABELLED else scene.unobserved(gaussians, camera)[:, None]
    return rasterize(gaussians, camera, channels=channels)
