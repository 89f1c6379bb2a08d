"""Ways to find cameras are tried until one is good, the best is kept, and a scope that stands still is told apart."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.ingest.cameras import sfm
from neeco.ingest.cameras.sfm import Attempt, StructureFromMotion, best_attempt, judge, motion_fault, strategies
from neeco.ingest.recording.model import IngestSettings

SIZE = (1280, 720)
FREE = strategies(600.0)
GOOD = Attempt(FREE[0], 80, models=(80,), focal=830.0, distortion=-0.03, points=8000, error=1.1, parallax=6.0)


def judged(**changes) -> str:
    return judge(replace(GOOD, **changes), SIZE, 10).fault


def test_the_field_of_view_gives_the_first_focal_length():
    assert FREE[0].focal == pytest.approx(857, abs=1)
    assert FREE[1].focal < FREE[0].focal
    assert all(strategy.focal == 0 and not strategy.free_lens for strategy in strategies(None))


def test_models_that_no_endoscope_makes_are_refused():
    assert judged() == ""
    assert "focal length of 90 px" in judged(focal=90.0)
    assert "focal length of 9000 px" in judged(focal=9000.0)
    assert "radial distortion of 7.30" in judged(focal=1779.0, distortion=7.3)
    assert "ends after 2 of 80" in judged(models=(2,))
    assert "no first pair" in judged(models=())
    assert "depth is not known" in judged(parallax=0.3)
    assert "off by 3.1 px" in judged(error=3.1)


def test_the_best_places_most_frames_then_fits_best_then_has_most_parallax():
    assert best_attempt([]) is None
    assert best_attempt([replace(GOOD, fault="none")]) is None
    few, many = replace(GOOD, models=(30,), error=0.4), replace(GOOD, models=(60, 20), error=1.4)
    assert best_attempt([few, many]) is many
    nearly = replace(many, models=(59,), error=0.9)
    assert best_attempt([many, nearly]) is nearly
    wide = replace(nearly, parallax=9.0)
    assert best_attempt([nearly, wide]) is wide
    assert best_attempt([nearly, replace(nearly)]) is nearly
    assert best_attempt([replace(many, fault="bad"), few]) is few


@pytest.fixture
def search(tmp_path, monkeypatch):
    """Structure from motion of 100 frames by a worker that answers with the attempts given; (it, tasks done)."""

    def made(*answers: dict, pinhole: Lens | None = None, minutes: float = 20.0, matches: np.ndarray | None = None):
        tasks, waiting = [], list(answers)
        none = {"models": [], "focal": 0.0, "distortion": 0.0, "points": 0, "error": 0.0, "parallax": 0.0}

        def run(job_file: Path, source: Path, progress) -> float:
            job = json.loads(job_file.read_text())
            tasks.append((job["task"], Path(job["database"]).name))
            if job["task"] == "map":
                answer = waiting.pop(0) if waiting else {}
                if answer is None:
                    raise NeecoError(f"{source}: structure from motion stopped")
                Path(job["model"]).mkdir()
                (Path(job["model"]) / "attempt.json").write_text(json.dumps(none | answer))
            if job["task"] == "matches":
                np.savez(job_file.with_name("matches.npz"), matches=np.zeros((0, 5)) if matches is None else matches)
            return 30.0

        monkeypatch.setattr(sfm, "run_worker", run)
        settings = IngestSettings(sfm_minutes=minutes)
        names = [f"{index:06d}.png" for index in range(100)]
        made_sfm = StructureFromMotion(
            work=tmp_path, source=Path("video.mp4"), folder=tmp_path, names=names, size=SIZE, pinhole=pinhole,
            masks=None, settings=settings,
        )  # fmt: skip
        return made_sfm, tasks

    return made


WHOLE = {"models": [100], "focal": 840.0, "distortion": -0.03, "points": 9000, "error": 1.1, "parallax": 6.0}
DEAD_END = {"models": [2], "focal": 1779.0, "distortion": 7.3, "points": 300, "error": 0.5, "parallax": 6.0}


def test_a_dead_end_is_followed_by_another_way_from_the_same_features(search):
    motion, tasks = search(DEAD_END, WHOLE)
    best = motion._search(lambda *_: None)
    assert best.placed == 100
    assert tasks == [("match", "database.db"), ("map", "database.db"), ("map", "database.db")]
    assert motion.search[0].endswith("ends after 2 of 100 keyframes")
    assert motion.search[-1] == f"taken: {best.strategy.words}"
    assert motion._job_of(best.strategy)["model"].endswith("attempt1")


def test_what_works_at_once_is_not_tried_again(search):
    motion, tasks = search(WHOLE | {"focal": 0.0, "distortion": 0.0}, pinhole=Lens(290, 290, 160, 128))
    motion._search(lambda *_: None)
    assert [task for task, _ in tasks] == ["match", "map"]


def test_a_worker_that_fails_and_the_end_of_the_time_are_told(search):
    half = WHOLE | {"models": [50]}
    motion, tasks = search(None, half, minutes=0.9)
    assert motion._search(lambda *_: None).placed == 50
    assert len(tasks) == 3
    assert "structure from motion stopped" in motion.search[0]
    assert "0.9 processor minutes" in motion.search[-2]


def test_when_nothing_helps_every_way_is_named(search):
    motion, tasks = search()
    with pytest.raises(NeecoError, match=r"no cameras could be found in 5 ways .*with more features: no first pair"):
        motion._search(lambda *_: None)
    assert ("match", "dense.db") in tasks


def matched(depth: np.ndarray, moves: list[tuple[np.ndarray, np.ndarray]], focal: float = 800.0) -> np.ndarray:
    """Matches [N, 5] between a first view and each of the others, with rotation vectors and translations, and noise."""
    generator = np.random.default_rng(0)
    first = generator.uniform((100, 100), (1180, 620), (len(depth), 2))
    rays = np.column_stack([(first - [640, 360]) / focal, np.ones(len(depth))]) * depth[:, None]
    rows = []
    for pair, (turn, shift) in enumerate(moves):
        seen = Rotation.from_rotvec(turn).apply(rays) + shift
        second = focal * seen[:, :2] / seen[:, 2:] + [640, 360] + generator.normal(0, 0.5, first.shape)
        second[:10] = generator.uniform(0, 700, (10, 2))  # mismatches
        rows.append(np.column_stack([np.full(len(first), pair), first, second]))
    return np.concatenate(rows)


def test_a_still_and_a_turning_scope_are_told_apart_from_a_moving_one():
    depth = np.random.default_rng(1).uniform(60, 140, 200)
    still, turns, shifts = np.zeros(3), np.linspace(0.05, 0.2, 8), np.linspace(4, 20, 8)
    assert "stand still" in motion_fault(matched(depth, [(still, still)] * 8), 1280)
    turned = matched(depth, [(np.array([0.3 * turn, turn, turn]), still) for turn in turns])
    assert "only to turn" in motion_fault(turned, 1280)
    moved = matched(
        depth, [(np.array([0, 0, turn]), np.array([shift, 2, 0])) for turn, shift in zip(turns, shifts, strict=True)]
    )
    assert motion_fault(moved, 1280) == ""
    assert motion_fault(turned[:20], 1280) == ""  # nothing is concluded from little


def test_a_scope_that_stands_still_is_refused_in_one_line_that_says_so(search):
    motion, _ = search(matches=matched(np.full(200, 100.0), [(np.zeros(3), np.zeros(3))] * 8))
    with pytest.raises(
        NeecoError, match=r"stand still, and cameras come from parallax; record with a scope that moves"
    ):
        motion._search(lambda *_: None)


def test_the_visible_circle_sets_the_radius(search, tmp_path):
    motion, _ = search()
    assert motion._radius() == pytest.approx(np.hypot(640, 360))
    rows, columns = np.indices((720, 1280))
    disc = np.hypot(columns - 640, rows - 360) < 300
    Image.fromarray(disc.astype(np.uint8) * 255).save(tmp_path / "000000.png.png")
    motion.masks = tmp_path
    assert motion._radius() == pytest.approx(300, abs=2)
