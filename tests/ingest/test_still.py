"""A scope that stands still is noticed, and what moves before it is told from tissue that breathes and shines."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neeco.geometry.lens import Lens
from neeco.geometry.rotations import rigid
from neeco.ingest.cameras.still_scene import stands_still
from neeco.ingest.cameras.tissue_surface import epipolar_error, surface_behind
from neeco.ingest.foreground.masks import exposure, find_background, moving_masks

WIDTH, HEIGHT, FRAMES = 160, 128, 40


class Film:
    """Smooth reddish tissue with texture, seen by a scope that moves by `drift` px a frame; it breathes by `breath` px
    in the middle, less by a Gaussian of `reach` px beside, shines in other places in every frame, and a grey bar with a
    shadow beside it sweeps over it."""

    def __init__(
        self, drift: float = 0.0, breath: float = 0.0, gain: float = 0.0, shadow: bool = False, reach: float = 1e6
    ) -> None:
        self.drift, self.breath, self.gain, self.shadow, self.reach = drift, breath, gain, shadow, reach
        generator = np.random.default_rng(1)
        wide = generator.normal(0, 1, (2 * HEIGHT, 4 * WIDTH)).astype(np.float32)
        texture = 2 * cv2.GaussianBlur(wide, (0, 0), 2.0) + 5 * cv2.GaussianBlur(wide, (0, 0), 5.0)
        self.tissue = np.clip((125 + 22 * texture)[..., None] * [1.2, 0.65, 0.6], 15, 225).astype(np.float32)

    def place(self, number: int) -> int:
        """The bar's left edge, px."""
        return 10 + round((WIDTH - 50) * (0.5 - 0.5 * np.cos(0.9 * number)))

    def truth(self, number: int) -> np.ndarray:
        """bool [H, W]: where the bar is."""
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[20:90, self.place(number) : self.place(number) + 24] = True
        return mask

    def load(self, number: int) -> np.ndarray:
        generator = np.random.default_rng(100 + number)
        rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
        breathes = self.breath * np.exp(-(((columns - WIDTH / 2) / self.reach) ** 2)) * np.sin(1.1 * number)
        places = columns + WIDTH / 2 + self.drift * number, rows + 40 + breathes.astype(np.float32)
        image = cv2.remap(self.tissue, *places, cv2.INTER_LINEAR).astype(np.float64)
        for u, v in generator.integers((0, 0), (WIDTH, HEIGHT), (6, 2)).tolist():
            cv2.circle(image, (u, v), 1, (250, 245, 240), -1)
        left = self.place(number)
        if self.shadow:
            image[20:90, left + 24 : left + 34] *= 0.6
        image[self.truth(number)] = (95, 105, 115)
        image = image * (1 + self.gain * np.sin(0.7 * number)) + generator.normal(0, 1.5, image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("film", [Film(), Film(breath=1.0, gain=0.1)], ids=["plain", "breathing, exposure changes"])
def test_what_moves_before_a_still_background_is_found(film: Film) -> None:
    rows = np.arange(0, FRAMES, 5)
    masks = moving_masks(film.load, FRAMES, rows)
    truth = np.stack([film.truth(row) for row in rows.tolist()])
    assert (masks & truth).sum() / (masks | truth).sum() > 0.9


def test_the_instruments_shadow_is_no_instrument() -> None:
    film = Film(shadow=True)
    rows = np.arange(0, FRAMES, 5)
    masks = moving_masks(film.load, FRAMES, rows)
    shadows = np.stack([np.roll(film.truth(row), 24, axis=1) & ~film.truth(row) for row in rows.tolist()])
    shadows[:, :, -30:] = False
    narrow = shadows & np.stack([np.roll(film.truth(row), 10, axis=1) for row in rows.tolist()])
    assert masks[narrow].mean() < 0.2


def test_the_background_is_what_a_pixel_shows_most_often() -> None:
    film = Film()
    film.place = lambda number: 60 if number % 5 < 2 else 10  # type: ignore[method-assign]
    background = find_background(film.load, FRAMES)
    clean = Film()
    clean.truth = lambda number: np.zeros((HEIGHT, WIDTH), bool)  # type: ignore[method-assign]
    expected = find_background(clean.load, FRAMES)
    at = np.s_[20:90, 60:84]  # the bar stands there in two of five frames
    assert np.abs(background.colors[at] - expected.colors[at]).mean() < 2


def test_where_an_instrument_is_known_to_stand_the_other_frames_say_what_is_behind() -> None:
    film = Film()
    film.place = lambda number: 60 if number % 5 < 4 else 10  # type: ignore[method-assign]
    at = np.s_[25:85, 62:82]
    assert np.abs(find_background(film.load, FRAMES).colors[at] - (95, 105, 115)).mean() < 2  # unknown, it is tissue
    background = find_background(film.load, FRAMES, film.truth)
    clean = Film()
    clean.truth = lambda number: np.zeros((HEIGHT, WIDTH), bool)  # type: ignore[method-assign]
    expected = find_background(clean.load, FRAMES)
    assert np.abs(background.colors[at] - expected.colors[at]).mean() < 3
    assert background.seen[50, 70] == pytest.approx(0.2)


def test_a_scope_is_still_whatever_moves_before_it_and_moving_when_it_drifts() -> None:
    assert stands_still(Film().load, FRAMES)
    assert stands_still(Film(breath=1.0, gain=0.1, shadow=True).load, FRAMES)
    assert stands_still(Film(breath=4.0, reach=40.0).load, FRAMES)  # some of it hardly moves
    assert not stands_still(Film(drift=0.5).load, FRAMES)
    assert not stands_still(Film(breath=8.0).load, FRAMES)


def test_exposure_is_told_apart_from_what_moves() -> None:
    film = Film()
    background = find_background(film.load, FRAMES)
    image = np.clip(background.colors * (0.8, 0.9, 1.0), 0, 255).astype(np.uint8)
    image[20:80, 20:80] = 90
    assert exposure(image, background.colors) == pytest.approx([0.8, 0.9, 1.0], abs=0.01)


def test_cameras_that_are_turned_otherwise_than_stated_show_it_by_their_epipolar_lines() -> None:
    size, focal = (320, 256), 290.0
    lens = Lens(focal, focal, 160.0, 128.0, (), size)
    noise = np.random.default_rng(3).normal(0, 1, (*size[::-1], 1)).astype(np.float32)
    left = np.repeat(np.clip(128 + 200 * cv2.GaussianBlur(noise, (0, 0), 1.5), 0, 255)[..., None], 3, axis=2)
    matrix = np.array([[focal, 0, 159.5], [0, focal, 127.5], [0, 0, 1]])
    shift = np.array([-5.5, 0.0, 0.0])
    plane = matrix @ (np.eye(3) + np.outer(shift, [0, 0, 1]) / 100.0) @ np.linalg.inv(matrix)  # at 100 mm
    right = cv2.warpPerspective(left, plane, size)
    for degrees, expected in ((0.0, 0.0), (0.3, 1.52), (1.0, 5.06)):
        turn = Rotation.from_rotvec([degrees, 0, 0], degrees=True).as_matrix()
        error = epipolar_error(left, right, (lens, lens), rigid(turn, turn @ shift))
        assert error == pytest.approx(expected, abs=0.35)
    assert epipolar_error(left, np.zeros_like(left), (lens, lens), rigid(np.eye(3), shift)) is None


def test_images_of_a_few_pixels_neither_move_nor_end_in_an_error() -> None:
    noise = np.random.default_rng(7).integers(0, 256, (8, 12, 16, 3), dtype=np.uint8)
    assert not stands_still(noise.__getitem__, len(noise))


@pytest.mark.parametrize("deepest", [None, -38.0])
def test_instruments_behind_the_camera_tell_no_depth_of_the_tissue(deepest: float | None) -> None:
    surface = surface_behind([], Lens(145, 145, 80, 64, (), (160, 128)), deepest, 120.0)
    assert (surface.depth == 120).all()
    assert "not known" in surface.how
