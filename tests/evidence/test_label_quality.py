"""Without any mask, images tell how much of an instrument is labelled, and how much of the label is tissue."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from neeco.evidence.foreground import Comparison, Foreground
from neeco.evidence.label_quality import LabelQuality, label_counts, quality_of

HEIGHT, WIDTH = 96, 128
SHAFT = slice(50, 74)  # columns


def view(label: slice, seed: int, *, dark: bool = False) -> Comparison:
    """A view of a shaft whose label covers the columns `label`: noisy tissue, a shadow beside the shaft; dark: a shaft
    that is a shade of the tissue but for larger residuals."""
    rng = np.random.default_rng(seed)
    residual = np.exp(rng.normal(-3.6, 0.25, (HEIGHT, WIDTH)))
    shade = rng.normal(1, 0.05, (HEIGHT, WIDTH))
    shade[:, SHAFT.stop : SHAFT.stop + 8] = rng.uniform(0.5, 1, (HEIGHT, 8))
    width = SHAFT.stop - SHAFT.start
    residual[:, SHAFT] = np.exp(rng.normal(-2.0 if dark else -0.5, 0.25, (HEIGHT, width)))
    shade[:, SHAFT] = rng.normal(0.55 if dark else 1.2, 0.1, (HEIGHT, width))
    rendered = np.zeros((HEIGHT, WIDTH))
    rendered[:, label] = 1
    everywhere = np.ones((HEIGHT, WIDTH))
    depth = np.full((HEIGHT, WIDTH), 50.0)
    return Comparison(
        shade, residual, residual, everywhere, depth, rendered, error=0.02 * everywhere, usable=everywhere > 0
    )


def learned(views: list[Comparison]) -> Foreground:
    foreground = Foreground.learned(views)
    assert foreground is not None
    return foreground


def quality(label: slice, dark: bool) -> LabelQuality:
    """Estimated from three views."""
    views = [view(label, seed, dark=dark) for seed in range(3)]
    foreground = learned(views)
    found = quality_of([label_counts(shown, foreground) for shown in views])
    assert found is not None
    return found


def iou(label: slice) -> float:
    both = max(0, min(label.stop, SHAFT.stop) - max(label.start, SHAFT.start))
    return both / (label.stop - label.start + SHAFT.stop - SHAFT.start - both)


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("label", [SHAFT, slice(50, 66), slice(50, 60), slice(48, 79), slice(56, 78)])
def test_the_estimated_iou_of_labels_is_near_the_true_one(label: slice, dark: bool) -> None:
    missed = label.start >= SHAFT.start and label.stop <= SHAFT.stop
    assert quality(label, dark).iou == pytest.approx(
        iou(label), abs=0.06 if missed else 0.12
    )  # of shadows that are labelled, less shows


def test_labels_that_leave_out_a_dark_shaft_are_doubtful_and_right_ones_are_not() -> None:
    for label, doubtful in ((slice(50, 60), True), (SHAFT, False)):
        assert (quality(label, dark=True).doubt is not None) == doubtful


def test_nothing_is_said_of_images_without_an_instrument() -> None:
    views = [view(slice(0, 0), seed) for seed in range(3)]
    assert Foreground.learned(views) is None


def test_labels_of_pixels_that_tell_nothing_are_less_certain() -> None:
    """At outlines they show what covers them by half; elsewhere, with nothing certain nearby, either is as likely."""
    views = [view(SHAFT, seed) for seed in range(3)]
    foreground = learned(views)
    certain = label_counts(views[0], foreground)
    unsure = replace(foreground, ratio=np.zeros_like(foreground.ratio))
    shares = []
    for covered in (0.1, 0.4, 1.0):
        partly = label_counts(replace(views[0], covered=np.full((HEIGHT, WIDTH), covered)), unsure)
        assert partly[:2].tolist() == [0, 0]
        assert partly.sum() == pytest.approx(certain[[0, 2, 3]].sum())
        shares.append(partly[3] / partly.sum())
    assert shares == pytest.approx([0.2, 0.8, 0.5])


def test_labelled_pixels_that_tell_nothing_show_what_certain_ones_nearby_do() -> None:
    views = [view(SHAFT, seed) for seed in range(3)]
    foreground = learned(views)
    ratio = foreground.ratio.copy()
    ratio[-1, 0] = 0  # of the largest residual and the darkest shade
    foreground = replace(foreground, ratio=ratio)
    shares = []
    for column in (60, 20):  # in the shaft, and in labelled tissue
        wide = view(slice(10, SHAFT.stop), 0)
        both = label_counts(wide, foreground)
        residual, shade, block = wide.residual.copy(), wide.shade.copy(), (slice(40, 43), slice(column, column + 3))
        residual[block], shade[block] = 10.0, 0.0
        unsure = label_counts(replace(wide, residual=residual, own=residual, shade=shade), foreground)
        shares.append((unsure[3] - both[3]) / 9)
    assert shares == pytest.approx([1, 0], abs=0.05)


def test_highlights_apart_from_the_instrument_are_no_unlabelled_part_of_it() -> None:
    views = [view(SHAFT, seed) for seed in range(3)]
    foreground = learned(views)
    right = label_counts(views[0], foreground)
    for rows, part_of_it in ((slice(20, 32), False), (slice(0, 80), True)):
        residual, shade = views[0].residual.copy(), views[0].shade.copy()
        residual[rows, 30:42], shade[rows, 30:42] = residual[rows, SHAFT][:, :12], shade[rows, SHAFT][:, :12]
        missed = label_counts(replace(views[0], residual=residual, own=residual, shade=shade), foreground)[1]
        assert (missed > right[1] + 100) == part_of_it


def test_labels_lost_in_one_image_are_doubtful_though_it_shows_little_of_the_instrument() -> None:
    right, lost = np.array([4000.0, 0, 0, 0]), np.array([100.0, 300, 0, 0])
    found = quality_of([right, right, right, lost])
    assert found is not None
    assert found.recall == pytest.approx(0.8125)
    assert found.doubt is not None
    assert quality_of([np.array([0.0, 0, 50, 0])]) is None


def test_labels_that_leave_out_an_eighth_of_the_instrument_are_doubtful_however_precise() -> None:
    assert LabelQuality(0.875, 1.0).doubt is not None
    assert LabelQuality(0.92, 0.95).doubt is None


def test_a_part_that_neither_the_label_nor_the_rendering_has_makes_labels_doubtful() -> None:
    """Jaws whose joints nothing logged: taken for tissue that looks so at times, they have no certain pixel."""
    jaws = np.s_[20:50, SHAFT.stop + 12 : SHAFT.stop + 34]
    views = [view(SHAFT, seed) for seed in range(3)]
    foreground = learned(views)
    for error, doubtful in ((0.02, False), (0.2, True)):
        counts = []
        for shown in views:
            image = replace(shown, error=shown.error.copy(), residual=shown.residual.copy(), own=shown.own.copy())
            image.error[jaws] = error
            image.residual[jaws] = image.own[jaws] = foreground.noise * 2  # neither certainly tissue nor instrument
            counts.append(label_counts(image, foreground))
        quality = quality_of(counts)
        assert quality is not None
        assert (quality.doubt is not None) == doubtful
