"""Footage without states becomes a capture with them, each trusted as far as it should be."""

from __future__ import annotations

import json
import math
import shutil
from copy import copy
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from folder_contents import contents
from grasper_world import CAMERA, FRAMES, GRASPER, RecordedRun, grasper_state, moving, record, withheld

from neeco.base.errors import NeecoError
from neeco.capture import check_capture, errors_only, read_capture
from neeco.capture.images import write_image
from neeco.capture.kinematics import REVOLUTE, KinematicTree, Link
from neeco.capture.model import Capture, State
from neeco.evaluation.trust import TypicalErrors
from neeco.report.run_page import write_track_page
from neeco.states.crop_rendering import FrameView, InstrumentRenderer, TissueRenderer, color_matched, view_of
from neeco.states.fitter import loose_prior
from neeco.states.parameters import DEG
from neeco.tracking.follow import FOLLOW, Follower, Step
from neeco.tracking.motion import MotionModel
from neeco.tracking.parameters import TrackedParameters, fitter_of
from neeco.tracking.track import StepFiles, Tracked, state_of, track_footage, write_tracked
from neeco.tracking.trust import Reference, TrackTrust


def off(found: State, true: State) -> tuple[float, float, float]:
    """deg, mm and deg of the jaw between two states; the shift is the hinge's."""
    a, b = found.instruments["grasper"], true.instruments["grasper"]
    turn = a.pose[:3, :3].T @ b.pose[:3, :3]
    angle = math.acos(max(-1.0, min(1.0, (float(turn.diagonal().sum()) - 1) / 2)))
    jaw = abs(a.joints["jaw_angle"] - b.joints["jaw_angle"])
    return angle / DEG, float((a.pose[:3, 3] - b.pose[:3, 3]).norm()), jaw / DEG


@pytest.fixture(scope="module")
def tracked(tracked_run: RecordedRun, footage: Capture, tmp_path_factory: pytest.TempPathFactory) -> Tracked:
    output = tmp_path_factory.mktemp("tracked") / "capture"
    return track_footage(tracked_run, withheld(footage), output, start="first")


def test_an_increment_leads_from_one_state_to_another(tracked_run: RecordedRun) -> None:
    parameters = TrackedParameters.of(tracked_run.scene)
    one, other = grasper_state(jaw=0.4), grasper_state(3, -2, 75, 0.3, -0.5, 0.7)
    reached = parameters.moved(one, parameters.increments_between(one, other))
    assert off(reached, other) == pytest.approx((0, 0, 0), abs=1e-4)


def test_a_stretch_of_little_trust_is_gone_through_backwards_looking_for_other_rolls_in_every_frame(
    tmp_path: Path, tracked_run: RecordedRun
) -> None:
    motion = MotionModel.of(TrackedParameters.of(tracked_run.scene), tracked_run.scene.recorded.states)
    estimate = motion.begin(grasper_state())
    asked = []

    class Follower:
        frames = range(6)

        def __init__(self) -> None:
            self.motion = motion

        def begin(self, frame: int, given: State) -> Step:
            return step(frame, 1.0)

        def follow(self, before: Step, frame: int) -> Step:
            back = frame < before.frame
            asked.extend([before.unsearched] if back else [])
            return step(frame, 0.9 if back else (0.5 if 1 < frame < 5 else 1.0))

    def step(frame: int, single: float) -> Step:
        trust = TrackTrust(1.0, 1.0, 1.0, single)
        return Step(
            frame=frame,
            how="followed",
            motion=estimate,
            misfit=0.01,
            gain=1.0,
            trust=trust,
            recent=(0.01,),
            found_at=0.0,
            searched_at=0.0,
            unsearched=1,
        )

    steps = StepFiles(tmp_path, Follower(), lambda done, total: None).all_steps(grasper_state())
    assert asked == [FOLLOW.search_rolls_every] * 3
    assert [one.trust.value for one in steps] == [1.0, 1.0, 0.9, 0.9, 0.9, 1.0]


