"""Thresholds of all checks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple


class Margin(NamedTuple):
    """Margin by which a correction must agree better with the images than what is recorded."""

    factor: float  # on the agreement
    certainty: float  # of the gain, standard errors over blocks of frames
    agreement: float  # that the correction must reach
    min_frames: int = 0  # that have it


@dataclass(frozen=True, kw_only=True)
class CheckSettings:
    """Thresholds of `neeco check`. Agreement: correlation of colours (cameras), or evidence of motion (states)."""

    # frames
    min_train_frames: int = 4  # fewer: nothing can be learned
    max_still_cameras: int = 2  # cameras of a scope that stands still: one, or the two of a stereo scope
    compared_width: int = 320  # px, width to which images are reduced before they are compared with points and states
    # states
    max_known_roll_deg: float = 45.0  # standard deviation above which a roll counts as unknown
    max_explained: float = 0.98  # share of a reading's variance that the other readings may explain
    min_states: int = 12  # for that share: fewer states explain each other anyway
    # placement
    few_points: int = 100  # sparse points below which they are called few
    max_distance: float = 10.0  # sizes of the scene
    far_distance: float = 100.0  # the same, beyond which lengths of cameras and points have different units
    min_visible: float = 0.1  # share of the points, or of the frames, below which something is out of view
    min_body_visible: float = 0.5  # share of the frames that show a point fixed to the instrument: its sensor is behind
    min_distance_mm: float = 1.0  # an endoscope is never this close, nor travel this short: lengths are in metres
    sensor_reach_mm: float = 500.0  # how far from the visible part of an instrument its sensor may sit
    # comparison with the images
    max_images: int = 84  # compared, evenly spaced over the capture
    quick_images: int = 12  # of these, with which corrections are first compared
    max_candidates: int = 3  # of each kind that are compared with all images
    blocks: int = 12  # of successive frames, whose gains count as independent
    rival: float = 0.9  # share of the best agreement from which a correction of another kind is as likely
    # colours of the sparse points
    min_images: int = 6  # for a mean correlation
    max_points: int = 800  # compared
    min_points: int = 30  # visible in an image, for a correlation
    min_brightness_sd: float = 2.0  # of 255; points of one colour cannot be compared
    min_contrast: float = 3.4  # of 255, of images: on plain cloth, the correlation is noise's or the instrument's
    neighbours: int = 8  # of a point, with which its brightness is compared
    far_neighbours: int = 48  # the same for the coarse correlation, which inaccurate cameras keep
    contradicted_colors: float = 0.1  # correlation below which images and cameras may contradict each other
    contradicted_coarsely: float = 0.25  # coarse correlation below which they then do
    good_colors: float = 0.4  # correlation from which only images of neighbouring frames are tried
    max_offset: int = 10  # frames by which images are tried against the cameras
    max_swapped: float = 0.5  # share of the colours' difference that is left when red and blue are swapped back
    camera: Margin = field(default=Margin(1.25, 5.0, 0.2))
    offset: Margin = field(default=Margin(1.02, 5.0, 0.2))  # a slow camera sees nearly the same in the next frame
    # motion in the images
    min_frames: int = 12  # with fewer, chance decides
    motion_width: int = 72  # px to which images are reduced: an instrument is some px wide, errors of depth are hidden
    predicting: int = 10  # frames of nearby cameras that predict one
    difference: tuple[float, float] = (15.0, 50.0)  # of 255, from the prediction: a pixel begins to move, moves fully
    depth_points: int = 8  # sparse points in view of a camera, to interpolate depths
    rays: int = 504  # moving pixels that are compared
    compared_rays: float = 0.4  # share of the rays: those which some poses explain best
    min_ray_evidence: float = 0.1  # of a ray that some poses explain
    contradicted_poses: float = 0.15  # evidence below which poses explain too little
    by_chance: float = 4.0  # times the evidence by chance below which they do
    by_chance_few: float = 1.5  # the same in few frames
    few_frames: int = 36  # frames in which chance explains much
    shuffles: int = 6  # orders of the poses whose mean evidence is that by chance
    named_by_chance: float = 3.0  # factor by which a correction explains more than the same poses in another order
    min_travel: float = 0.055  # of the image's width: the poses of any frame explain an instrument that moves less
    min_turning_deg: float = 25.0  # root mean square: other rotations explain smaller turns nearly as well, or better
    max_shift: float = 0.5  # of a recording, by which states are tried against the images
    max_shifts: int = 600  # that are tried over a whole recording
    rates: tuple[float, float, int] = (0.75, 1 / 0.75, 116)  # of a clock: least, greatest and number tried
    small_shift: int = 16  # steps of time, at most a fifth of a recording's: so small a shift explains much
    shift_radius: int = 5  # steps to either side of the likeliest shift, which are compared on the same frames
    scales: tuple[float, ...] = (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6, 2.0)  # of positions
    rotation: Margin = field(default=Margin(1.25, 3.0, 0.15))  # on the rays that they change most
    shift: Margin = field(default=Margin(1.15, 5.0, 0.2))
    pose: Margin = field(default=Margin(1.5, 5.0, 0.2, 45))  # of many candidates one may fit by chance, in fewer frames


SETTINGS = CheckSettings()
