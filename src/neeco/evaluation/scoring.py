"""One frame, scored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from neeco.capture.model import Frame
from neeco.evaluation.image_metrics import psnr, ssim
from neeco.evaluation.lpips import MIN_SIZE, Lpips
from neeco.evaluation.mask_metrics import dice, iou
from neeco.evaluation.truth import Reference
from neeco.labels.drawing import Drawing

LPIPS_KEYS = {"alexnet": "lpips", "vgg16": "lpips_vgg"}  # AlexNet is the one its authors score with
IMAGE_SCORES = ("psnr", "ssim", "lpips", "lpips_vgg")
SCORES = (
    *IMAGE_SCORES,
    "psnr_instrument",
    "mask_iou",
    "mask_dice",
    "psnr_covered",
    "psnr_uncovered",
    "covered_fraction",
)


@dataclass(frozen=True)
class Photograph:
    """A frame as recorded, with all that scoring needs; made once, used for the given and the aligned drawing."""

    image: Tensor  # [H, W, 3] in [0, 1]
    mask: Tensor | None  # [H, W] bool, False where pixels do not count
    reference: Reference | None
    unseen: Tensor  # [H, W] bool, tissue no training frame saw
    tissue: Tensor  # [H, W] bool
    features: dict[str, list[Tensor]]  # LPIPS features by network name


def photograph(
    frame: Frame, reference: Reference | None, seen: tuple[Tensor, Tensor], networks: Mapping[str, Lpips]
) -> Photograph:
    """Read a frame. `seen`: what `coverage.unseen_tissue` returned for it."""
    image, mask = frame.load_image(), frame.load_mask()
    large_enough = min(image.shape[:2]) >= MIN_SIZE
    features = {name: network.features(image) for name, network in networks.items() if large_enough}
    return Photograph(image, mask, reference, seen[0], seen[1], features)


def score(drawing: Drawing, photo: Photograph, networks: Mapping[str, Lpips]) -> dict[str, float | None]:
    """All numbers of one frame, by the names in SCORES; None where there is nothing to compare with."""
    image, mask = drawing.image, photo.mask
    counted = torch.ones(image.shape[:2], dtype=torch.bool, device=image.device) if mask is None else mask
    tissue = int((photo.tissue & counted).sum())
    row: dict[str, float | None] = dict.fromkeys(SCORES)
    row["psnr"] = psnr(image, photo.image, counted)
    row["ssim"] = ssim(image, photo.image, mask)
    row["psnr_covered"] = psnr(image, photo.image, counted & ~photo.unseen)
    row["psnr_uncovered"] = psnr(image, photo.image, counted & photo.unseen)
    row["covered_fraction"] = 1.0 - int((photo.unseen & counted).sum()) / tissue if tissue else None
    shown = image if mask is None else torch.where(mask[..., None], image, photo.image)
    for name, features in photo.features.items():
        network = networks[name]
        row[LPIPS_KEYS[name]] = network.between(network.features(shown), features, mask)
    if photo.reference is not None:
        row["psnr_instrument"] = psnr(image, photo.image, counted & photo.reference.mask)
        if drawing.parts is not None:
            row["mask_iou"] = iou(drawing.parts > 0, photo.reference.mask, counted)
            row["mask_dice"] = dice(drawing.parts > 0, photo.reference.mask, counted)
    return row
