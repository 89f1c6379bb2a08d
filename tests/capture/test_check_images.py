"""`neeco check` compares the sparse points' colours with the images and names only mistakes that these confirm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from neeco.capture.checks.evidence import read_pictures
from neeco.capture.checks.verdicts import ImageVerdicts
from neeco.capture.documents import Node, ProblemReport
from neeco.capture.model import Frame, State
from neeco.capture.points import PointCloud
from neeco.capture.readers.parsed import Parsed
from neeco.geometry.camera import Camera

FRAMES, WIDTH, HEIGHT, FOCAL, DISTANCE = 10, 96, 72, 90.0, 60.0


def world() -> tuple[np.ndarray, list[np.ndarray]]:
    """A picture of a plane at z = 0, 1 px per 0.5 mm around its middle, and cameras [4, 4] that look at it."""
    generator = np.random.default_rng(1)
    noise = cv2.GaussianBlur(generator.normal(size=(300, 300, 3)).astype(np.float32), (0, 0), 2.0)
    picture = np.clip(np.array([150, 80, 60]) + 300 * noise, 0, 255).astype(np.uint8)
    cameras = []
    for index in range(FRAMES):
        pose = np.eye(4)
        pose[:3, 3] = [3.5 * index - 16, 12 * np.sin(index), -DISTANCE - 5 * np.cos(index)]
        cameras.append(pose)
    return picture, cameras


def seen(picture: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """The plane as a camera [4, 4] that looks along z sees it."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    depth = -pose[2, 3]
    x = (u - WIDTH * 0.45) / FOCAL * depth + pose[0, 3]
    y = (v - HEIGHT * 0.55) / FOCAL * depth + pose[1, 3]
    return cv2.remap(picture, *(((at + 75) * 2 - 0.5).astype(np.float32) for at in (x, y)), cv2.INTER_LINEAR)


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Parsed:
    folder = tmp_path_factory.mktemp("images")
    picture, cameras = world()
    frames = []
    for index, pose in enumerate(cameras):
        path = folder / f"{index:02d}.png"
        Image.fromarray(seen(picture, pose)).save(path)
        camera = Camera(pose, FOCAL, FOCAL, WIDTH * 0.45, HEIGHT * 0.55, WIDTH, HEIGHT)
        frames.append(Frame(path, camera, State(time=0.04 * index), "train"))
    points = np.random.default_rng(2).uniform(-40, 40, (400, 3)) * [1, 1, 0]
    rows, columns = ((points[:, [1, 0]] + 75) * 2).astype(int).T
    place = Node(None, "transforms.json", "frames[0]", ProblemReport())
    cloud = PointCloud(points, picture[rows, columns] / 255)
    return Parsed(folder, frames=frames, places=[place] * FRAMES, points=cloud, points_place=place)


def found(capture: Parsed) -> list[str]:
    report = ProblemReport()
    places = [replace(place, report=report) for place in capture.places]
    parsed = replace(capture, places=places)
    ImageVerdicts(parsed, read_pictures(parsed)).report()
    assert all(problem.severity == "warning" for problem in report.problems)
    return [problem.message for problem in report.problems]


def with_paths(capture: Parsed, rows: list[int]) -> Parsed:
    """Frames with the images of other frames."""
    frames = [
        replace(frame, image_path=capture.frames[row].image_path)
        for frame, row in zip(capture.frames, rows, strict=True)
    ]
    return replace(capture, frames=frames)


def with_pixels(capture: Parsed, folder: Path, change) -> Parsed:
    frames = []
    for frame in capture.frames:
        path = folder / frame.image_path.name
        Image.fromarray(np.ascontiguousarray(change(np.array(Image.open(frame.image_path))))).save(path)
        frames.append(replace(frame, image_path=path))
    return replace(capture, frames=frames)


def with_cameras(capture: Parsed, **changed) -> Parsed:
    return replace(
        capture, frames=[replace(frame, camera=replace(frame.camera, **changed)) for frame in capture.frames]
    )


def test_right_images_are_silent_in_any_light(capture, tmp_path):
    assert found(capture) == []
    lit = np.linspace(0.3, 1.0, WIDTH)[:, None] * [1.0, 0.9, 0.8]  # shading and white balance
    assert found(with_pixels(capture, tmp_path, lambda image: (image * lit).astype(np.uint8))) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda image: image[:, ::-1], "mirrored left to right"),
        (lambda image: image[..., ::-1], "red and blue of the images are swapped"),
    ],
)
def test_turned_images_and_swapped_colors_are_named(capture, tmp_path, change, words):
    (message,) = found(with_pixels(capture, tmp_path, change))
    assert words in message


def test_images_of_other_frames_are_named_with_their_number(capture):
    rows = list(range(FRAMES))
    (message,) = found(with_paths(capture, [*rows[1:], rows[-1]]))
    assert message == "the images fit the cameras of 1 frame later"
    (message,) = found(with_paths(capture, np.random.default_rng(3).permutation(rows).tolist()))
    assert message.startswith("the images contradict the cameras")


def test_other_intrinsics_contradict_the_images(capture):
    (message,) = found(with_cameras(capture, cx=WIDTH * 0.15, cy=HEIGHT * 0.85))
    assert message.startswith("the images contradict the cameras")


def test_images_of_another_scene_contradict_the_cameras_and_no_cause_is_named(capture, tmp_path):
    noise = np.random.default_rng(4).normal(0, 60, (HEIGHT, WIDTH, 3))
    (message,) = found(with_pixels(capture, tmp_path, lambda image: np.clip(120 + noise, 0, 255).astype(np.uint8)))
    assert message.startswith("the images contradict the cameras")


def test_nothing_is_said_where_the_points_have_no_colors_of_their_own(capture, tmp_path):
    assert capture.points is not None
    grey = replace(capture, points=PointCloud(capture.points.positions))
    assert found(with_pixels(grey, tmp_path, lambda image: image[:, ::-1])) == []


def test_nothing_is_said_of_plain_cloth_whose_noise_alone_varies(capture, tmp_path):
    """As of draped cloth in one colour: right cameras, but the points have the noise of the images they are from."""
    assert capture.points is not None
    generator = np.random.default_rng(5)
    noisy = PointCloud(capture.points.positions, 0.4 + generator.normal(0, 0.05, capture.points.colors.shape))
    plain = replace(capture, points=noisy)

    def cloth(image: np.ndarray) -> np.ndarray:
        return np.clip(100 + generator.normal(0, 4, image.shape), 0, 255).astype(np.uint8)

    assert found(with_pixels(plain, tmp_path, cloth)) == []
