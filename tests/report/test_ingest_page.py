"""The ingest page says how good a capture is, in one offline file, whatever parts the recording had."""

from __future__ import annotations

import io
import json
import re
import shutil
from base64 import b64decode
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from html_page import HOSTILE, Page, check_hostile_names
from PIL import Image

from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.capture.documents import Problem
from neeco.capture.images import write_image
from neeco.capture.kinematics import KinematicTree, Link
from neeco.capture.model import Frame, State
from neeco.geometry.camera import Camera
from neeco.ingest.foreground.rough_shape import RoughShape
from neeco.ingest.frames.images import DropReason
from neeco.ingest.registration.base import BaseRegistration
from neeco.ingest.registration.hand_eye import Registration
from neeco.ingest.result import LIMITS, IngestResult, assess_ingest
from neeco.ingest.timing.clock_search import ClockOffset
from neeco.ingest.timing.episodes import Contradiction
from neeco.report import ingest_page
from neeco.report.ingest_page import degrees_of_freedom, in_view, posed_picture, round_length, unvisited

SAMPLE = Path(__file__).parents[2] / "samples" / "liver-mini"
VOID = {"meta", "img", "br", "path", "rect"}
TIP_MM = 24.0


def shaft() -> RoughShape:
    """The sample's instrument, roughly: a rod along its z axis that comes in from behind."""
    z, x = np.meshgrid(np.arange(-40, TIP_MM + 1, 2.0), [-2.0, 0.0, 2.0])
    return RoughShape(np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1), 2.0, 0.8)


def made(folder: Path, **changes) -> IngestResult:
    """A result about the capture in `folder`, with a registration that is right to 0.5 mm."""
    capture = read_capture(folder)
    count = len(capture.frames)
    times = np.array([frame.state.time for frame in capture.frames])
    clock = ClockOffset(0.0388, 0.0012, "scope motion")
    registration = Registration(
        scale=4.4, rotation=np.eye(3), translation=np.zeros(3), camera_from_sensor=np.eye(4), clock=clock,
        scale_sd=0.004, position_residual=np.full(count, 0.5), rotation_residual=np.full(count, 0.003),
        used=np.arange(count), origin=np.zeros(3), covariances=np.zeros((3, 7, 7)),
    )  # fmt: skip
    dropped = tuple(
        (frame, DropReason(f"blurred: {frame % 50}% of its neighbours' sharpness")) for frame in (96, 97, 98, 105)
    )
    result = IngestResult(
        capture=folder, recording="rec <1>.yaml", video_frames=106, video_fps=25.0, size=(240, 192),
        selected=np.arange(count), selected_times=times, dropped=(*dropped, (99, DropReason("no camera"))),
        clocks={"em": clock, "jaw_angle": ClockOffset(-0.0097, 0.0, "given")}, registration=registration,
        reprojection_px=0.36, points=len(capture.points.positions),
        shapes={capture.instruments[0].name: shaft()} if capture.instruments else {},
        split_rule="unseen: jaw_angle above 59 deg", notes=("12 rows dropped: <NaN>",),
        search=("with the lens given: ends after 2 of 80 keyframes", "taken: all frames at once"),
    )  # fmt: skip
    return replace(result, **changes)


def based(overlap: float, sd_mm: float = 1.0) -> BaseRegistration:
    """A base found from outlines that overlap with what moves by so much, and its greatest standard deviation."""
    return BaseRegistration(
        world_from_base=np.eye(4), clock_s=0.0, clock_sd_s=0.0, open_directions=(),
        covariance=np.diag([*[np.radians(0.2) ** 2] * 3, 0.04, sd_mm**2, 0.04]),
        moved_mm=0.0, turned_deg=0.0, overlap=overlap, overlap_before=0.5, residual_px=1.0, frames=100,
    )  # fmt: skip


def write_ingest_page(result: IngestResult, path: Path) -> None:
    """The page with the verdict that goes with it."""
    capture = read_capture(result.capture)
    ingest_page.write_ingest_page(result, assess_ingest(result, capture), path, capture)


def edited(folder: Path, change) -> Path:
    """A copy of the sample with its transforms.json changed."""
    shutil.copytree(SAMPLE, folder, ignore=shutil.ignore_patterns("truth"))
    document = json.loads((folder / "transforms.json").read_text())
    change(document)
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "ingest.html"
    write_ingest_page(made(SAMPLE), path)
    return path.read_text()


def test_the_page_is_whole_and_fetches_nothing(text):
    page = Page(VOID)
    page.feed(text)
    assert page.open == []
    assert len(page.references) == 12
    assert all(reference.startswith("data:image/jpeg") for reference in page.references)
    assert "http" not in text
    assert page.tags.count("svg") == 7  # degrees of freedom
    assert "prefers-color-scheme: dark" in text
    assert 'name="viewport"' in text


