"""The viewed run folder: its scene, also during training, the score of each frame, and the files that users save from
it: states for `synthesize --states`, and single labelled images.
"""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.base.files import LOCK_WAIT_S, own_folder, read_text, write_text
from neeco.capture import read_capture
from neeco.capture.model import Capture, Frame, State
from neeco.capture.readers import StateLine, read_states
from neeco.capture.writer import camera_to_json, state_to_json
from neeco.evaluation.image_metrics import psnr
from neeco.evaluation.masks import iou, load_reference
from neeco.geometry.camera import Camera
from neeco.labels.annotation import annotate
from neeco.labels.drawing import draw, draw_layers, to_numpy
from neeco.labels.labellers import CompositedLabels
from neeco.scene import DrawableScene, Recorded, load_scene
from neeco.scene.gaussian_scene import is_gaussian, require_gaussians
from neeco.synthesis.contact import labels_of
from neeco.synthesis.samplers import DrawnCameras, Shaft, moved_camera, shafts_of
from neeco.synthesis.settings import RECORDED_SIZE, Settings, SizeSettings
from neeco.synthesis.writers import encoded_sample, load_record, record_path
from neeco.training.run import SCENE_FILE, checkpoint_path, read_checkpoint, read_config


@dataclass(frozen=True, kw_only=True)
class ViewerSettings:
    """Settings of what the viewer of a run or a capture renders, places in the scene and lists, and when."""

    # runs
    assumed_mm: float = 100.0  # distance in mm from a camera to what it sees, where none looks at the scene's centre
    distance_units: float = 10.0  # distance from a recorded camera to what it looks at, in viser's units of length
    watch_s: float = 2.0  # s between two checks of the run folder
    timeline_width: int = 320  # limit on the width in px of the images that a timeline compares
    field_width: int = 48  # the same limit for a radiance field, which takes a hundred times as long
    worst: int = 8  # number of frames that a timeline lists
    # rendering
    settled_s: float = 0.15  # s without a request after which a sharp picture is rendered
    idle_s: float = 0.5  # maximum s between two checks for requests
    moving_px: int = 256  # maximum height in px during motion
    sharp_px: int = 720  # maximum height in px of a sharp rendering
    min_px: int = 32  # minimum height in px
    moving_s: float = 0.15  # maximum s of a rendering during motion
    sharp_s: float = 0.4  # maximum s of a sharp rendering
    remembered: int = 3  # number of timed renderings, robust to one that computed something first
    jpeg_moving: int = 80  # JPEG quality during motion
    jpeg_sharp: int = 92  # JPEG quality of a sharp rendering
    played_per_s: float = 10.0  # frames per s of `play`
    status_every_s: float = 0.25  # minimum s between two updates of the status during motion
    # the browser's camera, and what is placed in the scene
    max_aspect: float = 8.0  # of a window's width to its height, or the reverse
    narrowest: float = 0.01  # rad, field of view
    widest: float = 3.0  # rad, field of view
    same_place: float = 2e-4  # of the distance to what is looked at
    same_turn: float = 1e-3  # rad
    max_frusta: int = 24  # of cameras
    max_points: int = 20_000  # of a sparse cloud
    frustum_units: float = 0.06 * distance_units  # size of a camera's frustum
    gizmo_units: float = 0.2 * distance_units  # length of axes
    point_units: float = 0.005 * distance_units  # size of a point
    axis_units: float = 0.1 * distance_units  # length of the axes of a recording's instruments
    frustum_color: tuple[int, int, int] = (255, 200, 0)
    # RGB, of the tracks of a recording's instruments in turn
    track_colors: tuple[tuple[int, int, int], ...] = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167))
    image_px: int = 720  # high at most, of the recorded image behind the scene
    # panel
    slide_mm: float = 30.0  # range in mm of position sliders, to either side
    yaw_deg: float = 45.0  # range in degrees of yaw and pitch sliders, to either side
    plots_every_s: float = 0.5  # minimum s between two plots while scores arrive
    plot_height: int = 140  # height of the plot in px
    line: int = 80  # maximum length of a name or message


