"""Content of a browser's window: slider values as a state, viser's camera and scene, and views of a state.

Slider values are a position in the recording, and each instrument's departure from it; viser's camera and scene are
converted from and to ours, with recorded cameras, sparse points and gizmos; views are image, labels, depth, ...
viser keeps depth up to 168 of its units and sees 1000 far, so mm do not fit; a `unit` is how many of them a mm is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.capture.model import Instrument, InstrumentState, PointCloud, State, evenly_spaced
from neeco.evaluation.image_metrics import Pixels, difference_map, overlay_parts, to_uint8
from neeco.geometry.camera import Camera
from neeco.geometry.lines import frame_about
from neeco.geometry.rotations import rigid
from neeco.labels.drawing import surface_depth, to_numpy
from neeco.labels.labellers import composited_labels, threshold_of
from neeco.raster import rasterize
from neeco.raster.devices import readable_failures
from neeco.scene import DrawableScene
from neeco.scene.gaussian_scene import is_gaussian
from neeco.synthesis.samplers import JointRange, Shaft, interpolate_state, joint_ranges, turn_about
from neeco.viewer.runs import VIEWER, LoadedRun

if TYPE_CHECKING:
    import viser


def aspect_of(window: viser.CameraHandle) -> float:
    """Width of the window by its height, within reason: a browser may say anything."""
    return min(max(float(window.aspect), 1 / VIEWER.max_aspect), VIEWER.max_aspect) if window.aspect > 0 else 1.0


def wxyz_of(pose: np.ndarray) -> np.ndarray:
    """The unit quaternion [4] of a pose [4, 4]."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)


def pose_of(wxyz: np.ndarray, position: np.ndarray, unit: float) -> np.ndarray:
    """The pose [4, 4] in mm of a quaternion and a position in viser's units."""
    return rigid(Rotation.from_quat(wxyz, scalar_first=True).as_matrix(), np.asarray(position) / unit)


def field_of_view(camera: Camera) -> float:
    """Vertical, in rad, about the middle of the image."""
    return 2 * math.atan(camera.height / 2 / camera.fy)


def browser_camera(window: viser.CameraHandle, unit: float, height: int) -> Camera:
    """The camera of the browser's window, rendered `height` px high."""
    width = max(1, round(height * aspect_of(window)))
    focal = height / 2 / math.tan(min(max(window.fov, VIEWER.narrowest), VIEWER.widest) / 2)
    pose = torch.from_numpy(pose_of(window.wxyz, window.position, unit))
    return Camera(pose, focal, focal, width / 2, height / 2, width=width, height=height)


def stands_at(window: Camera, recorded: Camera, distance: float) -> bool:
    """Whether the window's camera has the recorded camera's pose, whatever part it shows. distance:
    `LoadedRun.distance`, mm."""
    one, two = to_numpy(window.world_from_camera), to_numpy(recorded.world_from_camera)
    apart = float(np.linalg.norm(one[:3, 3] - two[:3, 3]))
    turned = Rotation.from_matrix(one[:3, :3].T @ two[:3, :3]).magnitude()
    return apart <= VIEWER.same_place * distance and turned <= VIEWER.same_turn


def fitting_view(camera: Camera, aspect: float) -> float:
    """The vertical field of view in rad with which a window of that width by height shows all that `camera` saw."""
    across = camera.width / 2 / camera.fx / aspect
    return 2 * math.atan(max(camera.height / 2 / camera.fy, across))


def jump(client: viser.ClientHandle, camera: Camera, unit: float, distance: float) -> None:
    """Send the browser's camera exactly to a recorded one; it orbits about what lies `distance` mm ahead."""
    pose = to_numpy(camera.world_from_camera)
    with client.atomic():
        # the up direction first, or the orbit controls keep the old roll
        client.camera.up_direction = -pose[:3, 1]
        client.camera.position = pose[:3, 3] * unit
        client.camera.look_at = (pose[:3, 3] + distance * pose[:3, 2]) * unit
        client.camera.fov = fitting_view(camera, aspect_of(client.camera))


