"""A run is trained again with frames that were tracked by it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from grasper_world import RecordedRun, moving, record

from neeco.base.errors import NeecoError
from neeco.base.files import write_json
from neeco.capture import read_capture, write_capture
from neeco.capture.model import InstrumentState, State
from neeco.tracking import refine
from neeco.training.session import trust_of

CPU = torch.device("cpu")


def trusted(state: State, trust: float) -> State:
    return replace(state, instruments={name: replace(s, trust=trust) for name, s in state.instruments.items()})


@pytest.fixture
def tracked(tracked_run: RecordedRun, tmp_path: Path) -> Path:
    """Two frames as `track` writes them; one has the name of a frame of the run's own."""
    capture = record(tracked_run.scene, tmp_path / "drawn", [moving(30), moving(31)], "unseen")
    frames = [replace(f, state=trusted(f.state, 0.6)) for f in capture.frames]
    write_capture(replace(capture, frames=tuple(frames)), tmp_path / "tracked")
    return tmp_path / "tracked"


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What training was asked for; nothing is trained."""
    given: dict[str, Any] = {}

    def train(capture: Path, output: Path, config: Any, **others: Any) -> Path:
        given.update(capture=capture, output=output, config=config, **others)
        return output

    monkeypatch.setattr(refine, "train", train)
    return given


def test_tracked_frames_join_the_recorded_ones(tracked_run, tracked, tmp_path, asked):
    output = tmp_path / "refined"
    assert refine.refine_run(tracked_run, [tracked], output, device=CPU) == output / "run"
    assert asked["capture"] == output / "capture"
    assert not asked["config"].refine.latency
    merged, own = read_capture(output / "capture"), tracked_run.capture()
    assert len(merged.frames) == len(own.frames) + 2
    added = merged.frames[-2:]
    assert [frame.split for frame in added] == ["train", "train"]
    assert [frame.state.instruments["grasper"].trust for frame in added] == [0.6, 0.6]
    assert torch.equal(added[1].load_image(), read_capture(tracked).frames[1].load_image())
    assert not (output / "images").exists()
    with pytest.raises(NeecoError, match="not empty"):
        refine.refine_run(tracked_run, [tracked], output, device=CPU)
    refine.refine_run(tracked_run, [tracked], output, device=CPU, resume=True)
    with pytest.raises(NeecoError, match=r"refined.json: captures_sha256: begun with"):
        refine.refine_run(tracked_run, [tracked, tracked], output, device=CPU, resume=True)


def test_an_image_is_trained_on_once(tracked_run: RecordedRun) -> None:
    own = tracked_run.capture()
    withheld = replace(own.frames[1], split="unseen")
    own = replace(own, frames=(own.frames[0], withheld))
    tracked = [own.frames[0], replace(withheld, split="train")]
    left, added = refine.without_twice(own, tracked)
    assert left.frames == (own.frames[0],)
    assert added == [tracked[1]]
    assert refine.without_twice(own, [*tracked, *tracked])[1] == added


def test_frames_of_which_none_is_new_are_refused_before_any_work(tracked_run: RecordedRun, tmp_path: Path) -> None:
    own = tmp_path / "own"
    write_capture(tracked_run.capture(), own)
    with pytest.raises(NeecoError, match="every frame is one that the run was trained on"):
        refine.refine_run(tracked_run, [own], tmp_path / "out", device=CPU)
    assert not (tmp_path / "out").exists()


def test_fitting_ends_at_all_frames(tracked_run: RecordedRun) -> None:
    capture = tracked_run.capture()
    withheld = replace(capture, frames=tuple(replace(frame, split="test") for frame in capture.frames))
    told: list[tuple[int, int]] = []
    refine.fitted(tracked_run.scene, withheld, lambda done, total: told.append((done, total)))
    assert told[-1] == (len(capture.frames), len(capture.frames))


def test_recorded_states_are_fitted_to_their_images(tracked_run: RecordedRun) -> None:
    capture = tracked_run.capture()
    true = capture.frames[3].state.instruments["grasper"]
    shifted = true.pose.clone()
    shifted[0, 3] += 1.0
    off = replace(capture.frames[3], state=State({"grasper": InstrumentState(shifted, true.joints)}))
    test = replace(off, split="test")
    train, kept = refine.fitted(tracked_run.scene, replace(capture, frames=(off, test)), lambda done, total: None)
    assert abs(float(train.state.instruments["grasper"].pose[0, 3] - true.pose[0, 3])) < 0.3
    assert kept.state is test.state  # what is scored stays as recorded


def test_captures_that_do_not_belong_to_the_run_are_refused(tracked_run, tracked, footage, tmp_path):
    bare = replace(footage, frames=tuple(replace(f, state=State({}, f.state.time)) for f in footage.frames))
    write_capture(bare, tmp_path / "bare")
    with pytest.raises(NeecoError, match="does not state 'grasper'"):
        refine.refine_run(tracked_run, [tmp_path / "bare"], tmp_path / "out", device=CPU)
    write_json(tracked / "track.json", {"tissue": "footage"})
    with pytest.raises(NeecoError, match="a world of its own"):
        refine.refine_run(tracked_run, [tracked], tmp_path / "out", device=CPU)
    assert not (tmp_path / "out").exists()


def test_a_frame_counts_as_far_as_its_least_trusted_instrument() -> None:
    recorded, found = InstrumentState(torch.eye(4)), InstrumentState(torch.eye(4), {}, 0.7)
    assert trust_of(State({})) == trust_of(State({"a": recorded})) == 1.0
    assert trust_of(State({"a": recorded, "b": found})) == 0.7