VIEWER = ViewerSettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class LoadedRun:
    """Content of a run folder when it was read; another reading is another object.

    Frames are in the order they were recorded in, all splits together.
    """

    name: str
    scene: DrawableScene
    recorded: Recorded
    frames: tuple[Frame, ...]  # those of `recorded`, with their images; empty: the capture is not at hand
    capture: Capture | None
    shafts: dict[str, Shaft]
    iteration: int | None  # that training had reached; None: it has finished
    trouble: str = ""  # why the capture is not at hand

    @cached_property
    def labels(self) -> Tensor | None:
        """The scene's label channels [N, L], computed once; None where it has none."""
        if not (is_gaussian(self.scene) and self.scene.label_names):
            return None
        with torch.no_grad():
            return self.scene.label_channels()

    @cached_property
    def distance(self) -> float:
        """Median distance of the recorded cameras from the centre of the scene, along what they look at, in mm."""
        centre = getattr(self.scene, "center", torch.zeros(3)).detach().cpu().double().numpy()
        return median_distance((camera, [centre]) for camera in self.recorded.cameras)

    @property
    def signature(self) -> tuple[Any, ...]:
        """Everything that sliders depend on: where it changes, they are created again."""
        joints = tuple((item.name, tuple(item.joints.items())) for item in self.scene.instruments)
        return joints, self.recorded.names, tuple(self.scene.label_names), bool(self.frames)


def median_distance(looked_at: Iterable[tuple[Camera, Sequence[np.ndarray]]]) -> float:
    """Median distance in mm of places [3] from the cameras that look at them, along what these look at, of those ahead;
    `assumed_mm` where none is."""
    depths = []
    for camera, places in looked_at:
        pose = to_numpy(camera.world_from_camera)
        depths += [float((place - pose[:3, 3]) @ pose[:3, 2]) for place in places]
    ahead = [depth for depth in depths if depth > 0]
    return float(np.median(ahead)) if ahead else VIEWER.assumed_mm


