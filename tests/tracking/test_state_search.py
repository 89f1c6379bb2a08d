"""States of training frames as unknowns of their true size."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import grasper_world as world
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from wristed_world import make_driver

from neeco.capture.model import InstrumentState, State, Uncertainty
from neeco.methods.kinematic import discovery
from neeco.methods.kinematic.articulation import ArticulatedInstruments
from neeco.scene import Recorded
from neeco.scene.training_views import TrainingViews
from neeco.states.contradictions import (
    Misfits,
    fitted_anew,
    half_turned_state,
    judge_again,
    leave_out_unexplained,
    mirrored_state,
    refit_outliers,
)
from neeco.states.crop_rendering import FrameView
from neeco.states.fitter import Fitter, StateFit
from neeco.states.parameters import StateParameters
from neeco.states.refinement import Refinement, Verdict
from neeco.states.search import SEARCH, StateSearch
from neeco.training.config import method_defaults, training_config
from neeco.training.session import GaussianSession

TRUE = [world.moving(k) for k in range(-4, 8)]


def with_errors(states: Sequence[State], scale: float) -> list[State]:
    """States with errors of 2 degrees of tilt, 6 of roll, 1.5 mm of depth and 4 degrees of the joint, times `scale`."""
    rng, wrong = np.random.default_rng(1), []
    for state in states:
        given = state.instruments["grasper"]
        pose = given.pose.clone()
        turn = Rotation.from_rotvec(scale * np.radians(rng.standard_normal(3) * [2, 2, 6])).as_matrix()
        pose[:3, :3] = pose[:3, :3] @ torch.from_numpy(turn)
        pose[:3, 3] += torch.from_numpy(scale * rng.standard_normal(3) * [0.3, 0.3, 1.5])
        jaw = given.joints["jaw_angle"] + scale * math.radians(4) * float(rng.standard_normal())
        wrong.append(replace(state, instruments={"grasper": InstrumentState(pose, {"jaw_angle": jaw})}))
    return wrong


def session_of(root: Path, states: Sequence[State], cameras: int = 1) -> GaussianSession:
    """A session whose scene is learned, over images in the TRUE states that are recorded as `states`; of so many
    cameras, which stand at one place."""
    scene = world.make_scene()
    capture = world.record(scene, root, TRUE, "train")
    frames = tuple(replace(f, state=state) for f, state in zip(capture.frames, states, strict=True))
    for number in range(1, cameras):
        others = [f.image_path.with_name(f"right{number}_{f.image_path.name}") for f in capture.frames]
        for frame, other in zip(capture.frames, others, strict=True):
            shutil.copy(frame.image_path, other)
        frames += tuple(replace(f, image_path=other) for f, other in zip(frames, others, strict=False))
    scene.recorded = Recorded.of(frames, scene.instruments)
    return GaussianSession(scene, TrainingViews.read(frames, 1.0), method_defaults("kinematic"))


def search_of(session: GaussianSession) -> StateSearch:
    articulations = cast(ArticulatedInstruments, session.scene.deformation).articulations
    shafts = [articulation.shaft()[1].detach().double() for articulation in articulations]
    return StateSearch.of(session.scene, session.refinement, session.full_views.frames, shafts)


def contradicting(refinement: Refinement) -> dict[int, Verdict]:
    """Verdicts on the instants whose states contradict the others."""
    return {k: Verdict(verdict) for k, verdict in enumerate(refinement.verdicts.tolist()) if verdict}


def measured(search: StateSearch, scale: float) -> list[tuple[int, StateFit, torch.Tensor]]:
    """Fits as images of 0.3 degrees and 0.3 mm make them of states with errors of this scale, without images."""
    fits, rng = [], np.random.default_rng(2)
    layout = search.refinement.layout
    information = torch.diag(layout.vector_from_degrees(0.3, 0.3, 1.0, 0.1) ** -2)
    for index, wrong in enumerate(with_errors(TRUE, scale)):
        noise = torch.from_numpy(rng.standard_normal(layout.size)) * torch.diagonal(information).rsqrt()
        precision = search.precision(index, SEARCH.largest)
        most_likely = layout.increments_between(wrong, TRUE[index]) + noise
        correction = torch.linalg.solve(information + precision, information @ most_likely)
        view = search.view(0, None)
        fit = StateFit(
            state=wrong, cost=0.0, gain=0.0, misfit=1.0, observations=1.0, information=information, view=view
        )
        fits.append((index, fit, correction))
    return fits


def test_errors_of_a_robot_are_told_from_those_of_a_tracker(tmp_path: Path) -> None:
    search = search_of(session_of(tmp_path, TRUE))
    scales = [search.scale_of(measured(search, scale)) for scale in (0.1, 1.0)]
    assert scales[0] < SEARCH.large < scales[1] < 1.5


def test_without_stated_links_only_tilt_tells_how_large_errors_are(tmp_path: Path) -> None:
    search = search_of(session_of(tmp_path, TRUE))
    assert search.scene.instruments[0].kinematics is None
    fits = measured(search, 0.1)
    rough = []
    for sign, (index, fit, correction) in zip((1.0, -1.0) * 6, fits, strict=True):
        view = search.scene.recorded.cameras[index].world_from_camera[:3, 2].double()
        away = TRUE[index].instruments["grasper"].pose[:3, :3].double().T @ view
        wrong = torch.cat([math.radians(12) * search.shafts[0], 3.0 * away, torch.tensor([0.2])])  # roll, depth, jaw
        rough.append((index, fit, correction + sign * wrong))
    assert search.scale_of(rough) == pytest.approx(search.scale_of(fits), abs=0.02)


def test_a_joint_is_fitted_to_its_image(tmp_path: Path) -> None:
    states = list(TRUE)
    given = TRUE[6].instruments["grasper"]
    states[6] = replace(TRUE[6], instruments={"grasper": InstrumentState(given.pose, {"jaw_angle": 0.55})})
    found = search_of(session_of(tmp_path, states)).fitted(6, 1.0)
    assert found is not None
    fit, deviations = found
    error = fit.state.instruments["grasper"].joints["jaw_angle"] - given.joints["jaw_angle"]
    assert abs(error) < 1.5 * deviations[6]
    assert deviations[6] < math.radians(3.5) < math.radians(SEARCH.joint)


def test_a_fitted_state_is_no_surer_for_more_pixels_with_the_same_residuals(tmp_path: Path) -> None:
    search = search_of(session_of(tmp_path, TRUE))
    fit = replace(measured(search, 1.0)[0][1], misfit=0.5, observations=40.0)
    no_prior = torch.zeros_like(fit.information)
    usual = fit.deviations(no_prior)
    nearer = replace(fit, information=4 * fit.information, observations=160.0)
    assert torch.allclose(nearer.deviations(no_prior), usual)
    assert torch.allclose(replace(fit, misfit=2.0).deviations(no_prior), 2 * usual)
    # images that are explained exactly count as the fit took them
    exact = replace(fit, misfit=1e-6).deviations(no_prior)
    assert torch.allclose(exact, torch.linalg.inv(fit.information).diagonal().sqrt())
    assert torch.all(usual > exact)


def test_a_wrong_state_contradicts_the_others_and_is_found_from_one_of_theirs(tmp_path: Path) -> None:
    states = list(TRUE)
    states[3] = replace(TRUE[10], time=TRUE[3].time)
    session = session_of(tmp_path, states)
    search = search_of(session)
    refit_outliers(search, SEARCH.large, Misfits.of(search))
    assert contradicting(session.refinement) == {3: Verdict.REFITTED}
    found = session.refinement.state(3, states[3])
    assert session.refinement.layout.increments_between(TRUE[3], found)[3:6].norm() < 0.7


def test_a_wrong_state_is_found_by_the_first_of_two_cameras_and_corrected_for_both(tmp_path: Path) -> None:
    states = list(TRUE)
    states[3] = replace(TRUE[10], time=TRUE[3].time)
    session, count = session_of(tmp_path, states, cameras=2), len(TRUE)
    assert session.refinement.frames_of_instant == [[k, count + k] for k in range(count)]
    search = search_of(session)
    refit_outliers(search, SEARCH.large, Misfits.of(search))
    assert contradicting(session.refinement) == {3: Verdict.REFITTED}
    for index in (3, count + 3):
        found = session.refinement.state(index, states[3])
        assert session.refinement.layout.increments_between(TRUE[3], found)[3:6].norm() < 0.7


def test_an_instant_that_no_state_explains_is_left_out_with_all_its_images(tmp_path: Path) -> None:
    session, count = session_of(tmp_path, TRUE, cameras=2), len(TRUE)
    frame = session.full_views.frames[5]
    world.write_image(frame.image_path, torch.rand(64, 96, 3, generator=torch.Generator().manual_seed(0)))
    search = search_of(session)
    refit_outliers(search, SEARCH.large, Misfits.of(search))
    assert contradicting(session.refinement) == {5: Verdict.EXCLUDED}
    assert [k for k in range(2 * count) if not session.refinement.counts(k)] == [5, count + 5]


def test_an_image_that_no_state_explains_is_left_out(tmp_path: Path) -> None:
    session = session_of(tmp_path, TRUE)
    frame = session.full_views.frames[5]
    world.write_image(frame.image_path, torch.rand(64, 96, 3, generator=torch.Generator().manual_seed(0)))
    search = search_of(session)
    refit_outliers(search, SEARCH.large, Misfits.of(search))
    assert contradicting(session.refinement) == {5: Verdict.EXCLUDED}


def judged_by(
    search: StateSearch, explained: Callable[[State, State, StateFit], StateFit | None], outside: bool = False
) -> Verdict:
    """What becomes of frame 5, judged again, if fits with a prior about a state, from a start, are as `explained`;
    outside: its recorded state shows no instrument."""

    class Answering(Fitter[StateParameters]):
        def fit(
            self, view: FrameView, expected: State, precision: Tensor, start: State | None = None, **named: Any
        ) -> StateFit | None:
            found = super().fit(view, expected, precision, start, **named)
            if outside and not named["levels"] and expected.time == TRUE[5].time:
                return None
            measured = found is None or not named["levels"]  # not fitted: the misfit of a state as it is
            return found if measured else explained(expected, start or expected, found)

    fitter = Answering(search.fitter.instruments, search.fitter.parameters, search.fitter.tissue)
    if not search.refinement.verdicts.any():
        search.refinement.judge(5, Verdict.REFITTED)
    judge_again(replace(search, fitter=fitter))
    return search.refinement.verdict(5)


@pytest.mark.parametrize(
    ("own", "gain", "verdict"),
    [(30.0, 20.0, Verdict.ACCEPTED), (30.0, 40.0, Verdict.REFITTED), (-30.0, -5.0, Verdict.ACCEPTED)],
)
def test_a_state_refutes_another_only_if_more_of_the_image_is_explained(own, gain, verdict, tmp_path):
    """One that hardly shows in the image leaves little unexplained there; one with a negative gain explains nothing."""
    search = search_of(session_of(tmp_path, TRUE))
    given = search.scene.recorded.states[5]

    def explained(expected: State, start: State, found: StateFit) -> StateFit:
        if expected is given:
            return replace(found, misfit=0.9, gain=own)
        return replace(found, state=TRUE[11], misfit=0.2, gain=gain)

    assert judged_by(search, explained) == verdict


@pytest.mark.parametrize(("gain", "verdict"), [(50.0, Verdict.ACCEPTED), (35.0, Verdict.REFITTED)])
def test_a_local_minimum_of_the_fit_from_a_recorded_state_does_not_refute_it(gain, verdict, tmp_path):
    """Fits from starts nearby speak for the recorded state, too."""
    search = search_of(session_of(tmp_path, TRUE))
    given, layout = search.scene.recorded.states[5], search.refinement.layout

    def explained(expected: State, start: State, found: StateFit) -> StateFit:
        if expected is not given:
            return replace(found, state=TRUE[11], misfit=0.2, gain=40.0)
        nearby = float(layout.increments_between(given, start).abs().max()) > 1e-6
        return replace(found, misfit=0.2 if gain > 40.0 and nearby else 0.9, gain=gain if nearby else 30.0)

    assert judged_by(search, explained) == verdict


@pytest.mark.parametrize(
    ("gain", "outlier", "verdict"),
    [(31.0, False, Verdict.ACCEPTED), (33.0, False, Verdict.REFITTED), (20.0, True, Verdict.REFITTED)],
)
def test_a_state_that_seemed_wrong_is_right_if_it_explains_the_image_and_no_other_one_explains_more(
    gain: float, outlier: bool, verdict: Verdict, tmp_path: Path
) -> None:
    search = search_of(session_of(tmp_path, TRUE))
    given, misfit = search.scene.recorded.states[5], (2.0 if outlier else 0.9) * Misfits.of(search).limit

    def explained(expected: State, start: State, found: StateFit) -> StateFit:
        if expected is given:
            return replace(found, misfit=misfit, gain=30.0)
        return replace(found, state=TRUE[11], misfit=0.8 * misfit, gain=gain)

    search.refinement.judge(5, Verdict.REFITTED)
    assert judged_by(search, explained) == verdict


@pytest.mark.parametrize("noted", [True, False])
@pytest.mark.parametrize(("gain", "verdict"), [(-5.0, Verdict.ACCEPTED), (20.0, Verdict.REFITTED)])
def test_an_instrument_outside_of_the_image_is_refuted_only_by_one_that_explains_something(
    gain: float, verdict: Verdict, noted: bool, tmp_path: Path
) -> None:
    search = search_of(session_of(tmp_path, TRUE))
    given = search.scene.recorded.states[5]

    def explained(expected: State, start: State, found: StateFit) -> StateFit | None:
        return None if expected is given else replace(found, state=TRUE[11], misfit=0.2, gain=gain)

    search.refinement.judge(5, Verdict.EXCLUDED if noted else Verdict.REFITTED)
    assert judged_by(search, explained, outside=True) == verdict


def test_no_frame_is_left_out_later_because_others_are_explained_ever_better(tmp_path):
    search = search_of(session_of(tmp_path, TRUE))
    given, limit = search.scene.recorded.states[5], Misfits.of(search).rejection_limit
    assert limit < math.inf

    def explained(expected: State, start: State, found: StateFit) -> StateFit:
        misfit, gain = (1.25, 30.0) if expected is given else (1.125, 31.0)
        return replace(found, misfit=misfit * limit, gain=gain)

    assert judged_by(search, explained) is not Verdict.EXCLUDED


@pytest.mark.parametrize(("misfit", "included"), [(0.22, True), (0.4, False)])
def test_deviations_of_a_state_fitted_anew_include_states_that_its_image_does_not_refute(misfit, included, tmp_path):
    search, fits = search_of(session_of(tmp_path, TRUE)), 0
    given, refinement = search.scene.recorded.states[5], search.refinement

    def explained(expected: State, start: State, found: StateFit) -> StateFit:
        nonlocal fits
        if expected is given:
            return replace(found, misfit=0.9, gain=30.0)
        fits += 1
        if fits == 1:
            return replace(found, state=TRUE[11], misfit=0.2, gain=50.0)
        return replace(found, state=TRUE[0], misfit=misfit, gain=40.0)

    assert judged_by(search, explained) is Verdict.REFITTED
    apart = refinement.layout.increments_between(TRUE[11], TRUE[0])
    assert bool((refinement.deviations(5) > apart.abs() / 2).all()) == included


def driver_session(root: Path, recorded: dict[int, State] | None = None, scale: float = 0.0) -> GaussianSession:
    """A session whose scene of a wrist with stated links is learned, over images in true states; some are `recorded`
    otherwise, and all others with errors `scale` times as large as usual ones of a robot."""
    scene = make_driver(12)
    true = list(scene.recorded.states)
    frames = world.record(scene, root, true, "train").frames
    session = GaussianSession(scene, TrainingViews.read(frames, 1.0), method_defaults("kinematic"))
    search, random = search_of(session), torch.Generator().manual_seed(3)
    states = []
    for index, state in enumerate(true):
        spread = torch.linalg.cholesky(torch.linalg.inv(search.precision(index, 1.0)))
        off = scale * spread @ torch.randn(len(spread), generator=random, dtype=torch.float64)
        states.append((recorded or {}).get(index, session.refinement.layout.moved(state, off)))
    frames = tuple(replace(frame, state=state) for frame, state in zip(frames, states, strict=True))
    scene.recorded = Recorded.of(frames, scene.instruments)
    return GaussianSession(scene, TrainingViews.read(frames, 1.0), method_defaults("kinematic"))


def no_outliers(search: StateSearch) -> Misfits:
    return replace(Misfits.of(search), limit=1e3, rejection_limit=1e3)


def test_a_state_fitted_anew_on_its_other_side_is_turned_back(tmp_path: Path) -> None:
    """Half a turn about the shaft moves no outline: jaws change places, and the wrist bends the other way."""
    session = driver_session(tmp_path)
    search, true = search_of(session), session.recorded.states[4]
    session.refinement.set_state(4, true, half_turned_state(search, true), session.refinement.deviations(4))
    found = fitted_anew(search, 4)
    assert found is not None
    off = session.refinement.layout.increments_between(true, found[0].state)
    assert off[:3].norm().rad2deg() < 5
    assert bool((off.abs() < 3 * found[1]).all())


def test_states_with_usual_errors_are_not_taken_for_wrong_ones(tmp_path: Path) -> None:
    session = driver_session(tmp_path, scale=1.0)
    session.refinement.verdicts[::3] = Verdict.EXCLUDED
    judge_again(search_of(session))
    assert not contradicting(session.refinement)


def test_a_state_is_judged_again_once_the_others_settled(tmp_path: Path) -> None:
    """A right one that seemed wrong is used again as recorded, and a wrong one that seemed right is found."""
    right = driver_session(tmp_path)
    true = [right.recorded.states[index] for index in (2, 4)]
    mirrored = [mirrored_state(search_of(right), index, state) for index, state in zip((2, 4), true, strict=True)]
    session = driver_session(tmp_path, {4: mirrored[1]})
    refinement = session.refinement
    refinement.judge(2, Verdict.REFITTED)
    refinement.judge(7, Verdict.EXCLUDED)
    refinement.set_state(2, true[0], mirrored[0], refinement.deviations(2))
    judge_again(search_of(session))
    assert contradicting(refinement) == {4: Verdict.REFITTED}
    for index, recorded, state in ((2, true[0], true[0]), (4, mirrored[1], true[1])):
        off = refinement.layout.increments_between(state, refinement.state(index, recorded))
        assert off[3:6].norm() < 1.0
        assert off[:3].norm().rad2deg() < 5


def test_a_frame_fitted_anew_that_stays_unexplained_is_left_out(tmp_path: Path) -> None:
    session = session_of(tmp_path, TRUE)
    for index in (3, 5):
        session.refinement.judge(index, Verdict.REFITTED)
    misfits = {index: 0.5 for index in range(len(TRUE))} | {3: 1.2, 5: 0.6, 7: 1.2}
    leave_out_unexplained(search_of(session), misfits)
    assert contradicting(session.refinement) == {3: Verdict.EXCLUDED, 5: Verdict.REFITTED}


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_states_are_judged_again_where_errors_are_large(size: float, tmp_path: Path) -> None:
    """A mirrored state, which looks alike, remains where nothing says that states may be wrong."""
    right = driver_session(tmp_path)
    mirrored = mirrored_state(search_of(right), 4, right.recorded.states[4])
    session = driver_session(tmp_path, {4: mirrored})
    session.refinement.error_scale.fill_(size)
    session.scene.deformation.act(session, "judge_states_again")
    assert contradicting(session.refinement) == ({4: Verdict.REFITTED} if size else {})


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_corrections_are_as_uncertain_as_errors_are_large(scale: float, cameras: int, tmp_path: Path) -> None:
    session = session_of(tmp_path, with_errors(TRUE, scale), cameras=cameras)
    search, before = search_of(session), session.refinement.deviations(0)
    assert search.size_errors(()) == bool(scale) == (float(session.refinement.error_scale) > SEARCH.large)
    after = session.refinement.deviations(0)
    torch.testing.assert_close(after, search.deviations(0, 1.0) if scale else before, rtol=1e-5, atol=0)


def test_outliers_do_not_count_for_the_size_of_all_errors(tmp_path: Path) -> None:
    states = list(TRUE)
    for index in (3, 7):
        states[index] = replace(TRUE[(index + 6) % 12], time=TRUE[index].time)
    assert not search_of(session_of(tmp_path, states)).size_errors([3, 7])


def test_stated_uncertainties_are_the_prior(tmp_path: Path) -> None:
    stated = Uncertainty((0.1, 0.2, 3.0), (0.5, 0.5, 20.0), {"jaw_angle": 7.0})
    given = TRUE[0].instruments["grasper"]
    unsure = State({"grasper": InstrumentState(given.pose, dict(given.joints), uncertainty=stated)}, TRUE[0].time)
    search = search_of(session_of(tmp_path, [unsure, *TRUE[1:]]))
    covariance = torch.linalg.inv(search.precision(0, 1.0))
    assert covariance[6, 6].sqrt() == pytest.approx(math.radians(7.0))
    turns = covariance[:3, :3].diagonal().sqrt().rad2deg()
    assert turns.tolist() == pytest.approx([0.5, 0.5, 20.0], rel=0.01)
    assert search.stated_scale() == 0.0  # by one state of many


def test_the_size_of_stated_errors_is_told_in_those_of_a_robot(tmp_path: Path) -> None:
    for size, stated in (
        (1.0, Uncertainty((0.4, 0.4, 1.5), (2.0, 2.0, 6.0), {"jaw_angle": 4.0})),
        (0.125, Uncertainty((0.3, 0.3, 0.3), (0.25, 0.25, 0.25), {"jaw_angle": 0.5})),  # a tracker's
    ):
        states = []
        for state in TRUE:
            own = replace(state.instruments["grasper"], uncertainty=stated)
            states.append(replace(state, instruments={"grasper": own}))
        assert search_of(session_of(tmp_path / str(size), states)).stated_scale() == pytest.approx(size, rel=0.1)


def test_a_shape_that_carving_no_longer_finds_goes_on_as_learned(tmp_path):
    """States of few frames may be too far off for carving, while the learned shape explains their images."""
    session = driver_session(tmp_path)
    session.views = replace(session.views, images=tuple(torch.full_like(i, 128) for i in session.views.images))
    short = ["deformation.carving.tissue_steps=5", "deformation.carving.long_tissue_steps=5"]
    session.config = training_config("kinematic", {}, short)
    scene = session.scene
    reports: list[str] = []
    session.report = reports.append
    articulated = cast(ArticulatedInstruments, scene.deformation)
    with torch.no_grad():
        articulated.articulations[0].shaft_tilt += 0.01
    before = {name: tensor.clone() for name, tensor in articulated.state_dict().items()}
    canonical = scene.canonical
    discovery.carve_again(session, articulated)
    assert scene.canonical is canonical
    torch.testing.assert_close(dict(articulated.state_dict()), before, rtol=0, atol=0, equal_nan=True)
    assert reports == ["carving the instruments anew finds no shape: they go on as learned"]
