"""The chosen frames of a recording: sharp ones that differ, spread over states and views; as images, they are written,
undistorted once the lens is known; their dark border and a console's overlay are masked. Also their cameras, once these
are found."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy import ndimage

from neeco.base.errors import NeecoError
from neeco.base.files import write_unsynced
from neeco.capture.images import PIXELS, encoded_rgb, is_repeated, open_image, write_labels
from neeco.capture.model import REFERENCE_PIXELS, evenly_spaced
from neeco.geometry.lens import Border, Lens
from neeco.ingest.calibration.lens import BORDERS, find_border, visible_mask
from neeco.ingest.readers import VideoSource
from neeco.ingest.recording.model import MIN_FRAMES
from neeco.ingest.timing.episodes import Episodes

StageProgress = Callable[[str, int, int], None]  # what, how many done, of how many (0: not known)


@dataclass(frozen=True, eq=False, kw_only=True)
class SfmResult:
    """A reconstruction by structure from motion, in a frame and unit of its own."""

    indices: np.ndarray  # [M] which of the given images got a camera
    world_from_camera: np.ndarray  # [M, 4, 4] OpenCV axes
    points: np.ndarray  # [P, 3]
    colors: np.ndarray  # [P, 3] uint8
    errors: np.ndarray  # [P] px
    lengths: np.ndarray  # [P] images that observe the point
    observations: np.ndarray  # [Q, 5] row of world_from_camera, point, x px, y px, number of the image's feature
    lens: Lens | None  # estimated; None where it was given
    reprojection_px: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Views:
    """Chosen frames that have a camera, in the frame and unit of their cameras."""

    rows: np.ndarray  # [M] of the chosen frames
    frames: np.ndarray  # [M] numbers of the video frames
    times: np.ndarray  # [M] s, joint timeline
    episodes: np.ndarray  # [M] which of several recordings each is of
    world_from_camera: np.ndarray  # [M, 4, 4] OpenCV axes
    load: Callable[[int], np.ndarray]  # image uint8 [H, W, 3] of a row of these arrays, as `pinhole` projects it
    pinhole: Lens
    visible: np.ndarray | None = None  # bool [H, W], the field of view, if it has a border

    @property
    def reduced_pinhole(self) -> Lens:
        """The lens of the images `reduced`."""
        return Lens.of(self.pinhole.camera(np.eye(4)).within(REFERENCE_PIXELS))


def reduced(image: np.ndarray) -> np.ndarray:
    """Return an image uint8 [H, W, 3] (or [H, W]) scaled down to REFERENCE_PIXELS for motion detection."""
    height, width = image.shape[:2]
    whole = Lens(width, width, width / 2, height / 2, (), (width, height)).camera(np.eye(4))
    small = whole.within(REFERENCE_PIXELS)
    size = small.width, small.height
    return image if size == (width, height) else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


@dataclass(frozen=True, kw_only=True)
class ChoiceSettings:
    """Thresholds of the choice of frames."""

    neighbours: int = 7  # frames on each side with which a frame's sharpness is compared
    noise: float = 0.004  # mean absolute change of the picture, in [0, 1], caused by sensor noise alone
    noise_at_a_place: float = 0.06  # the same at one place of a thumbnail
    noise_mm: float = 0.3  # change of the state within the tracker's noise
    noise_rad: float = 0.005  # the same, of rotation
    max_ranges: int = 3  # maximum number of ranges of frames in a note
    thumbnail_px: int = 64  # width of thumbnails
    min_repeated: int = 5  # minimum number of repeated pictures for a note where no state contradicts them
    aspect_tolerance: float = 0.02  # tolerance of fl_x / fl_y against the pixels' shape; calibrations agree to 0.5 %


SETTINGS = ChoiceSettings()


@dataclass(frozen=True)
class DropReason:
    """Why a video frame is not in the capture."""

    why: str
    frame_usable: bool = False  # it could have been used as well


@dataclass(frozen=True)
class FrameFeatures:
    """Features of every frame [N], computed while the video is read once."""

    sharpness: np.ndarray  # [N]
    thumbnails: np.ndarray  # [N, h, w] grey in [0, 1]
    repeats: np.ndarray  # [N] bool: the picture repeats the previous one


def frame_features(images: Iterable[np.ndarray]) -> FrameFeatures:
    """Return sharpness and thumbnail of every image uint8 [H, W, 3], and whether it repeats the one before."""
    sharpness, thumbnails, repeats = [], [], []
    before: np.ndarray | None = None
    for image in images:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        # at half size, or sensor noise is taken for detail
        levels = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        repeats.append(before is not None and is_repeated(before, levels))
        before, half = levels, levels.astype(np.float32) / 255
        sharpness.append(float(cv2.Laplacian(half, cv2.CV_32F).var()))
        size = (SETTINGS.thumbnail_px, max(1, round(SETTINGS.thumbnail_px * image.shape[0] / image.shape[1])))
        thumbnails.append(cv2.resize(half, size, interpolation=cv2.INTER_AREA))
    return FrameFeatures(np.array(sharpness), np.array(thumbnails), np.array(repeats))


def frozen_frames(features: FrameFeatures, usable: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return the frames whose picture repeats an earlier one, though the state changed since; see `choose_frames`."""
    source = np.maximum.accumulate(np.where(features.repeats, 0, np.arange(len(states))))
    change = states - states[source]
    shifts, turns = np.linalg.norm(change[:, :3], axis=1), np.linalg.norm(change[:, 3:], axis=1)
    moved = (shifts > PIXELS.visible_mm) | (turns > PIXELS.visible_rad)
    return np.flatnonzero(moved & usable & usable[source])