class ViewedRun:
    """The run that all browsers of a server share, read again when it has changed, and what is known of its frames.
    Any thread may use it."""

    def __init__(self, path: Path, device: torch.device | None = None) -> None:
        """Raises NeecoError where `path` holds no scene, finished or not."""
        self.path, self.device = Path(path), device
        self._refreshing = threading.Lock()
        self._stamp = self._current_stamp()
        self.loaded = self._load()  # replaced as a whole: a reader never sees half of a change
        self.trouble = ""
        self.distance = self.loaded.distance  # mm
        self.unit = VIEWER.distance_units / self.distance  # viser's units per mm
        self.timeline = Timeline(self.loaded)
        self.ended = threading.Event()  # of `watch`

    def refresh(self) -> bool:
        """Read the run again if its files have changed, and score its frames anew; whether anything new was read. A run
        that cannot be read stays as it was, and `trouble` says why."""
        with self._refreshing:
            try:
                stamp = self._current_stamp()
                if stamp == self._stamp:
                    return False
                # before reading: what is written meanwhile is read the next time
                self._stamp = stamp
                self.loaded = self._load()
            except NeecoError as error:
                self.trouble = str(error)
                return False
            self.trouble = ""
            self.timeline = Timeline(self.loaded)
            score_frame.cache_clear()  # or it would hold the scenes of before
            return True

    def watch(self, changed: Callable[[], None]) -> None:
        """Look at the run folder from time to time, in a thread of its own, and call `changed` where it changed or can
        no longer be read; until `ended` is set."""

        def look() -> None:
            while not self.ended.wait(VIEWER.watch_s):
                trouble = self.trouble
                if self.refresh() or trouble != self.trouble:
                    changed()

        threading.Thread(target=look, name="neeco-watcher", daemon=True).start()

    def _current_stamp(self) -> tuple[str, int, int, int]:
        """File, its inode, time and size."""
        read_config(self.path)
        for file in (self.path / SCENE_FILE, checkpoint_path(self.path)):
            try:
                status = file.stat()
                return str(file), status.st_ino, status.st_mtime_ns, status.st_size
            except FileNotFoundError:
                continue
            except OSError as error:
                raise NeecoError(f"{file}: cannot read: {error.strerror or error}") from error
        raise NeecoError(f"{self.path}: has neither a finished scene nor a checkpoint yet; let `neeco train` write one")

    def _load(self) -> LoadedRun:
        config = read_config(self.path)
        iteration = None
        if (self.path / SCENE_FILE).is_file():
            scene = load_scene(self.path / SCENE_FILE)
        else:
            scene, header, _ = read_checkpoint(self.path)
            iteration = int(header["iteration"])
        if self.device is not None:
            scene = scene.to(self.device)
        capture, trouble, root = None, "", Path(config["capture"])
        try:
            if root.is_dir():
                capture = scene.recorded.completed(read_capture(root, config["transforms"]), scene.instruments)
            else:
                trouble = f"capture: {root} no longer exists: no recorded images to compare with"
        except NeecoError as error:
            trouble = str(error)
        if not scene.recorded.states and capture is None:
            raise NeecoError(f"{self.path}: the scene holds no frames, and its capture is missing; train again")
        frames = () if capture is None else capture.frames
        source = scene.recorded if capture is None else Recorded.of(frames, scene.instruments)
        order = np.argsort([state.time for state in source.states], kind="stable")
        names, splits, states, cameras = (
            tuple(column[k] for k in order) for column in (source.names, source.splits, source.states, source.cameras)
        )
        return LoadedRun(
            name=self.path.resolve().name,
            scene=scene,
            recorded=Recorded(names, splits, states, cameras, still=scene.recorded.still),
            frames=tuple(frames[k] for k in order) if frames else (),
            capture=capture,
            shafts=shafts_of(scene),
            iteration=iteration,
            trouble=trouble,
        )


@dataclass(frozen=True)
class FrameScore:
    """Score of one rendered frame against the recorded one."""

    psnr: float  # dB
    iou: float | None  # of all instruments together; None: there is no true mask, or the scene has no labels


@lru_cache(maxsize=4096)
@torch.no_grad()
def score_frame(loaded: LoadedRun, index: int) -> FrameScore:
    """Score one frame of `loaded.frames` as `neeco evaluate` does. Raises NeecoError for unreadable files."""
    frame = loaded.frames[index]
    counted = frame.load_mask()
    drawing = draw(loaded.scene, frame.state, frame.camera)
    overlap = None
    if drawing.parts is not None and loaded.capture is not None:
        reference = load_reference(loaded.capture, frame)
        if reference is not None:
            overlap = iou(drawing.parts > 0, reference.mask, counted)
    return FrameScore(psnr(drawing.image, frame.load_image(), counted), overlap)