def test_a_joint_is_not_moved_beyond_its_bounds(tracked_run: RecordedRun) -> None:
    parameters = TrackedParameters.of(tracked_run.scene)
    opened = torch.tensor([0.0] * 6 + [5.0], dtype=torch.float64)
    assert parameters.moved(grasper_state(), opened).instruments["grasper"].joints["jaw_angle"] <= 1.2


@pytest.mark.parametrize("size", [0.25, 1.0])
def test_a_fit_ends_at_the_state_that_was_drawn_at_any_size(tracked_run: RecordedRun, size: float) -> None:
    fitter, true = fitter_of(tracked_run.scene), grasper_state(2, 1, 72, 0.1, 0.1, 0.5)
    frame = record(tracked_run.scene, tracked_run.path / f"at-{size}", [true], "new").frames[0]
    view = view_of(frame, CAMERA, fitter.tissue, None)
    near = loose_prior(fitter.parameters, 20, 20, 20)
    start = grasper_state(3.0, 0.3, 71, 0.13, 0.16, 0.55)
    fit = fitter.fit(view, start, near, levels=(size,), steps=(12,))
    assert fit is not None
    degrees, millimetres, jaw = off(fit.state, true)
    assert degrees < 1.5
    assert millimetres < 1.5
    assert jaw < 2.5
    assert fit.gain > 0


def test_an_instrument_that_only_changes_its_place_need_not_be_posed_again(tracked_run: RecordedRun) -> None:
    drawer, one, other = InstrumentRenderer(tracked_run.scene), grasper_state(), grasper_state(2, -1, 68, 0.2, 0.4)
    black, wall = torch.zeros(64, 96, 3), torch.full((64, 96, 3), 0.4)
    view = FrameView(camera=CAMERA, image=black, weight=torch.ones(64, 96), tissue=wall, shadow_of=None, diagonal=115.0)
    moved = drawer.moved(drawer.pose(one), one, other, view)
    assert (moved - drawer.composed(drawer.pose(other), view)).abs().max() < 1e-3  # float32, of 1
    assert (moved - drawer.composed(drawer.pose(one), view)).abs().max() > 0.1


def test_instruments_are_posed_after_others_as_they_are_by_themselves(tracked_run: RecordedRun) -> None:
    drawer, other = InstrumentRenderer(tracked_run.scene), grasper_state(2, -1, 68, 0.2, 0.4, 0.7)
    drawer.pose(grasper_state())
    kept, alone = drawer.pose(other), drawer.alone.at(other)
    for name in ("means", "quats", "scales", "opacities", "sh", "sh_frames"):
        assert torch.equal(getattr(kept, name), getattr(alone, name)), name


def test_a_fit_leaves_the_bound_of_a_joint(tracked_run: RecordedRun) -> None:
    fitter, true = fitter_of(tracked_run.scene), grasper_state(jaw=0.8)
    frame = record(tracked_run.scene, tracked_run.path / "at-bound", [true], "new").frames[0]
    view = view_of(frame, CAMERA, fitter.tissue, None)
    bound = float(fitter.parameters.instruments[0].high[0])
    fit = fitter.fit(
        view, grasper_state(jaw=bound), loose_prior(fitter.parameters, 20, 20, 40), levels=(1.0,), steps=(12,)
    )
    assert fit is not None
    assert off(fit.state, true)[2] < 2.5


def test_what_is_in_front_is_not_held_against_a_state(tracked_run: RecordedRun) -> None:
    fitter, true = fitter_of(tracked_run.scene), grasper_state()
    frame = record(tracked_run.scene, tracked_run.path / "hidden", [true], "new").frames[0]
    view = view_of(frame, CAMERA, fitter.tissue, None)
    fit = fitter.fit(view, true, loose_prior(fitter.parameters, 4, 4, 8))
    hidden = view.image.clone()
    hidden[24:44, 24:34] = torch.tensor([0.1, 0.9, 0.1])  # across the shaft
    behind = fitter.fit(replace(view, image=hidden), true, loose_prior(fitter.parameters, 4, 4, 8))
    wrong = fitter.fit(view, grasper_state(roll=0.6, jaw=0.9), loose_prior(fitter.parameters, 0.01, 0.01, 0.01))
    assert fit is not None
    assert behind is not None
    assert wrong is not None
    assert behind.misfit < 0.5 * wrong.misfit
    assert off(behind.state, true)[0] < 2