@pytest.mark.parametrize(
    "pieces",
    [
        ("Ready to train", "0.50 mm", "0.17°", "0.36 px", "+38.8", "±1.2", "scope motion", "−9.7"),
        ("unseen: jaw_angle above 59 deg",),
        ("<li>with the lens given: ends after 2 of 80 keyframes</li><li>taken: all frames at once</li>",),
        # dropped frames by reason, with their numbers
        (
            "<td>blurred: …% of its neighbours&#39; sharpness</td><td>4</td>",
            "96–98, 105",
            "<td>no camera</td><td>1</td>",
        ),
        ("rec &lt;1&gt;.yaml", "&lt;NaN&gt;"),  # what the user wrote
    ],
)
def test_the_page_says_what_was_found(text, pieces):
    assert all(piece in text for piece in pieces)


def test_the_tracked_frame_is_drawn_where_the_instrument_is(tmp_path):
    def first_picture(**changes):
        write_ingest_page(made(SAMPLE, **changes), tmp_path / "page.html")
        uri = re.search(r'src="data:image/jpeg;base64,([^"]*)"', (tmp_path / "page.html").read_text())[1]
        return np.asarray(Image.open(io.BytesIO(b64decode(uri))).convert("RGB")).astype(int)

    capture = read_capture(SAMPLE)
    assert 0.5 < in_view(capture, capture.instruments[0].name) <= 1
    frame = min(capture.frames, key=lambda frame: frame.state.time)
    camera, state = frame.camera, next(iter(frame.state.instruments.values()))
    pose = camera.world_from_camera.double().numpy()
    x, y, z = (state.pose.numpy()[:3, 3] - pose[:3, 3]) @ pose[:3, :3]
    drawn, without_shape = first_picture(), first_picture(shapes={})
    scale = drawn.shape[1] / camera.width
    column, row = round((camera.fx * x / z + camera.cx) * scale), round((camera.fy * y / z + camera.cy) * scale)
    assert drawn[row, column].min() > 200  # the white dot at the frame's origin
    recorded = np.asarray(Image.open(frame.image_path).convert("RGB").resize(drawn.shape[1::-1])).astype(int)
    changed = np.abs(without_shape - recorded).max(axis=2) > 120
    assert changed.any()
    assert np.hypot(*(np.argwhere(changed) - [row, column]).T).max() < 0.3 * drawn.shape[1]
    assert (np.abs(drawn - without_shape).max(axis=2) > 120).sum() > 200  # outline


