"""Single wrong states (mirrored, or of another moment), detected by their large residuals.

Outliers are detected directly. Other states may be wrong although they fit as well: a mirrored state looks similar, and
the scene has learned from it. Conversely, an early outlier may be an error of the scene. So once the remaining states
are fitted, all contradicting or ambiguous ones are judged again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import InstrumentState, State, evenly_spaced
from neeco.states.fitter import StateFit
from neeco.states.outline_model import half_turned, mirrored
from neeco.states.refinement import Refinement, Verdict
from neeco.states.search import SEARCH, StateSearch


@dataclass(frozen=True, kw_only=True)
class ContradictionSettings:
    """Settings of the search for wrong states."""

    outlying: float = 3.0  # robust standard deviations of a log misfit above which a state is an outlier
    rejected: float = 6.0  # robust standard deviations above which a frame that no state explains is excluded
    better: float = 0.7  # ratio of another state's misfit to this state's, below which the other refutes it
    # ratio of another fit's gain to that of the fit about the recorded state, up to which the latter holds
    unclear: float = 1.05
    min_distance: float = 3.0  # RMS distance in standard deviations of the prior, from which two states differ
    explained: float = 1.0  # misfit up to which a state explains its image
    min_spread: float = 0.25  # minimum standard deviation of the log misfits
    n_others: int = 60  # maximum number of frames whose states are tried as starts
    n_tried: int = 3  # number of starts that are fitted
    min_frames: int = 8  # minimum number of frames; with fewer, no state contradicts the others
    start_scale: float = 3.0  # scale of the prior about another start, in units of usual errors
    suspect: float = 1.0  # robust standard deviations of a log misfit above which a state may be wrong
    alike: float = 1.15  # ratio of the mirrored state's misfit to a state's, below which the mirrored one may be right
    n_own: int = 12  # starts sampled from the prior about a recorded state
    n_near: int = 64  # starts sampled from the prior about another state
    max_share: float = 1 / 3  # maximum share of frames that are judged again though they are no outliers
    max_suspects: int = 24  # maximum number of these frames
    max_named: int = 8  # maximum number of frames named in the summary


JUDGE = ContradictionSettings()


@dataclass(frozen=True)
class Misfits:
    """Misfits of training frames in their present states (first camera of several); infinite where no instrument is in
    the image. A state is an outlier above `limit`, may be wrong above `suspect_limit`, and a frame that no other state
    explains is excluded above `rejection_limit`."""

    of_frame: dict[int, float]
    limit: float
    rejection_limit: float
    suspect_limit: float

    @classmethod
    def of(cls, search: StateSearch) -> Misfits:
        """Measure the misfits. Without outliers if there are few frames, or if half of them would be outliers."""
        firsts = [frames[0] for frames in search.refinement.frames_of_instant]
        misfits = {index: search.misfit(index, search.state(index)) for index in firsts}
        valid = torch.tensor([misfit for misfit in misfits.values() if math.isfinite(misfit)])
        if len(valid) < JUDGE.min_frames:
            return cls(misfits, math.inf, math.inf, math.inf)
        limits = (max(_limit(valid, many), JUDGE.explained) for many in (JUDGE.outlying, JUDGE.rejected, JUDGE.suspect))
        measured = cls(misfits, *limits)
        if len(measured.outliers) > len(valid) // 2:
            return replace(measured, limit=math.inf, rejection_limit=math.inf)
        return measured

    @property
    def outliers(self) -> list[int]:
        """Return the frames whose states have much larger misfits than the others."""
        return [index for index, misfit in self.of_frame.items() if self.limit < misfit < math.inf]


def _limit(misfits: Tensor, many: float) -> float:
    """Return the misfit `many` robust standard deviations of the log misfits [F] above their median."""
    logs = misfits.clamp(1e-3, 1e3).log()
    spread = max(1.4826 * float((logs - logs.median()).abs().median()), JUDGE.min_spread)
    return math.exp(float(logs.median()) + many * spread)


def refitted(search: StateSearch, index: int, fits: Sequence[StateFit]) -> tuple[StateFit, Tensor]:
    """Return the best of a frame's `fits`, including, with stated links, fits about the best one half turned about its
    shaft, which has a similar outline; and standard deviations [P] that include the spread of the fits that it does not
    refute."""
    precision, best = search.precision(index, JUDGE.start_scale), _best(fits)
    if search.linked:
        fits = [*fits, *_fits_near(search, index, half_turned_state(search, best.state))]
        best = _best(fits)
    apart = search.refinement.layout.increments_between
    possible = torch.stack([apart(best.state, fit.state) for fit in fits if JUDGE.better * fit.misfit <= best.misfit])
    return best, (best.deviations(precision).square() + possible.square().mean(0)).sqrt()


@torch.no_grad()
def refit_outliers(search: StateSearch, scale: float, misfits: Misfits) -> None:
    """Refit outlying states from other initial states, or exclude their frames.

    scale: of the errors of all states (see `StateSearch.fitted`).
    """
    good = _states_of(search, [index for index, misfit in misfits.of_frame.items() if misfit <= misfits.limit])
    for index in misfits.outliers:
        if search.refinement.verdict(index) is Verdict.ACCEPTED:
            recorded_fit = _own_fit(search, index, scale)
            if recorded_fit is None or recorded_fit.misfit > misfits.limit:
                fits = _fits_from(search, index, _other_starts(search, index, good))
                _judge(search, index, scale, recorded_fit, fits, misfits)


@torch.no_grad()
def judge_again(search: StateSearch) -> None:
    """Judge states again once the other states are fitted: those that contradict the others, which are accepted as
    recorded if they no longer do, and those that may be wrong. No frame is excluded by its misfit alone, as the limit
    decreases while all others improve."""
    refinement, recorded = search.refinement, search.scene.recorded
    misfits = replace(Misfits.of(search), rejection_limit=math.inf)
    suspects = _suspects(search, misfits)
    good = _states_of(search, [index for index in range(len(recorded.names)) if refinement.counts(index)])
    for index in misfits.of_frame:
        contradicts = refinement.verdict(index) is not Verdict.ACCEPTED
        if contradicts or index in suspects:
            starts, recorded_fit = _other_starts(search, index, good), _own_fit(search, index, 1.0)
            if search.linked:
                starts.append(mirrored_state(search, index, recorded.states[index]))
            if contradicts:
                starts.append(search.state(index))
            _judge(search, index, 1.0, recorded_fit, _fits_from(search, index, starts), misfits)


@torch.no_grad()
def fitted_anew(search: StateSearch, index: int) -> tuple[StateFit, Tensor] | None:
    """Return the fit of a frame with a wrong recorded state about its present one, as `refitted` does; None if it
    leaves the image."""
    fits = _fits_from(search, index, [search.state(index)])
    return refitted(search, index, fits) if fits else None


def leave_out_unexplained(search: StateSearch, misfits: Mapping[int, float]) -> None:
    """Exclude frames that were refitted and are outliers after the last fits: their states remain unknown.

    misfits: by frame index, of all frames that count.
    """
    refinement = search.refinement
    right = [misfit for index, misfit in misfits.items() if refinement.verdict(index) is Verdict.ACCEPTED]
    limit = _limit(torch.tensor(right), JUDGE.outlying) if len(right) >= JUDGE.min_frames else math.inf
    for index, misfit in misfits.items():
        if refinement.verdict(index) is Verdict.REFITTED and misfit > limit:
            refinement.judge(index, Verdict.EXCLUDED)


def _judge(
    search: StateSearch,
    index: int,
    scale: float,
    fit: StateFit | None,
    others: Sequence[StateFit],
    misfits: Misfits,
) -> None:
    """Refit the state of frame `index` if another state explains its image much better, or exclude the frame if none
    does. A frame with such a verdict is accepted again if no other state explains its image better.

    fit: the best fit about the recorded state; None if it leaves the image (gain 0). others: fits about other states.
    """
    refinement, recorded = search.refinement, search.scene.recorded.states[index]
    misfit, gain = (misfits.of_frame[index], 0.0) if fit is None else (fit.misfit, max(fit.gain, 0.0))
    best = _best(others) if others else None
    verdict = Verdict.ACCEPTED
    # an instrument that is hardly in the image has a low misfit as well
    if best is not None and best.misfit < JUDGE.better * misfit and best.gain > gain:
        if _distance(search, index, recorded, best.state, scale) > JUDGE.min_distance:
            verdict = Verdict.REFITTED if best.misfit < misfits.limit else Verdict.EXCLUDED
            refit, deviations = refitted(search, index, others)
            refinement.set_state(index, recorded, refit.state, deviations)
    elif misfits.rejection_limit < misfit < math.inf:
        verdict = Verdict.EXCLUDED
    explained = not misfits.limit < misfit < math.inf and (best is None or best.gain <= JUDGE.unclear * gain)
    if verdict is not Verdict.ACCEPTED:
        refinement.judge(index, verdict)
    elif explained and refinement.verdict(index) is not Verdict.ACCEPTED:
        refined = recorded if fit is None else fit.state
        refinement.set_state(index, recorded, refined, search.deviations(index, scale))
        refinement.judge(index, Verdict.ACCEPTED)


def _own_fit(search: StateSearch, index: int, scale: float) -> StateFit | None:
    """Return the best fit of a frame with the prior about its recorded state, from several initial states, as a single
    fit may end in a local minimum. None if all leave the image."""
    recorded, precision = search.scene.recorded.states[index], search.precision(index, scale)
    starts = [recorded, search.state(index), *_sampled(search, index, recorded, precision, JUDGE.n_own)]
    return max(_fits(search, index, starts, precision, recorded), key=lambda fit: fit.gain, default=None)


def _sampled(search: StateSearch, index: int, state: State, precision: Tensor, count: int) -> list[State]:
    """Return `count` samples of the prior with precision [P, P] about `state`; the frame's index seeds them."""
    spread = torch.linalg.cholesky(torch.linalg.inv(precision))
    random = torch.Generator().manual_seed(index)
    samples = torch.randn((count, len(spread)), generator=random, dtype=torch.float64)
    return [search.fitter.parameters.moved(state, spread @ at) for at in samples]


