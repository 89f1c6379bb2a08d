"""Training frames with their pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neeco.capture.images import area_averaged_bytes
from neeco.capture.model import Camera, Frame

MAX_MEMORY_SHARE = 0.5  # of a CUDA device's free memory that all pixels may take


@dataclass(frozen=True)
class TrainingViews:
    """Training frames, each with image and mask. Cameras and states stay on the frames' device.

    `images` and `masks` are on `device`, or, where its memory is too small, on the host, from where `prefetcher` copies
    them.
    """

    frames: tuple[Frame, ...]
    images: tuple[Tensor, ...]  # [H, W, 3] uint8 each
    masks: tuple[Tensor | None, ...]  # [H, W] bool each, False where the loss ignores a pixel; None: it uses all
    prefetcher: PixelPrefetcher | None = None

    @classmethod
    def read(cls, frames: Sequence[Frame], scale: float = 1.0) -> TrainingViews:
        """Load every frame's pixels, at `scale` times their size. Raises NeecoError where a file cannot
        be read."""
        chosen = tuple(frames) if scale == 1 else tuple(frame.scaled(scale) for frame in frames)
        pixels = [(frame.load_image_bytes(), frame.load_mask()) for frame in chosen]
        return cls(chosen, tuple(image for image, _ in pixels), tuple(mask for _, mask in pixels))

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def device(self) -> torch.device:
        """Device of targets and masks."""
        return self.images[0].device if self.prefetcher is None else self.prefetcher.device

    def to(self, device: torch.device) -> TrainingViews:
        """Return the views on `device`; pixels stay on the host if they would take more than MAX_MEMORY_SHARE of a CUDA
        device's free memory."""
        if device.type == "cuda":
            size = sum(pixels.nbytes for pixels in (*self.images, *self.masks) if pixels is not None)
            if size > MAX_MEMORY_SHARE * torch.cuda.mem_get_info(device)[0]:
                return self.prefetched_to(device)
        return self._with_pixels(lambda pixels: pixels.to(device))

    def prefetched_to(self, device: torch.device) -> TrainingViews:
        """Return the views for `device`, their pixels in page-locked memory of the host."""
        views = self._with_pixels(lambda pixels: pixels.cpu().pin_memory())
        return replace(views, prefetcher=PixelPrefetcher(device))

    def _with_pixels(self, change: Callable[[Tensor], Tensor]) -> TrainingViews:
        masks = tuple(None if mask is None else change(mask) for mask in self.masks)
        return replace(self, images=tuple(change(image) for image in self.images), masks=masks)

    def scaled(self, scale: float) -> TrainingViews:
        """Return the views with images of `scale` times their size, area-averaged; a mask pixel is set where all of its
        area is."""
        if scale == 1:
            return self
        frames, images, masks = [], [], []
        for frame, image, mask in zip(self.frames, self.images, self.masks, strict=True):
            frames.append(frame.scaled(scale))
            camera = frames[-1].camera
            images.append(_resized(image, camera))
            masks.append(None if mask is None else _resized(mask.to(torch.uint8) * 255, camera) == 255)
        prefetcher = None if self.prefetcher is None else PixelPrefetcher(self.prefetcher.device)
        return TrainingViews(tuple(frames), tuple(images), tuple(masks), prefetcher)

    def subset(self, indices: Sequence[int]) -> TrainingViews:
        """Return the views of the frames `indices`."""
        prefetcher = None if self.prefetcher is None else PixelPrefetcher(self.prefetcher.device)
        rows = [(self.frames[index], self.images[index], self.masks[index]) for index in indices]
        frames, images, masks = zip(*rows, strict=True)
        return TrainingViews(frames, images, masks, prefetcher)

    def target(self, index: int) -> Tensor:
        """Return the target image [H, W, 3] of one frame, float32 in [0, 1]."""
        return self._pixels(index)[0].float() / 255

    def mask(self, index: int) -> Tensor | None:
        """Return the mask [H, W] bool of one frame, or None."""
        return self._pixels(index)[1]

    def prefetch(self, index: int) -> None:
        """Start to copy the pixels of frame `index`, which is used next, where pixels are on the host."""
        if self.prefetcher is not None:
            self.prefetcher.start(index, self.images[index], self.masks[index])

    def _pixels(self, index: int) -> tuple[Tensor, Tensor | None]:
        image, mask = self.images[index], self.masks[index]
        return (image, mask) if self.prefetcher is None else self.prefetcher.get(index, image, mask)


def mean_pixels(frames: Sequence[Frame]) -> float:
    """Return the mean number of pixels of an image."""
    return sum(frame.camera.width * frame.camera.height for frame in frames) / len(frames)


def _resized(pixels: Tensor, camera: Camera) -> Tensor:
    """Return bytes [H, W, ...] area-averaged to the camera's size, on the same device or in the same kind of memory."""
    resized = torch.from_numpy(area_averaged_bytes(pixels.cpu().numpy(), camera))
    return resized.pin_memory() if pixels.is_pinned() else resized.to(pixels.device)


class PixelPrefetcher:
    """Copies pixels frame by frame to a device; to a CUDA device on a separate stream while it computes."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._index = -1
        self._pixels: tuple[Tensor, ...] = ()

    def start(self, index: int, image: Tensor, mask: Tensor | None) -> None:
        """Start to copy frame `index`, unless it is the last one copied."""
        if index == self._index:
            return
        pixels = (image,) if mask is None else (image, mask)
        with nullcontext() if self.stream is None else torch.cuda.stream(self.stream):
            self._pixels = tuple(tensor.to(self.device, non_blocking=True) for tensor in pixels)
        self._index = index

    def get(self, index: int, image: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Return the copies of frame `index`; the device waits for them, not the caller."""
        self.start(index, image, mask)
        if self.stream is not None:
            computing = torch.cuda.current_stream(self.device)
            computing.wait_stream(self.stream)
            for tensor in self._pixels:
                tensor.record_stream(computing)  # or its memory would be given to the next copy too early
        return self._pixels[0], None if mask is None else self._pixels[1]