@pytest.mark.parametrize(("gain", "offset"), [(0.6, 0.2), (1.6, 0.0), (1.0, 0.0)])
def test_smoke_and_exposure_are_taken_out_by_the_tissue(tracked_run: RecordedRun, gain: float, offset: float) -> None:
    tissue, image = (
        TissueRenderer(tracked_run.scene).render(CAMERA, None),
        tracked_run.scene.render(moving(4), CAMERA).color,
    )
    seen = (gain * image.clamp(0, 1) ** 2.2 + offset) ** (1 / 2.2)  # light, stored
    found = color_matched(seen, tissue, torch.ones(64, 96))
    assert (found - image.clamp(0, 1)).abs().max() < 0.02


@pytest.mark.parametrize("spoil", [torch.zeros_like, lambda pixels: 1 - pixels, lambda pixels: pixels.flip(0)])
def test_colours_that_are_not_the_tissues_stay_as_they_are(tracked_run, spoil):
    tissue = TissueRenderer(tracked_run.scene).render(CAMERA, None)
    image = spoil(tissue)
    assert torch.equal(color_matched(image, tissue, torch.ones(64, 96)), image)


def test_footage_gets_the_states_it_was_drawn_in(tracked: Tracked) -> None:
    assert tracked.written == FRAMES
    for k, rec in enumerate(tracked.records):
        degrees, millimetres, jaw = off(state_of(rec), moving(k))
        assert degrees < 1.5
        assert millimetres < 1.5  # 2 % of the distance; a pixel is 0.8 mm
        assert jaw < 2.5
        assert rec["trust"]["value"] > 0.8
    tracked.require_trusted()


def test_the_output_is_a_capture_that_says_its_trust(tracked: Tracked) -> None:
    assert not errors_only(check_capture(tracked.output))
    capture = read_capture(tracked.output)
    assert len(capture.frames) == FRAMES
    for frame, rec in zip(capture.frames, tracked.records, strict=True):
        given = frame.state.instruments["grasper"]
        assert given.trust == rec["trust"]["value"]
        assert given.pose.tolist() == rec["instruments"]["grasper"]["pose"]
    page = write_track_page(tracked).read_text()
    assert page.count("<img") == 2 * FRAMES  # few frames: all in the strip, all among the least trusted
    assert "jaw_angle, deg" in page


def test_what_is_known_of_the_footage_and_every_joint_that_was_found_are_written(
    tracked: Tracked, tracked_run: RecordedRun, footage: Capture, tmp_path: Path
) -> None:
    scene = copy(tracked_run.scene)  # nobody recorded its jaw
    tree = KinematicTree((Link("shaft"), Link("jaw", "shaft", REVOLUTE, value={"jaw_angle": 1.0})))
    scene.instruments = (
        replace(GRASPER, kinematics=tree, unrecorded=("jaw_angle",), joints={"jaw_angle": (0.0, 1.5)}),
    )
    trained_on = tracked_run.capture()
    for still, registered in ((True, False), (False, True)):
        frames = [replace(f, state=state_of(rec)) for f, rec in zip(footage.frames, tracked.records, strict=True)]
        output, given = (
            tmp_path / str(still),
            replace(footage, frames=tuple(frames), still=still, registered=registered),
        )
        write_tracked(given, output, scene, trained_on)
        made = read_capture(output)
        assert (made.still, made.registered) == (still, registered)
        for frame, rec in zip(made.frames, tracked.records, strict=True):
            assert frame.state.instruments["grasper"].joints == rec["instruments"]["grasper"]["joints"]


