"""From a recording to a capture: read, choose frames, find cameras, register, smooth, split, write."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from neeco.capture.model import (
    REFERENCE_PIXELS,
    Capture,
    Frame,
    InstrumentState,
    PointCloud,
    State,
    Uncertainty,
    evenly_spaced,
)
from neeco.capture.writer import write_capture
from neeco.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.ingest.cameras.sfm import StructureFromMotion
from neeco.ingest.cameras.still import LOOKED_AT, find_background, moving_masks, same_place, stands_still
from neeco.ingest.cameras.still_scene import RightCamera, look_behind, read_right_camera, seen_by, still_cameras
from neeco.ingest.convert import staged
from neeco.ingest.foreground.motion import ResidualFlow, RoughShape, best_lag, carve_shape, observations_on
from neeco.ingest.foreground.passing import passing_masks
from neeco.ingest.frames.images import ChosenImages
from neeco.ingest.frames.selection import LEFT_OUT
from neeco.ingest.frames.views import SfmResult, StageProgress, reduced
from neeco.ingest.posing.posed_capture import prepare
from neeco.ingest.readers.columns import CAMERA
from neeco.ingest.recording.model import STILL, Recording
from neeco.ingest.registration.base import BaseRegistration
from neeco.ingest.registration.clocks import doubt_frame_rates, find_instrument_clocks, open_clocks, register
from neeco.ingest.registration.find_bases import refuse_frames, require_no_base, take_bases
from neeco.ingest.registration.hand_eye import Registration
from neeco.ingest.result import IngestResult
from neeco.ingest.shaft.from_video import FoundShaft
from neeco.ingest.shaft.video_instruments import (
    NOT_SEEN,
    find_in_video,
    instruments_of,
    on_masks,
    seen_in_video,
    uncertainties,
)
from neeco.ingest.splits import split_frames
from neeco.ingest.timing.episodes import NAME_TISSUES, Episodes, separate
from neeco.ingest.timing.synchronized import States

SAME_PLACE = 0.4  # of the features of one episode's background in place in another's: less is elsewhere
MOSTLY_ALIKE = 0.7  # less is worth a note


def ingest(
    recording: Recording | Sequence[Recording],
    output: Path,
    progress: StageProgress,
    complete: Callable[[IngestResult, Path], None] = lambda result, folder: None,
) -> IngestResult:
    """Make the capture `output` from a recording, or from several of one instrument, and say how good it is.

    Nothing appears at `output` before the capture is whole: `complete` may add files to its `folder` before. Raises
    NeecoError for unusable input: file, row or key, and what to do.
    """
    recordings = separate([recording] if isinstance(recording, Recording) else recording)
    named = [recording for recording in recordings if recording.tissue is not None]
    if named:
        raise NeecoError(f"{named[0].path}: tissue: {named[0].tissue} is named; `ingest_tissues` makes such a capture")
    with staged(output) as folder:
        one = WorldIngest(recordings, folder, progress)
        capture, result = one.finish(output, one.place())
        write_capture(capture, folder / "capture")
        one.measure_roll(folder / "capture")
        complete(result, folder / "capture")
        return result


@dataclass(frozen=True)
class Placed:
    """What is known of one world before its frames are split: cameras, and states [M] at their times."""

    sfm: SfmResult
    pinhole: Lens
    registration: Registration | None
    shapes: dict[str, RoughShape]
    states: States
    usable: np.ndarray  # [M] bool
    right: RightCamera | None = None
    tissue: str | None = None  # how a still scope's tissue got its depth


class WorldIngest:
    """The ingest of one world under way, with a folder for everything temporary. tissue: that of the world, where there
    are several."""

    def __init__(
        self, recordings: Sequence[Recording], folder: Path, progress: StageProgress, tissue: str | None = None
    ) -> None:
        self.folder, self.progress = folder, progress
        progress("reading logs and video", 0, 0)
        self.data = Episodes(recordings, tissue)
        self.recording = self.data.recording
        self.settings = self.recording.settings
        self.size = self.data.video.size
        self.bases: dict[str, BaseRegistration] = {}  # by instrument, of those found
        self.moving: dict[int, np.ndarray] = {}  # video frame -> [h, w] what moves in it
        self.in_video = seen_in_video(self.data)
        self.shaft: FoundShaft | None = None
        self.masks = np.zeros((0, 1, 1), dtype=bool)  # [M, h, w] of the rows in which it was looked for
        self.shown = self.masks  # the same of the capture's frames
        self.scale = 1.0  # of cameras that nothing registers, beside a plausible one
        self.images = ChosenImages(self.data, folder, progress)
        self.selected = self.images.selected  # [K] video frames
        self.dropped = self.images.dropped  # video frame -> why
        (folder / "sfm").mkdir()
        self.pinhole = self.images.lens.pinhole(self.size) if self.images.lens else None

    def place(self) -> Placed:
        """Find cameras, registration and states."""
        if self._is_still():
            return self._place_still()
        refuse_frames(self.data, moving=True)
        self.motion = StructureFromMotion(
            self.folder / "sfm", self.data.video.path, self.folder / "raw", self.images.names, self.size, self.pinhole,
            self.images.visible, self.settings, self._episodes(),
        )  # fmt: skip
        sfm = self.motion.reconstruct(self.progress)
        self.data.refuse_alone(self.selected[sfm.indices])
        if self.pinhole is None:
            assert sfm.lens is not None
            self.pinhole = sfm.lens.pinhole(self.size)
            self.data.note(
                f"intrinsics were estimated by structure from motion (focal length {sfm.lens.fl_x:.1f} px, radial "
                f"distortion {sfm.lens.distortion[0]:.3f}); a calibration is better"
            )
            self.images.know_lens(sfm.lens)
        registration = self._register(sfm)
        self._find_instrument_clocks(sfm, self.pinhole)
        self._place_bases_seen_from(sfm, self.pinhole, registration)
        on_instruments, shapes = self._find_instruments(sfm, self.pinhole, registration)
        masks = np.zeros((0, 1, 1), dtype=bool)
        if self.in_video is not None:
            self.progress("finding what moves", 0, 0)
            masks = self._passing(sfm, self.pinhole)(np.arange(len(sfm.indices)))
            on_instruments |= on_masks(masks, sfm, self.size)
        before = sfm.indices
        sfm = self.motion.adjust(sfm, on_instruments, self.progress)
        registration = self._register(sfm)  # first: it may find clocks
        if self.in_video is not None:
            cameras, points = self._placed(sfm, registration)
            tissue = None
            if registration is None:
                tissue = float(np.median(np.linalg.norm(points[:, None] - cameras[None, ::10, :3, 3], axis=-1)))
            self._find_in_video(sfm, cameras, masks[np.isin(before, sfm.indices)], tissue)
        return Placed(sfm, self.pinhole, registration, shapes, *self.data.states_at(self._times(sfm)))

    def _is_still(self) -> bool:
        """Whether the scope stood still: as the recording says, else as its images do."""
        if self.recording.camera is not None:
            return self.recording.camera == STILL
        if self.recording.stereo is not None:
            return True
        self.progress("looking whether the scope moves", 0, 0)
        still = all(stands_still(self.images.loader(rows), len(rows)) for rows in self._rows_by_episode())
        if still:
            self.data.note("the scope stands still: nothing but what passes before it moves in the images")
        return still

    def _episodes(self) -> np.ndarray:
        """[K] the episode of every chosen frame."""
        return self.data.episode_of(self.selected)

    def _rows_by_episode(self) -> list[np.ndarray]:
        """Rows of the chosen frames, of every episode that has some."""
        return [np.flatnonzero(self._episodes() == episode) for episode in np.unique(self._episodes())]

    def _place_still(self) -> Placed:
        """The same for a scope that stands still: its frame is the world."""
        data, pinhole = self.data, self.pinhole
        if pinhole is None:
            raise NeecoError(
                f"{self.recording.path}: intrinsics: missing; images of a scope that stands still do not tell its "
                "lens; give fl_x, fl_y, cx, cy or a calibration"
            )
        if data.scope is not None:
            data.note(
                "the scope stands still: the laparoscope's log tells nothing that its images do not, and is ignored"
            )
        refuse_frames(self.data, moving=False)
        self._refuse_other_places()
        right = self._right_camera()
        cameras = still_cameras(len(self.selected))
        self._find_instrument_clocks(cameras, pinhole)
        self._place_bases(cameras, pinhole)
        visible = self.images.field_of_view()
        if self.in_video is not None:
            self.progress("finding what moves", 0, 0)
            masks = moving_masks(self.images.load, len(self.selected), cameras.indices, visible)
            self._find_in_video(cameras, cameras.world_from_camera, masks, None)
        names = [*data.world_from_base, *([self.in_video.name] if self.in_video else [])]
        tracked = {name: partial(data.instrument_poses, name, self._times(cameras)) for name in names}
        found = look_behind(
            self.images.load, len(self.selected), pinhole, visible, tracked, self._longest_lag(), self.settings, right,
            self.progress,
        )  # fmt: skip
        for note in found.notes:
            data.note(note)
        for name, lag in found.lags.items():
            self._doubt_motion(name, name in found.shapes, lag)
        placed = replace(cameras, points=found.points, colors=found.colors, errors=np.zeros(len(found.points)))
        placed = replace(placed, lengths=np.full(len(found.points), len(self.selected)))
        states, usable = data.states_at(self._times(placed))
        return Placed(placed, pinhole, None, found.shapes, states, usable, right, found.how)

    def _refuse_other_places(self) -> None:
        """Raise NeecoError when a still scope looked at something else in one episode than in another."""
        if self.data.single:
            return
        self.progress("comparing what the recordings show", 0, 0)
        backgrounds, episodes = [], []
        for rows in self._rows_by_episode():
            load = self.images.loader(rows[evenly_spaced(len(rows), LOOKED_AT)])
            found = find_background(load, min(len(rows), LOOKED_AT))
            backgrounds.append(np.clip(found.colors, 0, 255).astype(np.uint8))
            episodes.append(int(self._episodes()[rows[0]]))
        for background, episode in zip(backgrounds[1:], episodes[1:], strict=True):
            share = same_place(backgrounds[0], background)
            first, part = self.data.names[episodes[0]], self.data.parts[episode]
            if share is not None and share < SAME_PLACE:
                raise NeecoError(
                    f"{part.recording.path}: {self.data.names[episode]} shows another place than {first}: {share:.0%} "
                    f"of the background is where it was; where that is another tissue, or the scope stands elsewhere, "
                    f"{NAME_TISSUES}"
                )
            if share is not None and share < MOSTLY_ALIKE:
                self.data.note(
                    f"{1 - share:.0%} of the background is not where it was in {first}: what changed is blurred",
                    episode,
                )

    def _place_bases(self, cameras: SfmResult, pinhole: Lens) -> None:
        """Say of every instrument of a still scope how the frame of its log's poses stands to the camera, as far as
        that is known (`SynchronizedRecording.world_from_base`): it is the camera's, is stated, or is found from what
        moves."""
        data, visible = self.data, self.images.field_of_view()
        for name, log in data.poses.items():
            if log.frame == CAMERA:
                data.world_from_base[name] = np.eye(4)
        self._find_bases(
            cameras, cameras.world_from_camera, pinhole,
            lambda rows: moving_masks(self.images.load, len(self.selected), rows, visible),
        )  # fmt: skip
        unplaced = [name for name in data.poses if name not in data.world_from_base]
        if unplaced:
            data.note(
                f"nothing says how the poses of {', '.join(unplaced)} stand to the camera (poses: {{frame: camera}}, "
                "or camera_from_base): they stay in their own frame (unregistered)"
            )

    def _place_bases_seen_from(self, sfm: SfmResult, pinhole: Lens, registration: Registration | None) -> None:
        """The same for a scope that moves, whose tracker's frame is the world. Raises NeecoError where nothing ties the
        cameras to it."""
        if registration is None:
            require_no_base(self.data)
            return
        cameras = registration.cameras(sfm.world_from_camera)
        self._find_bases(sfm, cameras, pinhole, self._passing(sfm, pinhole))

    def _passing(self, sfm: SfmResult, pinhole: Lens) -> Callable[[np.ndarray], np.ndarray]:
        """What gives the masks of what passes before the tissue, bool [R, h, w], in some rows of `sfm`."""
        flow, load = self._residual_flow(sfm, pinhole), self.images.loader(sfm.indices)
        return lambda some: passing_masks(load, flow, some, self.settings.moving_px, self.images.field_of_view())

    def _find_in_video(self, sfm: SfmResult, cameras: np.ndarray, masks: np.ndarray, tissue: float | None) -> None:
        """Find the instrument that nothing tracked before `cameras` [M, 4, 4], in the rows of `sfm`."""
        assert self.in_video is not None
        assert self.pinhole is not None
        self.progress("finding the shaft", 0, 0)
        self.masks = masks
        small = Lens.of(self.pinhole.camera(np.eye(4)).within(REFERENCE_PIXELS))
        self.shaft = find_in_video(
            self.data, self.in_video, self.images.loader(sfm.indices), masks, cameras, self._times(sfm),
            self._episodes()[sfm.indices], small, tissue,
        )  # fmt: skip
        self.scale = self.shaft.axes.scale

    def _find_bases(
        self,
        sfm: SfmResult,
        cameras: np.ndarray,
        pinhole: Lens,
        moving: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        """Take the bases as stated, or find them from what moves before `cameras`, of the rows of `sfm`; see
        `place_bases`."""
        if any(item.base is not None for item in self.recording.instruments):
            self.progress("finding the robot's base", 0, 0)
            visible = self.images.field_of_view()
            hidden = None if visible is None else reduced(visible.astype(np.uint8) * 255) < 255
            self.bases = take_bases(
                self.data, self._times(sfm), cameras, pinhole, self.images.loader(sfm.indices), moving, hidden
            )

    def _right_camera(self) -> RightCamera | None:
        if self.recording.stereo is None:
            return None
        names = [self.data.frame_name(int(frame)) for frame in self.selected]
        cameras = []
        for episode, part in enumerate(self.data.parts):
            rows = np.flatnonzero(self._episodes() == episode)
            assert part.recording.stereo is not None
            found = read_right_camera(
                part.recording.stereo, self.selected[rows] - self.data.first[episode], part.times,
                [names[row] for row in rows], self.folder / "right", self.progress,
            )  # fmt: skip
            cameras.append(replace(found, names={int(rows[row]): name for row, name in found.names.items()}))
        return replace(cameras[0], names={row: name for camera in cameras for row, name in camera.names.items()})

    def _times(self, sfm: SfmResult) -> np.ndarray:
        """[M] s of the frames that got a camera."""
        return self.data.times[self.selected[sfm.indices]]

    def _register(self, sfm: SfmResult) -> Registration | None:
        """SfM's frame to the tracker's, where the scope was tracked and moved enough; else None, with a note why."""
        frames = self.selected[sfm.indices]
        return register(self.data, sfm.world_from_camera, self._times(sfm), frames, self.settings)

    def _residual_flow(self, sfm: SfmResult, pinhole: Lens) -> ResidualFlow:
        load, episodes = self.images.loader(sfm.indices), self._episodes()[sfm.indices]
        return ResidualFlow(load, sfm, self._times(sfm), pinhole, self.images.field_of_view(), episodes)

    def _find_instrument_clocks(self, sfm: SfmResult, pinhole: Lens) -> None:
        """Clocks that the scope did not give, from how the instruments move in the images."""
        if open_clocks(self.data):
            self.progress("finding the instrument's clock", 0, 0)
            flow, frames = self._residual_flow(sfm, pinhole), self.selected[sfm.indices]
            find_instrument_clocks(self.data, flow, self._times(sfm), frames)

    def _find_instruments(
        self, sfm: SfmResult, pinhole: Lens, registration: Registration | None
    ) -> tuple[np.ndarray, dict[str, RoughShape]]:
        """bool [Q]: observations on an instrument, whose rough shape is carved from what moves with its pose."""
        on_instruments = np.zeros(len(sfm.observations), dtype=bool)
        if registration is None:
            return on_instruments, {}
        self.progress("finding the instrument", 0, 0)
        rows = np.unique(np.linspace(0, len(sfm.indices) - 1, self.settings.shape_frames).astype(int))
        flow = self._residual_flow(sfm, pinhole)
        evidence = flow.moving_pixels(rows, self.settings.moving_px)
        self.moving = dict(zip(self.selected[sfm.indices[rows]].tolist(), evidence, strict=True))
        cameras, points = registration.cameras(sfm.world_from_camera), registration.points(sfm.points)
        shapes = {}
        for name in self.data.poses:
            poses, valid = self.data.instrument_poses(name, self._times(sfm))
            camera_from_instrument = np.linalg.inv(cameras) @ np.where(valid[:, None, None], poses, np.eye(4))
            usable = valid[rows]
            shape = carve_shape(evidence[usable], camera_from_instrument[rows[usable]], flow.pinhole)

            def before_cameras(lag: float, of: str = name) -> tuple[np.ndarray, np.ndarray]:
                poses, known = self.data.instrument_poses(of, self._times(sfm)[rows], lag)
                return np.linalg.inv(cameras[rows]) @ np.where(known[:, None, None], poses, np.eye(4)), known

            lag = best_lag(evidence, before_cameras, flow.pinhole, self._longest_lag())
            self._doubt_motion(name, shape is not None, lag)
            if shape is None:
                continue
            shapes[name] = shape
            for row in np.flatnonzero(valid):
                on_instruments |= observations_on(
                    shape, camera_from_instrument[row], sfm, int(row), points, flow.pinhole.camera(cameras[row])
                )
        return on_instruments, shapes

    def _longest_lag(self) -> float:
        """s by which the poses of a log may be off its clock: what is longer leaves half of the frames none."""
        return float(max(np.ptp(part.times) for part in self.data.parts)) / 2

    def _doubt_motion(self, name: str, moves: bool, lag: float) -> None:
        """Doubt an instrument whose poses nothing in the images moves with, or moves with at another time."""
        clock, sentence = self.data.poses[name].clock if name in self.data.poses else "", ""
        if lag and not self.data.is_doubted(f"sync {clock}"):
            after = "later" if lag > 0 else "earlier"
            sentence = (
                f"what moves in the images fits the poses of {name} that its log has {abs(lag):.1f} s {after}: is its "
                f"clock {clock!r} that of the other logs? Give it one of its own (poses: clock), or correct `sync`"
            )
        elif lag or not moves:
            sentence = (
                f"nothing in the images moves with the tracked pose of {name}: check its log, its frame and its clock"
            )
        self.data.doubt(f"motion of {name}", sentence, severe=True)

    def finish(
        self, output: Path, placed: Placed, everywhere: dict[str, dict[str, np.ndarray]] | None = None
    ) -> tuple[Capture, IngestResult]:
        """Splits, and the capture, whose images are in the ingest's folder. everywhere: the readings over all tissues,
        by instrument and joint, where there are several."""
        data, sfm, registration, tissue = self.data, placed.sfm, placed.registration, placed.tissue
        states, usable = placed.states, placed.usable
        doubt_frame_rates(data)
        for index in set(range(len(self.selected))) - set(sfm.indices.tolist()):
            self.dropped[int(self.selected[index])] = "no camera: too few of its features match other frames"
        frames, times = self.selected[sfm.indices], self._times(sfm)
        cameras, points = self._placed(sfm, registration)
        for frame in frames[~usable]:
            unseen = self.shaft is not None and not self.shaft.known[np.flatnonzero(frames == frame)[0]]
            self.dropped[int(frame)] = NOT_SEEN if unseen else "no instrument state at its time (gap in a log)"
        sure = uncertainties(self.in_video, self.shaft) if self.in_video and self.shaft else None
        splits, rule = split_frames(data, frames, states, usable, everywhere)
        chosen = np.flatnonzero(usable & (splits != LEFT_OUT))
        for frame in frames[usable & (splits == LEFT_OUT)]:
            self.dropped[int(frame)] = "beside an unseen frame"
        capture_frames = tuple(
            Frame(
                self.images.named(int(frames[i])),
                placed.pinhole.camera(cameras[i]),
                _state(states, i, float(times[i]), None if sure is None else sure[i]),
                splits[i],
                self.images.mask_of(int(frames[i])),
            )
            for i in chosen.tolist()
        )
        if placed.right is not None:  # one camera more to learn from; what is tested stays one
            capture_frames += seen_by(placed.right, capture_frames, sfm.indices[chosen].tolist())
        reliable = sfm.reliable_points()
        if not reliable.any():
            reliable = np.ones(len(sfm.points), dtype=bool)
            data.note("no tissue point is seen by several frames and fits well: all of them are kept")
        cloud = PointCloud(points[reliable].astype(np.float32), (sfm.colors[reliable] / 255).astype(np.float32))
        instruments = instruments_of(self.recording, self.shaft)
        registered = registration is not None or set(data.poses) <= set(data.world_from_base)
        assert self.images.lens is not None
        lens = replace(self.images.lens, size=self.size, border=self.images.border)
        capture = Capture(
            self.folder, capture_frames, instruments, cloud, registered=registered, lens=lens, still=tissue is not None
        )
        if len(capture_frames) == len(chosen):  # of a second camera no masks are known
            self.shown = self.masks[chosen] if self.in_video is not None else self.masks
        position = {row: index for index, row in enumerate(chosen.tolist())}
        registered_rows = [position.get(int(row), -1) for row in registration.used] if registration else []
        result = IngestResult(
            output,
            ", ".join(dict.fromkeys(str(part.recording.path) for part in data.parts)),
            len(data.times),
            float(1 / np.median(np.diff(data.times))),
            self.size,
            frames[chosen],
            times[chosen],
            tuple(sorted(self.dropped.items())),
            data.found_clocks,
            registration,
            np.array(registered_rows),
            None if tissue is not None else sfm.reprojection_px,
            int(reliable.sum()),
            placed.shapes,
            tissue,
            rule,
            tuple(data.notes),
            () if tissue is not None else self.motion.search,
            self._unregistered(states, times, chosen) if registration is not None else {},
            self.moving,
            registered,
            self.bases,
            data.ranges,
            () if self.in_video is None else (self.in_video.name,),
            dict(zip(data.ranges, data.starts.tolist(), strict=False)),
            data.doubts,
        )
        return capture, result

    def measure_roll(self, capture: Path) -> None:
        """Measure in the written capture what its images say of the roll and the joints of an instrument that nothing
        tracked, for `neeco view --annotate`; nothing where the roll was logged."""
        if self.in_video is None or self.in_video.roll is not None or not len(self.shown):
            return
        self.progress("measuring roll and joints", 0, 0)
        prepare(capture, {self.in_video.name: lambda frame: self.shown[frame]})

    def _unregistered(self, states: States, times: np.ndarray, chosen: np.ndarray) -> dict[str, np.ndarray]:
        """`IngestResult.unregistered`, of the `chosen` of frames at times [M] s."""
        assert self.data.scope is not None
        sensors = self.data.logged_scope(times[chosen])
        return {name: np.linalg.inv(sensors) @ poses[chosen] for name, (poses, _) in states.items()}

    def _placed(self, sfm: SfmResult, registration: Registration | None) -> tuple[np.ndarray, np.ndarray]:
        """Cameras [M, 4, 4] and points [P, 3] in mm: the tracker's, or SfM's frame at a plausible size."""
        if self.pinhole is not None and len(sfm.observations) == 0:  # a still scope's
            return sfm.world_from_camera, sfm.points
        if registration is not None:
            return registration.cameras(sfm.world_from_camera), registration.points(sfm.points)
        distances = np.linalg.norm(sfm.points[:, None] - sfm.world_from_camera[None, ::10, :3, 3], axis=-1)
        scale = self.scale * self.settings.scene_distance_mm / float(np.median(distances))
        cameras = sfm.world_from_camera.copy()
        cameras[:, :3, 3] *= scale
        return cameras, sfm.points * scale


def _state(states: States, row: int, time: float, sure: Uncertainty | None) -> State:
    instruments = {
        name: InstrumentState(
            torch.from_numpy(poses[row].copy()),
            {joint: float(values[row]) for joint, values in joints.items()},
            uncertainty=sure,
        )
        for name, (poses, joints) in states.items()
    }
    return State(instruments, time)