def _suspects(search: StateSearch, misfits: Misfits) -> list[int]:
    """Return frames of instruments with stated links whose states may be wrong though they are no outliers: whose
    misfit is high, or close to that of the (distinct) mirrored state."""
    if not (math.isfinite(misfits.limit) and search.linked):
        return []
    scores: dict[int, float] = {}
    for index, misfit in misfits.of_frame.items():
        if not math.isfinite(misfit) or search.refinement.verdict(index) is not Verdict.ACCEPTED:
            continue
        state, alike = search.state(index), 0.0
        other = mirrored_state(search, index, state)
        if _distance(search, index, state, other, 1.0) > JUDGE.min_distance:
            alike = JUDGE.alike * misfit / max(search.misfit(index, other), 1e-9)
        scores[index] = max(misfit / misfits.suspect_limit, alike)
    most = min(int(JUDGE.max_share * len(misfits.of_frame)), JUDGE.max_suspects)
    return [index for index in sorted(scores, key=lambda index: -scores[index])[:most] if scores[index] > 1]


def _states_of(search: StateSearch, frames: Sequence[int]) -> list[State]:
    """Return the states of at most `n_others` frames."""
    return [search.state(frames[place]) for place in evenly_spaced(len(frames), JUDGE.n_others)]


def _distance(search: StateSearch, index: int, recorded: State, state: State, scale: float) -> float:
    """Return the RMS of a correction of frame `index` in standard deviations of the prior."""
    apart = search.refinement.layout.increments_between(recorded, state)
    return math.sqrt(float((apart @ search.precision(index, scale) @ apart) / len(apart)))