class Timeline:
    """The PSNR of every frame of a recording, at no more than `timeline_width` px, computed a frame at a time. One
    thread computes; any may read."""

    def __init__(self, loaded: LoadedRun) -> None:
        self.loaded = loaded
        self.psnr = np.full(len(loaded.frames), np.nan)  # dB; NaN: not known
        self.count = 0  # frames that were looked at

    @property
    def done(self) -> bool:
        """Whether every frame is scored."""
        return self.count == len(self.psnr)

    def advance(self) -> bool:
        """Score one more frame; False: all are. One that cannot be read stays unknown: the status says so to whoever
        goes there."""
        if self.done:
            return False
        self.count += 1
        with self.loaded.scene.torch_threads(), contextlib.suppress(NeecoError):
            self.psnr[self.count - 1] = coarse_psnr(self.loaded, self.count - 1)
        return True

    @property
    def known(self) -> np.ndarray:
        """Frames [K], rising, whose PSNR is known and finite."""
        return np.flatnonzero(np.isfinite(self.psnr))

    def worst(self) -> list[int]:
        """The worst known frames, worst first; of similar neighbours only the worst."""
        frames, apart = self.known, max(1, len(self.psnr) // (4 * VIEWER.worst))
        chosen: list[int] = []
        for frame in frames[np.argsort(self.psnr[frames], kind="stable")].tolist():
            if all(abs(frame - other) >= apart for other in chosen):
                chosen.append(frame)
        return chosen[: VIEWER.worst]


@torch.no_grad()
def coarse_psnr(loaded: LoadedRun, index: int) -> float:
    """PSNR in dB of one frame, rendered and recorded at no more than `timeline_width` px. Raises NeecoError."""
    frame = loaded.frames[index]
    width = VIEWER.timeline_width if loaded.scene.has_gaussians else VIEWER.field_width
    camera = frame.camera.scaled(min(1.0, width / frame.camera.width))
    size = camera.width, camera.height
    image = cv2.resize(frame.load_image().numpy(), size, interpolation=cv2.INTER_AREA)
    mask = frame.load_mask()
    if mask is not None:
        mask = torch.from_numpy(cv2.resize(mask.numpy().astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)
    rendered = loaded.scene.render(frame.state, camera).color.clamp(0, 1).cpu()
    return psnr(rendered, torch.from_numpy(image), mask)


class SavedStates:
    """Writes into one run's folder `kept/`, whoever of several users asks. Any thread may call it. size: of images."""

    def __init__(self, run: Path, size: SizeSettings = RECORDED_SIZE) -> None:
        self.size = size
        self.folder = Path(run) / "kept"
        self.states_path = self.folder / "states.jsonl"  # for `synthesize --states`
        self._lock = threading.Lock()

    def add(self, loaded: LoadedRun, state: State, world_from_camera: np.ndarray) -> int:
        """Add a state and the camera [4, 4] that sees it (OpenCV axes, mm); returns how many are saved. Raises
        NeecoError where the file cannot be written, or holds states of another scene."""
        line = json.dumps(state_to_json(state) | {"camera": camera_to_json(world_from_camera)}, allow_nan=False)
        with self._lock, own_folder(self.folder, wait_s=LOCK_WAIT_S):
            count = len(self.read(loaded))
            before = read_text(self.states_path, "states").splitlines() if count else []
            write_text(self.states_path, "".join(f"{entry}\n" for entry in [*before, line]))
            return count + 1

    def read(self, loaded: LoadedRun) -> list[StateLine]:
        """Read the saved states, checked against the scene. Raises NeecoError."""
        if not self.states_path.exists():
            return []
        return read_states(self.states_path, loaded.scene.instruments)

    def save_image(self, loaded: LoadedRun, state: State, world_from_camera: np.ndarray) -> Path:
        """Write one labelled image as `synthesize` does, of the recorded cameras' intrinsics, as large as was asked;
        returns the image's path. Raises NeecoError for a scene without labels, and where it cannot be written."""
        scene = require_gaussians(loaded.scene, "save labelled image")
        labeller = CompositedLabels(scene)
        camera = DrawnCameras(self.size)(moved_camera(loaded.recorded.cameras[0], world_from_camera))
        with scene.torch_threads(), torch.no_grad():
            drawing = draw_layers(scene, labeller, state, camera, Settings.min_component)
            labels = labels_of(scene, drawing, annotate(scene, drawing, labeller.names))
        root = self.folder / "samples"
        with self._lock, own_folder(root, wait_s=LOCK_WAIT_S):
            index = 0
            while record_path(root, index).exists() and load_record(root, index) is not None:
                index += 1
            record = encoded_sample(index, drawing, labels).write(root)
        return root / record["image"]