def test_a_shaft_found_in_video_is_outlined_as_wide_as_it_is(tmp_path):
    camera = Camera(torch.eye(4), 100.0, 100.0, 48.0, 32.0, 96, 64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # z to the image's right
    pose[2, 3] = 50.0
    write_image(tmp_path / "grey.png", torch.full((64, 96, 3), 0.3))
    frame = Frame(tmp_path / "grey.png", camera, State({}, 0.0), "train")
    uri = posed_picture(frame, {"rod": pose}, {}, 0.001, {"rod": 10.0})
    drawn = np.asarray(Image.open(io.BytesIO(b64decode(uri.split(",")[1]))).convert("RGB")).astype(int)
    yellow = drawn[..., 0] - drawn[..., 2] > 40
    scale = drawn.shape[1] / 96
    rows = np.flatnonzero(yellow[:, round(20 * scale)])
    assert rows.min() / scale == pytest.approx(22, abs=1)  # 5 mm of 50 mm to either side of the middle, by 100 px
    assert rows.max() / scale == pytest.approx(42, abs=1)
    assert not yellow[:, round(52 * scale) :].any()  # it ends in the middle


def test_a_stretch_without_a_training_frame_is_named():
    degrees = degrees_of_freedom(read_capture(SAMPLE))
    assert [degree.name for degree in degrees[3:]] == ["pitch", "yaw", "roll", "jaw_angle"]
    jaw = degrees[-1]
    hole = replace(jaw, values=np.where(jaw.values > 30, jaw.values + 30, jaw.values))
    assert any(sentence.startswith("jaw_angle: no frames between") for sentence in unvisited([hole]))


def test_roll_about_the_z_axis_is_roll_alone():
    capture = read_capture(SAMPLE)
    name = capture.instruments[0].name
    frames = []
    start = capture.frames[0].state.instruments[name]
    for frame, angle in zip(capture.frames, np.linspace(-0.7, 0.7, len(capture.frames)), strict=True):
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose = start.pose @ start.pose.new_tensor(turn)
        frames.append(
            replace(frame, split="train", state=replace(frame.state, instruments={name: replace(start, pose=pose)}))
        )
    degrees = {d.name: d for d in degrees_of_freedom(replace(capture, frames=tuple(frames)))}
    assert np.ptp(degrees["roll"].values) == pytest.approx(np.degrees(1.4))
    assert np.abs(degrees["pitch"].values).max() < 1e-6
    assert np.abs(degrees["yaw"].values).max() < 1e-6


@pytest.mark.parametrize(
    ("changes", "level", "piece"),
    [
        ({}, "good", "Ready to train"),
        ({"reprojection_px": 1.7}, "careful", "1.70 px"),
        ({"reprojection_px": 4.0}, "bad", "4.00 px"),
        ({"points": 40}, "careful", "40 tissue points"),
        ({"clocks": {"em": ClockOffset(0.0, 0.08, "scope motion")}}, "bad", "Clock em"),
        ({"clocks": {"jaw_angle": ClockOffset(0.0, float("nan"), "assumed")}}, "careful", "jaw_angle"),
        ({"dropped": tuple((i, DropReason("blurred")) for i in range(60))}, "careful", "60 of 106"),
        ({"contradictions": (Contradiction("nothing moves with the tool", True),)}, "bad", "Doubtful: nothing moves"),
        ({"contradictions": (Contradiction("the video is fast", False),)}, "careful", "with care: the video is"),
        ({"bases": {"psm1": based(0.68)}}, "bad", "overlap by 0.68"),
        ({"bases": {"psm1": based(0.80)}}, "careful", "overlap by 0.80"),
        ({"bases": {"psm1": based(0.92, sd_mm=4.0)}}, "careful", "psm1 is known to ±4.0 mm only"),
        ({"bases": {"psm1": based(0.92)}}, "good", "Ready"),
        ({"dropped": tuple((i, DropReason("not best", frame_usable=True)) for i in range(60))}, "good", "Ready"),
    ],
)  # fmt: skip
def test_the_verdict_names_what_is_doubtful(changes, level, piece):
    verdict = assess_ingest(made(SAMPLE, **changes), read_capture(SAMPLE))
    assert verdict.level == level
    assert piece in " ".join([verdict.headline, *verdict.warnings])


def test_small_residuals_of_a_scope_that_turned_little_do_not_make_a_good_verdict():
    loose = np.diag([1e-4, *[4e-4] * 3, *[0.2] * 3])  # 1.1 degrees, 0.4 mm
    result = made(SAMPLE)
    result = replace(result, registration=replace(result.registration, covariances=np.stack([loose] * 3)))
    verdict = assess_ingest(result, read_capture(SAMPLE))
    assert verdict.level == "careful"
    assert "the place of instruments in the images is known to ±1.1°" in " ".join(verdict.facts)


@pytest.mark.parametrize(("overlap", "advice"), [(0.68, "do not train"), (0.93, "good")])
def test_a_reason_is_stated_once_with_what_is_usual(tmp_path, overlap, advice):
    note = "the outline of psm1 and what moves overlap by"
    result = made(SAMPLE, bases={"psm1": based(overlap)}, notes=(f"{note} {overlap:.2f} only; check its clock.",))
    verdict = assess_ingest(result, read_capture(SAMPLE))
    assert verdict.as_json()["advice"] == advice
    assert len(verdict.as_json()["facts"]) == 2
    *_, last = lines = ingest_page.Ingested(tmp_path, result, verdict).lines()
    assert last.startswith(f"{advice}: ")
    if advice != "good":
        lines = [line for line in lines if "outline of psm1" in line]
        assert len(lines) == 1
        assert "check its clock (usual: 0.85 or more)" in lines[0]
    write_ingest_page(result, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert ("Measured: " in page) == (advice == "good")
    assert page.partition('class="tiles"')[0].count(f"utline of psm1 and what moves overlap by {overlap:.2f}") == 1


def test_a_page_counts_the_images_of_both_cameras(tmp_path):
    times = np.array([frame.state.time for frame in read_capture(SAMPLE).frames])
    one_less = made(SAMPLE, selected=np.arange(95), selected_times=times[:95], registration=None)
    write_ingest_page(one_less, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "96 images, 1 of them by the second camera (72 train, 12 test, 12 unseen)" in page
    assert "eyes" not in page


@pytest.mark.parametrize(("tracked", "level", "limit"), [(False, "good", "2"), (True, "careful", "1")])
def test_a_tracked_instruments_corrected_place_is_judged_as_a_hand_eye_calibration(tracked, level, limit):
    found = replace(based(0.95), shaft=np.array([0.0, 1.0, 0.0]), sd_motion_mm=1.3, tracked=tracked)
    verdict = assess_ingest(made(SAMPLE, bases={"grasper": found}), read_capture(SAMPLE))
    assert verdict.level == level
    assert f"the motion of grasper is known to ±1.3 mm (usual: {limit} or less)" in verdict.facts


def test_what_is_unknown_along_a_shaft_counts_where_links_are_stated_from_there():
    capture = read_capture(SAMPLE)
    (instrument,) = capture.instruments
    found = {instrument.name: replace(based(0.95, sd_mm=4.0), shaft=np.array([0.0, 1.0, 0.0]), sd_motion_mm=0.7)}
    result = made(SAMPLE, bases=found)
    assert assess_ingest(result, capture).level == "good"
    links = KinematicTree((Link("shaft"),))
    verdict = assess_ingest(result, replace(capture, instruments=(replace(instrument, kinematics=links),)))
    assert verdict.level == "careful"
    assert f"the place of {instrument.name} along its shaft is known to ±4.0 mm" in verdict.facts[0]


def test_what_check_finds_is_in_the_verdict():
    capture = read_capture(SAMPLE)
    for severity, contradicted, level in (
        ("warning", False, "careful"),
        ("warning", True, "bad"),
        ("error", False, "bad"),
    ):
        words = ("transforms.json", "frames", "images contradict the poses", "correct them")
        problem = Problem(severity, *words, contradicted)
        verdict = assess_ingest(made(SAMPLE), capture, [problem])
        assert verdict.level == level
        assert "images contradict the poses; correct them" in verdict.headline


def test_the_terminal_gets_a_doubtful_verdict_in_capitals_and_the_first_doubts():
    found = tuple(Contradiction(f"reason {number}", True) for number in range(LIMITS.max_shown + 3))
    verdict = assess_ingest(made(SAMPLE, contradictions=found), read_capture(SAMPLE))
    first, *others = verdict.lines()
    assert first == "DOUBTFUL: reason 0."
    assert others == [
        *(f"  - Reason {number}." for number in range(1, LIMITS.max_shown + 1)),
        "  - and 2 more warnings",
    ]
    assert verdict.as_json()["verdict"] == "doubtful"
    assert len(verdict.as_json()["doubts"]) == LIMITS.max_shown + 3


def bare(document):
    document["instrument_frame"] = "unregistered"
    document.pop("instruments", None)
    for frame in document["frames"]:
        for state in frame["instruments"]:
            state["joints"] = {}


def without_instruments(document):
    document.pop("ply_file_path")
    document.pop("instruments", None)
    for frame in document["frames"]:
        frame["instruments"] = []


@pytest.mark.parametrize(
    ("change", "result", "shown"),
    [
        (
            bare,
            {"clocks": {}, "shapes": {}, "dropped": (), "notes": ()},
            (
                "do not meet",
                "camera_from_base",
                "cannot be overlaid",
                "No joint was recorded",
                "lengths are only relative",
                "None: every video frame",
            ),
        ),
        (
            without_instruments,
            {"reprojection_px": None, "clocks": {}, "points": 0},
            ("Cameras only", "no instrument states", "points are random"),
        ),
    ],
)
def test_a_page_says_what_there_is_not(change, result, shown, tmp_path):
    write_ingest_page(made(edited(tmp_path / "capture", change), registration=None, **result), tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert all(piece in text for piece in shown)
    assert "<h2>Clocks" not in text


def test_a_capture_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(NeecoError, match="no such folder"):
        write_ingest_page(replace(made(SAMPLE), capture=tmp_path / "gone"), tmp_path / "page.html")


def test_hostile_names_are_text_and_the_same_data_gives_the_same_page(tmp_path, noon):
    def rename(document):
        document["instruments"] = [{"name": HOSTILE, "joints": {HOSTILE: {"limits": [0, 2]}}}]
        for frame in document["frames"]:
            frame["split"] = frame["split"] if frame["split"] == "train" else HOSTILE
            for state in frame["instruments"]:
                state.update(name=HOSTILE, joints={HOSTILE: next(iter(state["joints"].values()))})

    clock = ClockOffset(0.0, float("nan"), HOSTILE)
    names = {"recording": HOSTILE, "clocks": {HOSTILE: clock}, "split_rule": HOSTILE, "notes": (HOSTILE,)}
    result = made(edited(tmp_path / HOSTILE, rename), dropped=((3, DropReason(HOSTILE)),), **names)
    path = tmp_path / "page.html"

    def write():
        write_ingest_page(result, path)
        return path.read_text()

    check_hostile_names(write, VOID)


@pytest.mark.parametrize(
    ("wanted", "length"), [(0.03, 0.02), (1.0, 1.0), (4.9, 2.0), (7.0, 5.0), (10.0, 10.0), (99.0, 50.0)]
)
def test_lengths_drawn_are_round_and_no_longer_than_wanted(wanted, length):
    assert round_length(wanted) == pytest.approx(length)