def mirrored_state(search: StateSearch, index: int, state: State) -> State:
    """Return the state with a similar appearance from afar in frame `index`, for instruments with stated links."""
    camera_from_world = search.scene.recorded.cameras[index].world_from_camera.inverse().cpu().double().numpy()
    return _changed(search, state, lambda tree, shaft, *pose: mirrored(tree, shaft, camera_from_world, *pose))


def half_turned_state(search: StateSearch, state: State) -> State:
    """Return the state with every instrument of stated links rotated by 180 degrees about its shaft."""
    return _changed(search, state, half_turned)


def _changed(
    search: StateSearch,
    state: State,
    change: Callable[[KinematicTree, np.ndarray, np.ndarray, dict[str, float]], tuple[np.ndarray, dict[str, float]]],
) -> State:
    """Return the state with each instrument's pose and readings by `change` of (tree, shaft, pose, readings)."""
    changed: dict[str, InstrumentState] = {}
    for item, shaft in zip(search.scene.instruments, search.shafts, strict=True):
        previous = state.instruments[item.name]
        assert item.kinematics is not None
        joints = {name: float(value) for name, value in previous.joints.items()}
        pose, joints = change(item.kinematics, shaft.numpy(), previous.pose.cpu().double().numpy(), joints)
        changed[item.name] = InstrumentState(torch.from_numpy(pose).to(previous.pose), joints)
    return replace(state, instruments={**state.instruments, **changed})


