"""Thresholds of all checks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple


class Margin(NamedTuple):
    """Margin by which a correction must agree better with the images than the recorded data."""

    factor: float  # factor on the agreement
    certainty: float  # of the gain, in standard errors over blocks of frames
    agreement: float  # minimum agreement of the correction
    min_frames: int = 0  # minimum number of frames


@dataclass(frozen=True, kw_only=True)
class CheckSettings:
    """Thresholds of `neeco check`. Agreement: correlation of colours (cameras), or evidence of motion (states)."""

    # frames
    min_train_frames: int = 4  # minimum number for learning
    max_still_cameras: int = 2  # cameras of a scope that stands still: one, or the two of a stereo scope
    compared_width: int = 320  # px, width to which images are reduced before they are compared with points and states
    # states
    max_known_roll_deg: float = 45.0  # standard deviation above which a roll counts as unknown
    max_explained: float = 0.98  # share of a reading's variance that other readings may explain
    min_states: int = 12  # minimum number for that share; fewer states explain each other anyway
    # placement
    few_points: int = 100  # number of sparse points below which a warning is issued
    max_distance: float = 10.0  # in units of the scene's size
    far_distance: float = 100.0  # in the same unit, beyond which cameras and points have different units of length
    min_visible: float = 0.1  # share of the points, or of the frames, below which something is out of view
    min_body_visible: float = 0.5  # share of frames that show a point fixed to the instrument (its sensor is behind it)
    min_distance_mm: float = 1.0  # mm; smaller distances of an endoscope or travel indicate lengths in metres
    sensor_reach_mm: float = 500.0  # mm, maximum distance of a sensor from the visible part of its instrument
    # comparison with the images
    max_images: int = 84  # maximum number of compared images, evenly spaced
    quick_images: int = 12  # number of these for a first comparison
    max_candidates: int = 3  # candidates of each kind compared with all images
    blocks: int = 12  # blocks of successive frames that count as independent
    rival: float = 0.9  # share of the best agreement above which a correction of another kind is equally likely
    # colours of the sparse points
    min_images: int = 6  # minimum number for a mean correlation
    max_points: int = 800  # compared
    min_points: int = 30  # minimum number visible in an image for a correlation
    min_brightness_sd: float = 2.0  # of 255; points of one colour cannot be compared
    min_contrast: float = 3.4  # of 255; on plain cloth, the correlation would be due to noise or the instrument
    neighbours: int = 8  # neighbours of a point for relative brightness
    far_neighbours: int = 48  # the same for the coarse correlation, which is robust to inaccurate cameras
    contradicted_colors: float = 0.1  # correlation below which images and cameras may contradict each other
    contradicted_coarsely: float = 0.25  # coarse correlation below which they do so
    good_colors: float = 0.4  # correlation above which only images of neighbouring frames are tried
    max_offset: int = 10  # maximum offset in frames between images and cameras
    max_swapped: float = 0.5  # maximum remaining share of the colour difference after exchanging red and blue
    camera: Margin = field(default=Margin(1.25, 5.0, 0.2))
    offset: Margin = field(default=Margin(1.02, 5.0, 0.2))  # a slow camera sees nearly the same in the next frame
    # motion in the images
    min_frames: int = 12  # minimum number; with fewer, results are random
    motion_width: int = 72  # px to which images are reduced: an instrument is some px wide, errors of depth are hidden
    predicting: int = 10  # frames of nearby cameras that predict each frame
    difference: tuple[float, float] = (15.0, 50.0)  # of 255: difference from the prediction at motion 0 and 1
    depth_points: int = 8  # minimum sparse points in view for interpolating depths
    rays: int = 504  # maximum number of moving pixels compared
    compared_rays: float = 0.4  # share of the rays compared: those best explained by any poses
    min_ray_evidence: float = 0.1  # minimum for an explained ray
    contradicted_poses: float = 0.15  # evidence below which poses are contradicted
    by_chance: float = 4.0  # minimum ratio to the evidence of shuffled poses
    by_chance_few: float = 1.5  # the same in few frames
    few_frames: int = 36  # number of frames below which shuffled poses explain much
    shuffles: int = 6  # number of shuffles
    named_by_chance: float = 3.0  # minimum ratio of a correction's evidence to that of its shuffled poses
    min_travel: float = 0.055  # of the image width: smaller motion is explained by any poses
    min_turning_deg: float = 25.0  # RMS: smaller rotations do not discriminate between rotation candidates
    max_shift: float = 0.5  # maximum time shift of states, as a share of a recording
    max_shifts: int = 600  # maximum number of shifts
    rates: tuple[float, float, int] = (0.75, 1 / 0.75, 116)  # rates of a clock: minimum, maximum, number
    small_shift: int = 16  # steps of time, at most a fifth of a recording's, up to which shifts explain much
    shift_radius: int = 5  # steps around the most likely shift that are compared on the same frames
    scales: tuple[float, ...] = (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6, 2.0)  # of positions
    rotation: Margin = field(default=Margin(1.25, 3.0, 0.15))  # on the rays with the largest difference
    shift: Margin = field(default=Margin(1.15, 5.0, 0.2))
    pose: Margin = field(default=Margin(1.5, 5.0, 0.2, 45))  # of many candidates one may fit by chance, in fewer frames


SETTINGS = CheckSettings()
