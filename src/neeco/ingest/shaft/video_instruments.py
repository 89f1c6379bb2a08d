"""The instrument of a recording that nothing tracked: found in the video, then used as if a tracker had logged it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.model import FromVideo, Instrument, Uncertainty
from neeco.ingest.frames.images import SfmResult, Views, reduced
from neeco.ingest.recording.model import InstrumentLogs, Recording
from neeco.ingest.shaft.axis import ShaftVideo
from neeco.ingest.shaft.from_video import MIN_SHARE, FoundShaft, find_shaft
from neeco.ingest.timing.episodes import Episodes

NOT_VISIBLE = "too little of the shaft is visible"
ROLL_DEG = 5.0  # standard deviation of a logged roll
READING_DEG = 1.0  # of a logged joint
MARGIN_PX = 7  # about what moves, in which features are not the tissue's


def find_in_video(
    data: Episodes, item: InstrumentLogs, views: Views, masks: np.ndarray, tissue: float | None
) -> tuple[Episodes, FoundShaft]:
    """Find the instrument `item` in the views; return the episodes that have its poses, and what was found.

    masks bool [M, h, w] of the images reduced; tissue: its distance in the unit of the views' cameras, None where that
    is mm. Raises NeecoError, naming the recording, where too little of the instrument is observed.
    """
    asked = item.from_video
    assert asked is not None
    images = np.stack([reduced(views.load(row)) for row in range(len(views.times))])
    shared = ShaftVideo(
        world_from_camera=views.world_from_camera,
        times=views.times,
        episodes=views.episodes,
        radius=asked.shaft_diameter_mm / 2,
        intrinsics=views.reduced_pinhole.intrinsics,
        trocar=True,
        scaled=tissue is None,
    )
    try:
        found = find_shaft(images, masks, shared, asked.working_length_mm, asked.fixed_trocar, tissue or np.inf)
    except NeecoError as error:
        raise NeecoError(f"{data.recording.path}: instrument {item.name!r}, from video: {error}") from error
    data.notes.add(_in_words(item.name, found))
    for note in found.notes:
        data.notes.add(f"instrument {item.name!r}, from video: {note}")
    if item.roll is None:
        data.notes.add(
            f"instrument {item.name!r}: its roll is not known (180 degrees in every state's uncertainty); log it, or "
            "pose frames by hand (`neeco view CAPTURE --annotate`)"
        )
    poses = views.times[found.known], found.poses[found.known]
    return replace(data, video_poses={**data.video_poses, item.name: poses}), found


def _in_words(name: str, found: FoundShaft) -> str:
    shifts = np.array([item.translation_mm for item in found.uncertainties])[found.known]
    turns = np.array([item.rotation_deg[:2] for item in found.uncertainties])[found.known].max(1)
    left_out = int((~found.known).sum())
    scale = ""
    if found.axes.scale_sd is not None:
        scale = f"; the cameras' scale is known to {found.axes.scale_sd:.0%}, from the trocar"
    return (
        f"instrument {name!r} was found in the video: {found.share:.0%} of the frames show two diameters of its shaft "
        f"({MIN_SHARE:.0%} are needed); {left_out} of {len(found.known)} show too little of it and are left out; its "
        f"direction has a standard deviation of {np.median(turns):.1f} degrees, its place of "
        f"{np.median(shifts[:, :2]):.1f} mm across the view and {np.median(shifts[:, 2]):.1f} mm in depth; from the "
        f"end of the shaft to the tip it is {found.working_length:.0f} mm{scale}"
    )


def on_masks(masks: np.ndarray, sfm: SfmResult, size: tuple[int, int]) -> np.ndarray:
    """Return bool [Q], the observations of `sfm` on or near masks bool [M, h, w] of its rows. size: of the images whose
    pixels they count."""
    around = np.stack([cv2.dilate(mask.astype(np.uint8), np.ones((MARGIN_PX, MARGIN_PX), np.uint8)) for mask in masks])
    _, height, width = masks.shape
    row, x, y = (sfm.observations[:, column] for column in (0, 2, 3))
    column = np.clip(x * width / size[0], 0, width - 1).astype(int)
    return np.asarray(around[row.astype(int), np.clip(y * height / size[1], 0, height - 1).astype(int), column] > 0)


def uncertainties(item: InstrumentLogs, found: FoundShaft) -> tuple[Uncertainty, ...]:
    """Return the uncertainty of every state, with that of logged rolls and joints."""
    assert item.from_video is not None
    known = found.uncertainties
    if item.roll is not None:
        known = tuple(replace(one, rotation_deg=(*one.rotation_deg[:2], ROLL_DEG)) for one in known)
    joints = dict.fromkeys(item.joints, READING_DEG)
    return tuple(replace(one, joints_deg=joints) for one in known)


def instruments_of(recording: Recording, found: FoundShaft | None) -> tuple[Instrument, ...]:
    """Return the instruments of a recording for its capture. found: the one that was found in the video."""
    stated = []
    for item in recording.instruments:
        if item.placed:
            limits = {name: source.limits for name, source in item.joints.items()}
            in_video = None
            if found is not None and item.from_video is not None:
                in_video = FromVideo(item.from_video.shaft_diameter_mm, found.working_length)
            stated.append(Instrument(item.name, limits, item.kinematics, from_video=in_video))
    return tuple(stated)