def describe_contradictions(refinement: Refinement, names: Sequence[str]) -> str:
    """Return a line on contradicting training states and their verdicts; empty without any. names: of all frames."""
    firsts = [frames[0] for frames in refinement.frames_of_instant]
    outcomes = {
        Verdict.REFITTED: "fitted to their images from other states",
        Verdict.EXCLUDED: "left out, as no state explains their images",
    }
    parts = []
    for verdict, outcome in outcomes.items():
        judged = sorted(names[index] for index in firsts if refinement.verdict(index) is verdict)
        more = f" and {len(judged) - JUDGE.max_named} more" if len(judged) > JUDGE.max_named else ""
        if judged:
            parts.append(f"{len(judged)} {outcome} ({', '.join(judged[: JUDGE.max_named])}{more})")
    return f"of {len(firsts)} states, some contradict the others: {'; '.join(parts)}" if parts else ""


def _other_starts(search: StateSearch, index: int, others: Sequence[State]) -> list[State]:
    """Return candidate initial states of a frame: those of other frames, and its own with mirrored joints."""
    recorded, layout = search.scene.recorded.states[index], search.fitter.parameters
    bent = [[-2 * recorded.instruments[p.name].joints[joint] for joint in p.joints] for p in layout.instruments]
    still = [torch.zeros(6, dtype=torch.float64)] * len(bent)
    return [
        *(replace(recorded, instruments=state.instruments) for state in others),
        layout.moved_by_parts(recorded, still, bent),
    ]


def _fits_from(search: StateSearch, index: int, starts: Sequence[State]) -> list[StateFit]:
    """Return fits of a frame from the most promising initial states, and from states about the best of these; empty if
    all leave the image."""
    fits = _fits(search, index, starts, search.precision(index, JUDGE.start_scale))
    return [*fits, *_fits_near(search, index, _best(fits).state)] if fits else []


def _fits_near(search: StateSearch, index: int, state: State) -> list[StateFit]:
    """Return fits of a frame from states about `state` and about its mirrored state."""
    precision = search.precision(index, JUDGE.start_scale)
    about = [state, *([mirrored_state(search, index, state)] if search.linked else [])]
    near = [
        start for center in about for start in _sampled(search, index, center, precision, JUDGE.n_near // len(about))
    ]
    return _fits(search, index, near, precision)


def _best(fits: Sequence[StateFit]) -> StateFit:
    return max(fits, key=lambda fit: fit.gain)


def _fits(
    search: StateSearch, index: int, starts: Sequence[State], precision: Tensor, about: State | None = None
) -> list[StateFit]:
    """Return fits of a frame from the `n_tried` most promising initial states, with a prior of precision [P, P] about
    each (or about the single state `about`)."""
    view = search.view(index, None)
    fits = (
        search.fitter.fit(view, about or start, precision, start, levels=SEARCH.levels, steps=SEARCH.steps)
        for start in search.fitter.ranked(view, starts, SEARCH.levels[0])[: JUDGE.n_tried]
    )
    return [fit for fit in fits if fit is not None]