@pytest.mark.parametrize(("written", "begins"), [(10, "good: "), (6, "usable: "), (4, "DOUBTFUL: ")])
def test_footage_of_which_few_frames_are_trusted_is_doubtful(footage: Capture, written: int, begins: str) -> None:
    records = [{"how": "lost" if k >= written else "followed", "trust": {"value": 0.9}} for k in range(10)]
    found = Tracked(Path("out"), footage, records, written, 0.5, None)  # type: ignore[arg-type]
    assert found.verdict.startswith(begins)
    assert (f"in {10 - written} of 10 frames nothing was found" in found.verdict) == (written < 10)


def test_an_instrument_is_found_where_nothing_is_known(tracked_run, footage, tmp_path):
    bare = tuple(replace(frame, state=State({}, frame.state.time)) for frame in footage.frames[2:5])
    found = track_footage(tracked_run, replace(footage, frames=bare), tmp_path / "found")
    assert found.written == 3
    for k, rec in enumerate(found.records, 2):
        degrees, millimetres, jaw = off(state_of(rec), moving(k))
        assert degrees < 1.5
        assert millimetres < 1.5
        assert jaw < 2.5


def test_footage_without_the_instrument_is_trusted_nowhere(tracked_run, footage, tmp_path):
    wall = TissueRenderer(tracked_run.scene).render(CAMERA, None)
    frames = []
    for k, pixels in enumerate((wall, torch.zeros_like(wall), 1 - wall)):
        path = tmp_path / f"{k}.png"
        write_image(path, pixels)
        frames.append(replace(footage.frames[k], image_path=path, state=State({}, k / 25)))
    tracked = track_footage(tracked_run, replace(footage, frames=tuple(frames)), tmp_path / "out")
    assert tracked.written == 0
    assert max(rec["trust"]["value"] for rec in tracked.records) < 0.2
    assert not (tmp_path / "out" / "transforms.json").exists()
    with pytest.raises(NeecoError, match=r"no frame has a trust of 0\.5"):
        tracked.require_trusted()


