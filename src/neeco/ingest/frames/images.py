"""The chosen frames of a recording as images: chosen, written, undistorted once the lens is known, their dark border
masked."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from neeco.capture.images import open_image, write_image, write_labels
from neeco.capture.model import evenly_spaced
from neeco.errors import NeecoError
from neeco.geometry.lens import Border, Lens
from neeco.ingest.calibration.lens import MAX_BORDER_FRAMES, find_border, visible_mask
from neeco.ingest.frames.selection import choose_frames, describe_ranges, frame_features, frozen_frames
from neeco.ingest.frames.views import StageProgress
from neeco.ingest.readers import VideoSource
from neeco.ingest.recording.model import MIN_FRAMES
from neeco.ingest.timing.episodes import Episodes

MIN_REPEATED = 5  # frames with the picture before them that are worth a note where no state tells that it is wrong
ASPECT_TOLERANCE = 0.02  # of fl_x / fl_y against the pixels' shape; calibrations agree to 0.5 %


class ChosenImages:
    """The frames of `data` that are kept, in `folder`/raw as PNG, and their border's masks in `folder`/visible.

    `lens`: as it was given; None: not known yet. Raises NeecoError for a lens of another size of image, and where too
    few frames can be used.
    """

    def __init__(self, data: Episodes, folder: Path, progress: StageProgress) -> None:
        self.data, self.folder, self.progress = data, folder, progress
        self.size = data.video.size
        self.lens = _read_lens(data)
        self.selected, self.dropped = _choose(data, progress)  # [K] video frames; of others why not
        self.names = [f"{frame:06d}.png" for frame in self.selected]
        self._write()
        self.border = self._find_border()
        self.visible = self._write_visible()  # folder of masks, one file per frame as SfM wants them; None: no border

    def know_lens(self, lens: Lens) -> None:
        """Write all anew, undistorted."""
        self.lens = lens
        self._write()
        self._write_visible()

    def load(self, row: int) -> np.ndarray:
        """uint8 [H, W, 3], one of the chosen frames."""
        return np.asarray(open_image(self.folder / "raw" / self.names[row]).convert("RGB"))

    def loader(self, rows: np.ndarray) -> Callable[[int], np.ndarray]:
        """`load`, of some rows alone."""
        return lambda place: self.load(int(rows[place]))

    def field_of_view(self) -> np.ndarray | None:
        """bool [H, W]: what lies within the border, undistorted as the images are; None without a border."""
        if self.border is None:
            return None
        seen = visible_mask(self.border, self.size)
        return seen if self.lens is None else self.lens.undistort_mask(seen)

    def named(self, frame: int) -> Path:
        """The image of a video frame, under the name that it has in the capture from now on."""
        image = self.folder / "raw" / f"{frame:06d}.png"  # until now by number: SfM orders images by name
        return image.rename(image.with_name(f"{self.data.frame_name(frame)}.png"))

    def mask_of(self, frame: int) -> Path | None:
        """The border's mask of a video frame; None without a border."""
        return self.visible / f"{frame:06d}.png.png" if self.visible else None

    def _write(self) -> None:
        folder = self.folder / "raw"
        folder.mkdir(exist_ok=True)
        frames = self.data.video.read(self.selected.tolist())
        for done, (name, (_, image)) in enumerate(zip(self.names, frames, strict=True)):
            self.progress("writing frames", done, len(self.names))
            straight = self.lens.undistort(image) if self.lens else image
            write_image(folder / name, torch.from_numpy(straight.astype(np.float32) / 255))

    def _find_border(self) -> Border | None:
        """The endoscope's dark border, in the frames as recorded."""
        sample = self.selected[evenly_spaced(len(self.selected), MAX_BORDER_FRAMES, floor=True)]
        border = find_border(image for _, image in self.data.video.read(sample.tolist()))
        if border is not None:
            dark = 1 - visible_mask(border, self.size).mean()
            self.data.note(f"the endoscope's dark border ({dark:.0%} of the image) is masked")
        return border

    def _write_visible(self) -> Path | None:
        seen = self.field_of_view()
        if seen is None:
            return None
        folder = self.folder / "visible"
        folder.mkdir(exist_ok=True)
        first, *others = (folder / f"{name}.png" for name in self.names)
        write_labels(first, torch.from_numpy(seen.astype(np.uint8) * 255))
        for other in others:
            shutil.copyfile(first, other)
        return folder


def _read_lens(data: Episodes) -> Lens | None:
    """The lens given, checked against the video's size. Raises NeecoError naming where it was given."""
    lens, where = data.recording.read_lens()
    for video in [part.video for part in data.parts]:
        _check_pixels(video, lens, where, data)
    if lens is not None:
        lens.check_size(data.video.size, where)
        try:
            lens.pinhole(data.video.size)
        except NeecoError as error:  # it knows nothing of where it came from
            raise NeecoError(f"{where}: {str(error).removeprefix('lens: ')}") from error
    return lens


def _check_pixels(video: VideoSource, lens: Lens | None, where: str, data: Episodes) -> None:
    """Note a lens whose focal lengths contradict the pixels' shape. Raises NeecoError for pixels that are not square
    and an unknown lens: structure from motion finds one focal length."""
    if lens is None and video.pixel_aspect != 1:
        raise NeecoError(
            f"{video.path}: its pixels are not square ({video.pixel_aspect:.3g} times as wide as high); give the "
            "intrinsics of the frames as stored, or square pixels: ffmpeg -vf scale=iw*sar:ih,setsar=1"
        )
    if lens is not None and video.pixel_aspect != 1:
        found, expected = lens.fl_x / lens.fl_y, 1 / video.pixel_aspect
        if abs(found / expected - 1) > ASPECT_TOLERANCE:
            data.note(
                f"{where}: fl_x / fl_y is {found:.3g}, the shape of {video.path.name}'s pixels says {expected:.3g}"
            )


def _choose(data: Episodes, progress: StageProgress) -> tuple[np.ndarray, dict[int, str]]:
    """Video frames to keep, and why others are not."""
    count, recording = len(data.times), data.recording
    settings = recording.settings

    def images() -> Iterator[np.ndarray]:
        for done, (_, image) in enumerate(data.video.read(range(count))):
            progress("looking at the frames", done, count)
            yield image

    features = frame_features(images())
    states, usable = data.coverage_states()
    known = states.any()  # else the clocks are found later, by frames that are not frozen
    frozen = frozen_frames(features, usable, states) if known else np.flatnonzero(features.repeats)
    if len(frozen) >= (1 if known else MIN_REPEATED):
        why = (
            "while the state changes; frozen, and left out" if known else "and are left out; is the video frozen there?"
        )
        share = f"{len(frozen)} of {count} frames ({len(frozen) / count:.0%}: {describe_ranges(frozen)})"
        data.note(f"{data.video.path.name}: {share} repeat the picture before them {why}")
    limit = recording.frames or settings.max_frames
    selected, dropped = choose_frames(features, usable, states, limit, settings.min_sharpness)
    if recording.frames is None and count > limit:
        data.note(f"{limit} of {count} frames are kept; ask for more with --frames")
    if len(selected) < MIN_FRAMES:
        reasons = Counter(why.split(":")[0] for why in dropped.values())
        why = reasons.most_common(1)[0][0] if reasons else "the video is short"
        raise NeecoError(
            f"{data.video.path}: only {len(selected)} of {count} frames are usable (at least {MIN_FRAMES} are "
            f"needed); most are dropped because: {why}"
        )
    return selected, dropped
