import numpy as np
import pytest

from neeco.labels.drawing import uncertain_edge, without_components
from neeco.labels.settings import LABELS

HEIGHT, WIDTH = 120, 160
REACH_PX = LABELS.edge_width * np.hypot(HEIGHT, WIDTH)  # 1.6


def disc(radius: float, x: float = 60.0, y: float = 50.0) -> np.ndarray:
    """[H, W] px, how far inside a disc's circle a pixel's centre lies; negative outside."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return radius - np.hypot(columns + 0.5 - x, rows + 0.5 - y)


def soft(inside: np.ndarray, width: float) -> np.ndarray:
    """A share that falls from 1 to 0 over `width` px, LABELS.threshold at the circle."""
    return np.clip(LABELS.threshold + inside / width, 0, 1).astype(np.float32)


def test_where_the_share_jumps_the_band_is_a_pixel_at_either_side():
    inside = disc(30)
    mask = inside > 0
    band = uncertain_edge(mask.astype(np.float32), mask)
    assert not band[np.abs(inside) > np.sqrt(2)].any()
    across = band[50]
    assert np.flatnonzero(across).tolist() == [29, 30, 89, 90]
    assert mask[50, [29, 30, 89, 90]].tolist() == [False, True, True, False]


def test_a_slanted_border_has_no_thinner_band():
    mask = np.tri(40, dtype=bool)
    rows, columns = np.mgrid[:40, :40]
    band = uncertain_edge(mask.astype(np.float32), mask)
    assert band[(rows - columns >= -2) & (rows - columns <= 1)].all()  # sqrt(1/2) px a diagonal


def test_the_band_holds_what_is_unclear_near_the_border_and_nothing_far_from_it():
    inside = disc(30)
    share = soft(inside, width=16)
    band = uncertain_edge(share, inside > 0)
    unclear = (share > LABELS.clear_shares[0]) & (share < LABELS.clear_shares[1])
    assert band[unclear & (np.abs(inside) < REACH_PX)].all()
    assert not band[np.abs(inside) > REACH_PX + np.sqrt(2)].any()
    narrow = uncertain_edge((inside > 0).astype(np.float32), inside > 0)
    assert band[narrow].all()
    assert band.sum() > 1.1 * narrow.sum()


def test_a_faint_shadow_far_from_the_instrument_counts():
    inside = disc(20)
    share = soft(inside, width=1)
    share[disc(15, x=120) > 0] = 0.4
    assert not uncertain_edge(share, inside > 0)[:, 90:].any()


@pytest.mark.parametrize("filled", [False, True])
def test_no_border_no_band(filled):
    mask = np.full((HEIGHT, WIDTH), filled)
    assert not uncertain_edge(np.full((HEIGHT, WIDTH), 0.5, np.float32), mask).any()


def test_the_images_border_is_no_edge():
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, :40] = True
    band = uncertain_edge(mask.astype(np.float32), mask)
    assert np.flatnonzero(band.any(0)).tolist() == [39, 40]


def test_a_dropped_piece_goes_with_what_fades_around_it_and_the_kept_one_stays():
    large, small = disc(30), disc(4, x=120)
    share = np.maximum(soft(large, width=8), soft(small, width=8))
    kept, dropped = large > 0, small > 0
    cleaned = without_components(share, kept, dropped)
    assert share[:, 105:].any()
    assert not cleaned[:, 105:].any()
    assert (cleaned[:, :100] == share[:, :100]).all()
    assert cleaned.dtype == np.float32


def test_what_is_clearly_instrument_is_not_taken_with_a_dropped_piece():
    share = np.ones((HEIGHT, WIDTH), np.float32)
    kept, dropped = disc(10) > 0, disc(2, x=120) > 0
    cleaned = without_components(share, kept, dropped)
    assert ((cleaned == 0) == dropped).all()


def test_without_dropped_pieces_the_share_is_untouched():
    share = soft(disc(30), width=8)
    assert without_components(share, disc(30) > 0, np.zeros((HEIGHT, WIDTH), bool)) is share