def describe_ranges(frames: np.ndarray) -> str:
    """Return increasing frame numbers as `61-89, 104`, the first `max_ranges` ranges."""
    parts = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    words = [f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts[: SETTINGS.max_ranges]]
    return ", ".join(words) + (", ..." if len(parts) > SETTINGS.max_ranges else "")


def choose_frames(
    features: FrameFeatures, usable: np.ndarray, states: np.ndarray, count: int, min_sharpness: float
) -> tuple[np.ndarray, dict[int, DropReason]]:
    """Choose at most `count` sharp frames that differ, spread over states and views; return them, and why not others.

    usable [N] bool: frames with a known state (the others are dropped); states [N, 6+J]: position mm, first row of the
    rotation matrix (a turn about the frame's x axis leaves it), joints rad of the instrument; min_sharpness: of the
    neighbours' median.
    """
    dropped = {int(i): DropReason("no instrument state at its time") for i in np.flatnonzero(~usable)}
    frozen = DropReason("frozen: the state changed, not the picture")
    dropped |= dict.fromkeys(frozen_frames(features, usable, states).tolist(), frozen)
    for i in np.flatnonzero(usable).tolist():
        around = features.sharpness[max(0, i - SETTINGS.neighbours) : i + SETTINGS.neighbours + 1]
        if features.sharpness[i] < min_sharpness * np.median(around):
            share = features.sharpness[i] / np.median(around)
            dropped[i] = DropReason(f"blurred: {share:.0%} of its neighbours' sharpness")
    last: int | None = None
    for i in range(len(usable)):
        if i in dropped:
            continue
        if last is not None:
            moved, turned = (
                np.linalg.norm((states[last] - states[i])[:3]),
                np.linalg.norm((states[last] - states[i])[3:]),
            )
            changes = np.abs(features.thumbnails[last] - features.thumbnails[i])
            # no state is known yet, and something small moved
            small = not states.any() and changes.max() > SETTINGS.noise_at_a_place
            same = changes.mean() < SETTINGS.noise and moved < SETTINGS.noise_mm and turned < SETTINGS.noise_rad
            if same and not small:
                dropped[i] = DropReason(f"the same as frame {last}: neither picture nor state changed")
                continue
        last = i
    selected = np.array([i for i in range(len(usable)) if i not in dropped], dtype=int)
    if len(selected) > count:
        # states, main components of the views, and time (SfM needs neighbours), each of unit spread
        pictures = features.thumbnails.reshape(len(states), -1)
        pictures = pictures - pictures.mean(0)
        basis = np.linalg.svd(pictures[:: max(1, len(pictures) // 400)], full_matrices=False)[2][:3]
        columns = np.concatenate([states, pictures @ basis.T, np.arange(len(states))[:, None]], 1)
        spread = columns.std(0)
        rows = (columns[:, spread > 1e-9] / spread[spread > 1e-9])[selected]
        farthest = [0, len(rows) - 1]  # farthest-point sampling, with the first and last in time
        distance = np.minimum(*(np.linalg.norm(rows - rows[i], axis=1) for i in farthest))
        while len(farthest) < count:
            farthest.append(int(distance.argmax()))
            distance = np.minimum(distance, np.linalg.norm(rows - rows[farthest[-1]], axis=1))
        chosen = selected[farthest[:count]]
        reason = DropReason(f"not among the {count} that cover states and views best", frame_usable=True)
        dropped |= dict.fromkeys((int(i) for i in set(selected) - set(chosen)), reason)
        selected = np.sort(chosen)
    return selected, dropped


@dataclass(frozen=True, eq=False, kw_only=True)
class ChosenImages:
    """The video frames that are kept, in `folder`/raw as PNG, and their border's masks in `folder`/visible."""

    folder: Path
    size: tuple[int, int]  # width, height px
    lens: Lens | None  # None: not known yet
    selected: np.ndarray  # [K] video frames
    dropped: Mapping[int, DropReason]  # of other video frames, why
    border: Border | None = None  # the endoscope's, in the frames as recorded
    overlay: np.ndarray | None = None  # bool [H, W], console overlay in the frames as recorded

    @property
    def names(self) -> list[str]:
        """File names in `folder`/raw."""
        return [f"{frame:06d}.png" for frame in self.selected]

    def load(self, row: int) -> np.ndarray:
        """Return one of the chosen frames, uint8 [H, W, 3]."""
        return np.asarray(open_image(self.folder / "raw" / f"{self.selected[row]:06d}.png").convert("RGB"))

    def loader(self, rows: np.ndarray) -> Callable[[int], np.ndarray]:
        """Return `load` for some rows alone."""
        return lambda place: self.load(int(rows[place]))

    def views(self, data: Episodes, rows: np.ndarray, world_from_camera: np.ndarray) -> Views:
        """Return the views of chosen frames `rows` [M] with cameras [M, 4, 4]. The lens has to be known."""
        assert self.lens is not None
        frames = self.selected[rows]
        return Views(
            rows=rows,
            frames=frames,
            times=data.times[frames],
            episodes=data.episode_of(frames),
            world_from_camera=world_from_camera,
            load=self.loader(rows),
            pinhole=self.lens.pinhole(self.size),
            visible=self.field_of_view,
        )

    @property
    def field_of_view(self) -> np.ndarray | None:
        """Return pixels within the border and outside the overlay, bool [H, W], undistorted; None: all."""
        visible = None if self.border is None else visible_mask(self.border, self.size)
        if self.overlay is not None:
            visible = ~self.overlay if visible is None else visible & ~self.overlay
        return visible if self.lens is None or visible is None else self.lens.undistort_mask(visible)

    @property
    def masks(self) -> Path | None:
        """Folder of the field of view's masks, one file per frame as pycolmap expects them; None: there are none."""
        return None if self.border is None and self.overlay is None else self.folder / "visible"

    def mask_of(self, frame: int) -> Path | None:
        """Return the field of view's mask of a video frame; None: there is none."""
        return None if self.masks is None else self.masks / f"{frame:06d}.png.png"

    def rename(self, frame: int, name: str) -> Path:
        """Rename a video frame's image to its name in the capture (SfM orders images by name); return its path."""
        image = self.folder / "raw" / f"{frame:06d}.png"
        return image.rename(image.with_name(f"{name}.png"))


@dataclass(frozen=True, kw_only=True)
class OverlaySettings:
    """Thresholds for overlays. Brightness is of 255."""

    min_images: int = 8
    percentiles: tuple[float, float] = (5.0, 95.0)  # percentiles of a pixel's brightness whose difference is its spread
    min_motion: float = 12.0  # minimum median spread of a moving scene
    max_spread: float = 8.0  # maximum spread of an overlay, by compression alone
    min_edge: float = 30.0  # minimum step of the median image; moving content has no sharp edges there
    reach: int = 4  # px of compression artefacts around such an edge, by which masks are dilated
    min_sharp: float = 0.6  # minimum share of a region's boundary with a sharp edge; a shaft's is sharp at one end
    min_region_px: int = 6  # minimum size of a stroke or bar
    min_share: float = 2e-4  # of the image; smaller ones are coincidences
    max_share: float = 0.4  # of the image; larger ones are side panels, or a still scene


OVERLAY = OverlaySettings()


def find_overlay(images: Iterable[np.ndarray], visible: np.ndarray | None) -> np.ndarray | None:
    """Return the pixels bool [H, W] that are drawn over the scene in all images uint8 [H, W, 3] of a recording; None
    where there are none, or the scene does not move. visible: bool [H, W], the field of view; None: all of it.

    They keep their brightness, and edges nearly all around them are sharp in the median image.
    """
    stack = np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images])
    if len(stack) < OVERLAY.min_images:
        return None
    low, median, high = np.percentile(stack, [OVERLAY.percentiles[0], 50, OVERLAY.percentiles[1]], axis=0)
    field = np.ones(median.shape, bool) if visible is None else visible
    spread = high - low
    if not field.any() or np.median(spread[field]) < OVERLAY.min_motion:
        return None
    still = field & (spread <= OVERLAY.max_spread)
    steps = ndimage.morphological_gradient(median, size=3)  # among a pixel and its neighbours
    sharp = ndimage.maximum_filter(steps, 2 * OVERLAY.reach + 1) > OVERLAY.min_edge
    regions, count = ndimage.label(still, np.ones((3, 3)))
    around = ndimage.grey_dilation(regions, size=3) * ~still  # the region beside a pixel
    pixels = np.bincount(around[field], minlength=count + 1)
    share = np.bincount(around[field & sharp], minlength=count + 1) / np.maximum(pixels, 1)
    large = np.bincount(regions.ravel(), minlength=count + 1) >= OVERLAY.min_region_px
    overlay = still & (large & (share > OVERLAY.min_sharp))[regions]
    if not OVERLAY.min_share <= overlay.mean() <= OVERLAY.max_share:
        return None
    return ndimage.binary_dilation(overlay, iterations=OVERLAY.reach)


def choose_images(data: Episodes, folder: Path, progress: StageProgress) -> ChosenImages:
    """Choose the frames to keep and write them into `folder`, undistorted where the lens is given.

    Raises NeecoError for a lens of another image size, and where too few frames can be used.
    """
    lens = read_lens(data)
    selected, dropped = _choose(data, progress)
    size = data.video.size
    sample = selected[evenly_spaced(len(selected), BORDERS.max_frames, floor=True)]
    sampled = [image for _, image in data.video.read(sample.tolist())]
    visible = None
    if (border := find_border(sampled)) is not None:
        visible = visible_mask(border, size)
        data.notes.add(f"the endoscope's dark border ({1 - visible.mean():.0%} of the image) is masked")
    if (overlay := find_overlay(sampled[::2], visible)) is not None:
        kinds = "text, icons or bars drawn over the video"
        data.notes.add(f"what never moves while the scene does ({kinds}; {overlay.mean():.1%} of the image) is masked")
    images = ChosenImages(
        folder=folder, size=size, lens=lens, selected=selected, dropped=dropped, border=border, overlay=overlay
    )
    write_images(images, data.video, progress)
    return images


def write_images(images: ChosenImages, video: VideoSource, progress: StageProgress) -> None:
    """Write images and masks, undistorted where the lens is known."""
    folder, names = images.folder / "raw", images.names
    folder.mkdir(exist_ok=True)
    for done, (name, (_, image)) in enumerate(zip(names, video.read(images.selected.tolist()), strict=True), 1):
        progress("writing frames", done, len(names))
        straight = images.lens.undistort(image) if images.lens else image
        write_unsynced(folder / name, encoded_rgb(straight))

    if (visible := images.field_of_view) is not None and images.masks is not None:
        images.masks.mkdir(exist_ok=True)
        first, *later = (images.masks / f"{name}.png" for name in names)
        write_labels(first, torch.from_numpy(visible.astype(np.uint8) * 255))
        for other in later:
            shutil.copyfile(first, other)


def read_lens(data: Episodes) -> Lens | None:
    """Return the lens given, checked against the video's size; note one whose focal lengths contradict the pixels'
    shape. Raises NeecoError naming where it was given, and for pixels that are not square with an unknown lens:
    structure from motion estimates one focal length."""
    lens, where = data.recording.read_lens()
    for video in (part.video for part in data.parts if part.video.pixel_aspect != 1):
        if lens is None:
            raise NeecoError(
                f"{video.path}: its pixels are not square ({video.pixel_aspect:.3g} times as wide as high); give the "
                "intrinsics of the frames as stored, or square pixels: ffmpeg -vf scale=iw*sar:ih,setsar=1"
            )
        ratio, expected = lens.fl_x / lens.fl_y, 1 / video.pixel_aspect
        if abs(ratio / expected - 1) > SETTINGS.aspect_tolerance:
            data.notes.add(
                f"{where}: fl_x / fl_y is {ratio:.3g}, the shape of {video.path.name}'s pixels says {expected:.3g}"
            )
    if lens is not None:
        lens.check_size(data.video.size, where)
        try:
            lens.pinhole(data.video.size)
        except NeecoError as error:  # it does not know where it came from
            raise NeecoError(f"{where}: {str(error).removeprefix('lens: ')}") from error
    return lens


def _choose(data: Episodes, progress: StageProgress) -> tuple[np.ndarray, dict[int, DropReason]]:
    """Return the video frames to keep, and why others are not."""
    count, recording = len(data.times), data.recording
    settings = recording.settings

    def images() -> Iterator[np.ndarray]:
        for done, (_, image) in enumerate(data.video.read(range(count)), 1):
            progress("looking at the frames", done, count)
            yield image

    features = frame_features(images())
    states, usable = data.coverage_states()
    posed = states.any()  # else the clocks are found later, by frames that are not frozen
    frozen = frozen_frames(features, usable, states) if posed else np.flatnonzero(features.repeats)
    if len(frozen) >= (1 if posed else SETTINGS.min_repeated):
        why = (
            "while the state changes; frozen, and left out" if posed else "and are left out; check the video for stalls"
        )
        share = f"{len(frozen)} of {count} frames ({len(frozen) / count:.0%}: {describe_ranges(frozen)})"
        data.notes.add(f"{data.video.path.name}: {share} repeat the picture before them {why}")
    limit = recording.frames or settings.max_frames
    selected, dropped = choose_frames(features, usable, states, limit, settings.min_sharpness)
    if recording.frames is None and count > limit:
        data.notes.add(f"{limit} of {count} frames are kept; ask for more with --frames")
    if len(selected) < MIN_FRAMES:
        reasons = Counter(reason.why.split(":")[0] for reason in dropped.values())
        why = reasons.most_common(1)[0][0] if reasons else "the video is short"
        raise NeecoError(
            f"{data.video.path}: only {len(selected)} of {count} frames are usable (at least {MIN_FRAMES} are "
            f"needed); most are dropped because: {why}"
        )
    return selected, dropped