class Overlays:
    """Overlays that viser draws over the picture. Nodes are named by number: names of a run go into no path."""

    def __init__(
        self,
        client: viser.ClientHandle,
        cameras: Sequence[Camera],
        points: PointCloud | None,
        unit: float,
        clicked: Callable[[int], None],
        dragged: Callable[[], None],
    ) -> None:
        """clicked: gets the frame whose camera was clicked on; dragged: called when a gizmo moved."""
        self._scene, self._unit, self._dragged = client.scene, unit, dragged
        self.cameras = self._scene.add_frame("/cameras", show_axes=False, visible=False)
        poses = [to_numpy(camera.world_from_camera) for camera in cameras]
        spread = evenly_spaced(len(cameras), VIEWER.max_frusta)  # some from everywhere, none twice in one place
        places = np.unique([poses[frame].round(3) for frame in spread], axis=0, return_index=True)[1]
        for frame in (spread[place] for place in places.tolist()):
            camera, pose = cameras[frame], poses[frame]
            frustum = self._scene.add_camera_frustum(
                f"/cameras/{frame}",
                fov=field_of_view(camera),
                aspect=camera.width / camera.height,
                scale=VIEWER.frustum_units,
                thickness=1.5,
                thickness_units="screen",
                color=VIEWER.frustum_color,
                wxyz=wxyz_of(pose),
                position=pose[:3, 3] * unit,
            )
            frustum.on_click(lambda _, frame=frame: clicked(frame))
        self.points: Any = None
        if points is not None and len(points.positions):
            chosen = evenly_spaced(len(points.positions), VIEWER.max_points)
            self.points = self._scene.add_point_cloud(
                "/points",
                (points.positions[chosen] * unit).astype(np.float32),
                points.colors[chosen].astype(np.float32),
                point_size=VIEWER.point_units,
                point_shape="circle",
                precision="float32",
                visible=False,
            )
        self._gizmos: dict[str, Any] = {}

    @property
    def shown(self) -> bool:
        """Whether there is anything that the picture's depth must hide or show."""
        return bool(self.cameras.visible or (self.points is not None and self.points.visible) or self._gizmos)

    def show(self, cameras: bool, points: bool) -> None:
        """Set which of them are visible."""
        for node, visible in ((self.cameras, cameras), (self.points, points)):
            if node is not None and node.visible != visible:
                node.visible = visible

    def add_gizmo(self, name: str, number: int, pose: np.ndarray) -> None:
        """Show the gizmo of an instrument that stands at `pose` [4, 4] mm."""
        gizmo = self._scene.add_transform_controls(
            f"/gizmos/{number}",
            scale=VIEWER.gizmo_units,
            wxyz=wxyz_of(pose),
            position=pose[:3, 3] * self._unit,
            depth_test=False,
        )
        gizmo.on_update(lambda _: self._dragged())
        self._gizmos[name] = gizmo

    def remove_gizmo(self, name: str) -> None:
        """Take an instrument's gizmo away."""
        if name in self._gizmos:
            self._gizmos.pop(name).remove()

    def gizmo_pose(self, name: str) -> np.ndarray | None:
        """Pose [4, 4] in mm of an instrument's gizmo; None without one."""
        gizmo = self._gizmos.get(name)
        return None if gizmo is None else pose_of(gizmo.wxyz, gizmo.position, self._unit)


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
    learned = scene.recorded.as_learned(camera)
    if learned.learned_fx is not None and camera.fx > learned.learned_fx:  # averaging smaller ones would take too long
        camera = learned
    if view in LABELLED and labels is None:
        rendering = scene.render(state, camera, labels=True)
    elif view not in (*LABELLED, UNOBSERVED) or not is_gaussian(scene):
        rendering = scene.render(state, camera)
    else:
        gaussians = scene.at(state)
        channels = labels if view in LABELLED else scene.unobserved(gaussians, camera)[:, None]
        rendering = rasterize(gaussians, camera, channels=channels)
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