def test_what_was_broken_off_goes_on_to_the_same_bytes(tracked_run, footage, tracked, tmp_path):
    output = tmp_path / "capture"

    def stop(done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        track_footage(tracked_run, withheld(footage), output, start="first", on_progress=stop)
    with pytest.raises(NeecoError, match="not empty"):
        track_footage(tracked_run, withheld(footage), output, start="first")
    with pytest.raises(NeecoError, match="start: begun with"):
        track_footage(tracked_run, withheld(footage), output, start="none", resume=True)
    track_footage(tracked_run, withheld(footage), output, start="first", resume=True)
    whole, resumed = contents(tracked.output), contents(output)
    whole.pop("track.html", None)
    assert resumed == whole
    track_footage(tracked_run, withheld(footage), output, start="first", resume=True)  # complete: nothing to do
    assert contents(output) == whole


def test_frames_are_chosen_by_another_trust_without_tracking_again(tracked_run, footage, tracked, tmp_path):
    output = tmp_path / "capture"
    shutil.copytree(tracked.output, output)
    info = json.loads((output / "track.json").read_text())
    for entry in info["frames"]:
        entry["trust"]["value"] *= 0.9  # so that none is trusted fully
    (output / "track.json").write_text(json.dumps(info))
    trusts = sorted(entry["trust"]["value"] for entry in info["frames"])
    middle = trusts[len(trusts) // 2]

    def never(done: int, total: int) -> None:
        raise AssertionError("tracked again")

    def chosen(min_trust: float) -> int:
        again = track_footage(
            tracked_run, withheld(footage), output, start="first", min_trust=min_trust, resume=True, on_progress=never
        )
        return again.written

    assert chosen(middle) == sum(trust >= middle for trust in trusts) == len(read_capture(output).frames)
    stricter = contents(output)
    assert chosen(1.0) == 0
    assert contents(output) == stricter, "a capture is not replaced by one of no frame"
    chosen(tracked.min_trust)
    assert contents(output).keys() - {"track.html"} == contents(tracked.output).keys() - {"track.html"}


def test_what_cannot_be_tracked_is_refused_in_words(tracked_run: RecordedRun, footage: Capture, tmp_path: Path) -> None:
    bare = replace(footage, frames=tuple(replace(f, state=State({}, f.state.time)) for f in footage.frames))
    with pytest.raises(NeecoError, match="first frame does not state instrument 'grasper'"):
        track_footage(tracked_run, bare, tmp_path / "a", start="first")
    with pytest.raises(NeecoError, match="--min-trust"):
        track_footage(tracked_run, bare, tmp_path / "a", min_trust=1.5)
    assert not (tmp_path / "a").exists()


def test_a_run_without_instruments_is_refused_in_words(tracked_run: RecordedRun) -> None:
    bare = copy(tracked_run.scene)
    bare.instruments = ()
    with pytest.raises(NeecoError, match="the run has no instrument"):
        TrackedParameters.of(bare)


@pytest.mark.parametrize(("share", "how"), [(0.5, "followed"), (1.5, "beside")])
def test_another_state_is_taken_only_if_it_explains_more_of_the_image(tracked_run, tmp_path, monkeypatch, share, how):
    """One that hardly shows in the image leaves little unexplained."""
    frames = record(tracked_run.scene, tmp_path, [moving(0), moving(1)], "new").frames
    follower = Follower.of(frames, fitter_of(tracked_run.scene), Reference(TypicalErrors(0.02, 0.02), 1e-3, 1.0))
    begun = follower.begin(0, moving(0))
    fit = follower.fitter.fit(follower.fitter.view(frames[1], moving(1)), moving(1), torch.eye(7, dtype=torch.float64))
    assert fit is not None
    other = replace(fit, misfit=0.0, gain=share * fit.gain)
    monkeypatch.setattr(type(follower.search), "near", lambda *given: other)
    assert follower.follow(replace(begun, misfit=0.0, recent=()), 1).how == how


@pytest.mark.parametrize(("x", "shown"), [(0.0, True), (44.0, False)])
def test_an_opening_that_the_image_does_not_show_is_not_trusted(tracked_run, tmp_path, x, shown):
    true, given = grasper_state(x, jaw=0.9), grasper_state(x, jaw=0.8)
    frame = record(tracked_run.scene, tmp_path, [true], "new").frames[0]
    reference = Reference(TypicalErrors(0.02, 0.02), 0.1, 1.0)
    follower = Follower.of([frame], fitter_of(tracked_run.scene), reference)
    step = follower.begin(0, given)
    assert step.trust.overlap > 0.9
    assert (step.trust.determined > 0.95) == shown
    assert (step.trust.value > 0.5) == shown


def test_the_longer_it_is_unseen_the_less_is_known(tracked_run: RecordedRun) -> None:
    parameters = TrackedParameters.of(tracked_run.scene)
    motion = MotionModel.of(parameters, tracked_run.scene.recorded.states)
    begun = motion.begin(moving(0))
    soon, late = motion.predict(begun, 1 / 25), motion.predict(begun, 6 / 25)
    assert bool((late.covariance.diagonal()[:7] > soon.covariance.diagonal()[:7]).all())
    assert off(late.state, moving(0)) == pytest.approx((0, 0, 0), abs=1e-4)  # its velocity is not known yet


def test_the_recorded_pace_is_what_is_expected(tracked_run: RecordedRun) -> None:
    motion = MotionModel.of(TrackedParameters.of(tracked_run.scene), tracked_run.scene.recorded.states)
    assert motion.interval == pytest.approx(1 / 25)
    jaw = float(motion.velocities[6, 6].sqrt())  # opens by 0.04 rad a frame
    assert jaw == pytest.approx(0.04 * 25, rel=0.2)
