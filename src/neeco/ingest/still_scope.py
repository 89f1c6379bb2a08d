"""The world of a scope that stands still: its own frame, in which robot bases and the tissue are found."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.model import SEPARATE_TISSUES, PointCloud, evenly_spaced
from neeco.ingest.cameras.still_scene import (
    N_FRAMES,
    RightCamera,
    look_behind,
    read_right_camera,
    same_place,
    stands_still,
    still_cameras,
)
from neeco.ingest.foreground.background import find_background
from neeco.ingest.foreground.masks import moving_masks
from neeco.ingest.frames.images import ChosenImages
from neeco.ingest.frames.views import StageProgress
from neeco.ingest.readers.columns import CAMERA
from neeco.ingest.recording.model import MOVING, STILL
from neeco.ingest.registration.clocks import find_instrument_clocks
from neeco.ingest.registration.find_bases import check_reference_frames, find_bases
from neeco.ingest.shaft.from_video import find_in_video
from neeco.ingest.timing.episodes import Episodes
from neeco.ingest.timing.reading import require_lens
from neeco.ingest.world import (
    World,
    longest_lag,
    note_motion_contradiction,
    residual_flow,
)

SAME_PLACE = 0.4  # of the features of one episode's background in place in another's: less is elsewhere
SAME_MOMENT_S = 1e-3  # between two cameras' images
MOSTLY_SIMILAR = 0.7  # less is worth a note


def is_still(data: Episodes, images: ChosenImages, progress: StageProgress) -> bool:
    """Return whether the scope stands still: as the recording states, else as its images show."""
    stated, stereo = data.recording.camera, data.recording.stereo is not None
    if stereo and stated == MOVING:
        data.notes.add("stereo: the second camera of a scope that moves is not used")
    if stated is not None:
        return stated == STILL
    progress("looking whether the scope moves", 0, 0)
    still = all(stands_still(images.loader(rows), len(rows)) for rows in _rows_by_episode(data, images).values())
    if still:
        data.notes.add("the scope stands still: nothing but the foreground moves in the images")
    elif stereo:
        sentence = "its second camera is for a scope that stands still, and the background moves: state `camera`"
        data.notes.contradict("scope", sentence, severe=False)
    return still or stereo


def find_still_world(data: Episodes, images: ChosenImages, folder: Path, progress: StageProgress) -> World:
    """Find clocks, bases, instruments and tissue in front of a scope whose frame is the world.

    folder: for temporary files. Raises NeecoError for an unknown lens.
    """
    require_lens(data.recording, images.lens)
    if data.parts[0].scope is not None:
        data.notes.add("the scope stands still: the laparoscope's log adds nothing to its images, and is ignored")
    check_reference_frames(data, moving=False)
    _check_one_place(data, images, progress)
    right = _right_camera(data, images, folder, progress)
    count = len(images.selected)
    cameras = still_cameras(count)
    views = images.views(data, cameras.indices, cameras.world_from_camera)

    def moving(rows: np.ndarray) -> np.ndarray:
        return moving_masks(views.load, count, rows, views.visible)

    data = find_instrument_clocks(data, residual_flow(cameras, views), views, progress)
    in_camera = [name for name, log in data.parts[0].poses.items() if log.frame == CAMERA]
    data = replace(data, world_from_base={name: np.eye(4) for name in in_camera})
    data, bases = find_bases(data, views, moving, progress)
    if unplaced := [name for name in data.parts[0].poses if name not in data.world_from_base]:
        data.notes.add(
            f"nothing states how the poses of {', '.join(unplaced)} stand to the camera (poses: {{frame: camera}}, "
            "or camera_from_base): they stay in their own frame (unregistered)"
        )
    shaft = masks = None
    if data.video_instrument is not None:
        progress("finding what moves", 0, 0)
        masks = moving(cameras.indices)
        progress("finding the shaft", 0, 0)
        data, shaft = find_in_video(data, data.video_instrument, views, masks, None)
    data = data.with_assumed_clocks()
    names = (*data.world_from_base, *data.video_poses)
    tracked = {name: partial(data.instrument_poses, name, views.times) for name in names}
    progress("finding the tissue behind the instrument", 0, 0)
    behind = look_behind(views, tracked, longest_lag(data), data.recording.settings, right)
    for note in behind.notes:
        data.notes.add(note)
    data.notes.contradict("stereo", behind.doubt, severe=True)
    for name, lag in behind.lags.items():
        note_motion_contradiction(data, name, name in behind.shapes, lag)
    states, usable = data.states_at(views.times)
    return World(
        data=data, images=images, views=views, states=states, usable=usable,
        tissue=PointCloud(behind.points.astype(np.float32), (behind.colors / 255).astype(np.float32)),
        shapes=behind.shapes, bases=bases, shaft=shaft, masks=masks, still=True, depth_source=behind.how,
        right=right,
    )  # fmt: skip


def _rows_by_episode(data: Episodes, images: ChosenImages) -> dict[int, np.ndarray]:
    """Return the rows of the chosen frames, by episode, of those that have some."""
    episodes = data.episode_of(images.selected)
    return {int(episode): np.flatnonzero(episodes == episode) for episode in np.unique(episodes)}


def _check_one_place(data: Episodes, images: ChosenImages, progress: StageProgress) -> None:
    """Raise NeecoError for an episode in which a still scope looked at something else than in the first."""
    if data.single:
        return
    progress("comparing what the recordings show", 0, 0)
    backgrounds = {}
    for episode, rows in _rows_by_episode(data, images).items():
        load = images.loader(rows[evenly_spaced(len(rows), N_FRAMES)])
        found = find_background(load, min(len(rows), N_FRAMES))
        backgrounds[episode] = np.clip(found.colors, 0, 255).astype(np.uint8)
    first, *others = backgrounds
    for episode in others:
        share = same_place(backgrounds[first], backgrounds[episode])
        name, before = data.parts[episode].name, data.parts[first].name
        if share is not None and share < SAME_PLACE:
            raise NeecoError(
                f"{data.parts[episode].recording.path}: {name} shows another place than {before}: {share:.0%} of "
                f"the background is where it was; ingest each place alone; of several tissues, {SEPARATE_TISSUES}"
            )
        if share is not None and share < MOSTLY_SIMILAR:
            data.notes.add(
                f"{1 - share:.0%} of the background is not where it was in {before}: what changed is blurred", episode
            )


def _right_camera(data: Episodes, images: ChosenImages, folder: Path, progress: StageProgress) -> RightCamera | None:
    """Write the right camera's images of all episodes into `folder`."""
    if data.recording.stereo is None:
        return None
    names = [data.frame_name(int(frame)) for frame in images.selected]
    cameras = []
    for episode, rows in _rows_by_episode(data, images).items():
        part = data.parts[episode]
        own, stems = images.selected[rows] - part.first_frame, [names[row] for row in rows]
        found = read_right_camera(part.recording, own, part.times, stems, folder / "right", progress)
        moved = {row: int(rows[row]) for row in found.names}
        late = np.array([*found.delays.values()])
        if np.median(np.abs(late)) > SAME_MOMENT_S:
            data.notes.add(
                f"the right camera's images were taken {1000 * np.median(late):+.0f} ms after the left one's (median; "
                f"{1000 * late.min():+.0f} to {1000 * late.max():+.0f} ms): theirs are the states of these moments",
                episode,
            )
        cameras.append(
            replace(
                found,
                names={moved[row]: name for row, name in found.names.items()},
                delays={moved[row]: delay for row, delay in found.delays.items()},
            )
        )
    return replace(
        cameras[0],
        names={row: name for camera in cameras for row, name in camera.names.items()},
        delays={row: delay for camera in cameras for row, delay in camera.delays.items()},
    )
