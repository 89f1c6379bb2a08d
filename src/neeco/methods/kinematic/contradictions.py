"""Single wrong states (mirrored, another moment's), found by what they leave unexplained of their image.

Outliers are found at once. Others may be wrong, too, though they are explained as well as right ones: a mirrored state
looks alike, and the scene has learned from it. What seems wrong early may be a fault of the scene. So once the others'
states are fitted, all that contradict them, or may be wrong, are judged again.
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
from neeco.fitting.link_silhouette import half_turned, mirrored
from neeco.fitting.state_fitter import StateFit
from neeco.methods.kinematic.state_search import LEVELS, STEPS, StateSearch
from neeco.training.session import GaussianSession

CONTRADICTING = "contradicting_states"  # of a scene's diagnostics: what became of each, by the frame's name
OUTLYING = 3.0  # robust standard deviations of a log misfit above which a state is an outlier
REJECTED = 6.0  # above which a frame that no state explains is left out
BETTER = 0.7  # of a state's misfit: that of another one which refutes it
UNCLEAR = 1.05  # ratio of another fit's gain to that of the fit about the recorded state, up to which the latter holds
MIN_DISTANCE = 3.0  # standard deviations of the prior, root mean square, of a state that is another one
EXPLAINED = 1.0  # misfit up to which a state explains its image
MIN_SPREAD = 0.25  # standard deviation of log misfits, at least
N_OTHERS = 60  # frames whose states are tried
N_TRIED = 3  # of them that are fitted
MIN_FRAMES = 8  # with fewer, no state contradicts the others
START_SCALE = 3.0  # of the prior about another start, times usual errors
SUSPECT = 1.0  # robust standard deviations of a log misfit above which a state may be wrong
ALIKE = 1.15  # times a state's misfit, below which the mirrored state may be right instead
N_OWN, N_NEAR = 12, 64  # starts sampled from the prior about a recorded state, and about another
MAX_SHARE, MAX_SUSPECTS = 1 / 3, 24  # of all frames
MAX_NAMED = 8  # frames in a line
FITTED_ANEW, LEFT_OUT = "fitted anew", "left out"


def contradicting_states(session: GaussianSession) -> dict[str, str]:
    """Return what became of states that contradict the others, by the frame's name."""
    noted: dict[str, str] = session.scene.diagnostics.get(CONTRADICTING, {})
    return noted


@dataclass(frozen=True)
class Misfits:
    """Misfits of training frames in their present states, of several cameras the first one's; infinite where no
    instrument is in the image. Above `limit` a state is an outlier, above `rejection_limit` a frame that no other state
    explains is left out, above `suspect_limit` a state may be wrong."""

    of_frame: dict[int, float]
    limit: float
    rejection_limit: float
    suspect_limit: float

    @classmethod
    def of(cls, search: StateSearch) -> Misfits:
        """Measure them. With few frames, or where half of them would be, there are no outliers."""
        firsts = [frames[0] for frames in search.session.refinement.frames_of_instant]
        misfits = {index: search.misfit(index, search.state(index)) for index in firsts}
        shown = torch.tensor([misfit for misfit in misfits.values() if math.isfinite(misfit)])
        if len(shown) < MIN_FRAMES:
            return cls(misfits, math.inf, math.inf, math.inf)
        limits = (max(_limit(shown, many), EXPLAINED) for many in (OUTLYING, REJECTED, SUSPECT))
        found = cls(misfits, *limits)
        if len(found.outliers) > len(shown) // 2:
            return replace(found, limit=math.inf, rejection_limit=math.inf)
        return found

    @property
    def outliers(self) -> list[int]:
        """Frames whose states leave much more unexplained than those of the others."""
        return [index for index, misfit in self.of_frame.items() if self.limit < misfit < math.inf]


def _limit(misfits: Tensor, many: float) -> float:
    """Return the misfit that lies `many` robust standard deviations of the log misfits [F] above their median."""
    logs = misfits.clamp(1e-3, 1e3).log()
    spread = max(1.4826 * float((logs - logs.median()).abs().median()), MIN_SPREAD)
    return math.exp(float(logs.median()) + many * spread)


@dataclass(frozen=True)
class Refitted:
    """A frame's best fit, and standard deviations [P] that include the spread of those that it does not refute."""

    fit: StateFit
    deviations: Tensor

    @classmethod
    def of(cls, search: StateSearch, index: int, fits: Sequence[StateFit]) -> Refitted:
        """Return the best of `fits`, and, with stated links, of fits about the best one turned by half a turn about its
        shaft, which has a similar outline."""
        precision, best = search.precision(index, START_SCALE), _best(fits)
        if search.linked:
            fits = [*fits, *_fits_near(search, index, half_turned_state(search, best.state))]
            best = _best(fits)
        apart = search.session.refinement.layout.increments_between
        possible = torch.stack([apart(best.state, fit.state) for fit in fits if BETTER * fit.misfit <= best.misfit])
        return cls(best, (best.deviations(precision).square() + possible.square().mean(0)).sqrt())


@torch.no_grad()
def refit_outliers(search: StateSearch, scale: float, misfits: Misfits) -> None:
    """Fit states that are outliers from other starts, or leave them out, and note them in the scene's diagnostics.

    scale: of the errors of all states (see `StateSearch.fitted`).
    """
    names, noted = search.session.recorded.names, contradicting_states(search.session)
    others = _states_of(search, [index for index, misfit in misfits.of_frame.items() if misfit <= misfits.limit])
    for index in misfits.outliers:
        if names[index] not in noted:
            own = _own_fit(search, index, scale)
            if own is None or own.misfit > misfits.limit:
                found = _fits_from(search, index, _other_starts(search, index, others))
                _judge(search, index, scale, own, found, misfits)


@torch.no_grad()
def judge_again(search: StateSearch) -> None:
    """Compare states once more, when the states of the others are fitted: those that contradict the others, which are
    used again as recorded where they no longer do, and those that may be wrong. None is left out by its misfit alone:
    the limit sinks as all others are explained better."""
    session, weights = search.session, search.session.refinement.weights
    names, noted = session.recorded.names, contradicting_states(session)
    misfits = replace(Misfits.of(search), rejection_limit=math.inf)
    judged = {*noted, *(names[index] for index in _suspects(search, misfits))}
    others = _states_of(search, [index for index in range(len(names)) if weights[index] > 0])
    for index in misfits.of_frame:
        name = names[index]
        if name in judged:
            starts, own = _other_starts(search, index, others), _own_fit(search, index, 1.0)
            if search.linked:
                starts.append(mirrored_state(search, index, session.recorded.states[index]))
            if name in noted:
                starts.append(search.state(index))
            _judge(search, index, 1.0, own, _fits_from(search, index, starts), misfits)


@torch.no_grad()
def fitted_anew(search: StateSearch, index: int) -> Refitted | None:
    """Return the fit of a frame whose recorded state is wrong, about its present one; None if it leaves the image."""
    fits = _fits_from(search, index, [search.state(index)])
    return Refitted.of(search, index, fits) if fits else None


def leave_out_unexplained(search: StateSearch, misfits: Mapping[int, float]) -> None:
    """Leave out frames that were fitted anew and are outliers after the last fits: their states remain unknown.

    misfits: by frame index, of all frames with a weight.
    """
    names, noted = search.session.recorded.names, contradicting_states(search.session)
    right = [misfit for index, misfit in misfits.items() if names[index] not in noted]
    limit = _limit(torch.tensor(right), OUTLYING) if len(right) >= MIN_FRAMES else math.inf
    for index, misfit in misfits.items():
        if names[index] in noted and misfit > limit:
            noted[names[index]] = LEFT_OUT
            search.session.refinement.weigh(index, 0.0)


def _judge(
    search: StateSearch,
    index: int,
    scale: float,
    own: StateFit | None,
    others: Sequence[StateFit],
    misfits: Misfits,
) -> None:
    """Replace the state of frame `index` where another explains its image much better, leave the frame out where none
    does, and note either. A frame noted before is used again as recorded if no other state explains more of its image.

    own: the best fit about the recorded state; None where it leaves the image, and its gain is 0. others: fits of other
    states.
    """
    session, name, given = search.session, search.session.recorded.names[index], search.session.recorded.states[index]
    misfit, gain = (misfits.of_frame[index], 0.0) if own is None else (own.misfit, max(own.gain, 0.0))
    other, verdict = _best(others) if others else None, ""
    # an instrument that is hardly in the image has a low misfit, too
    if other is not None and other.misfit < BETTER * misfit and other.gain > gain:
        if _distance(search, index, given, other.state, scale) > MIN_DISTANCE:
            verdict = FITTED_ANEW if other.misfit < misfits.limit else LEFT_OUT
            found = Refitted.of(search, index, others)
            session.refinement.set_state(index, given, found.fit.state, found.deviations)
    elif misfits.rejection_limit < misfit < math.inf:
        verdict = LEFT_OUT
    explained = not misfits.limit < misfit < math.inf and (other is None or other.gain <= UNCLEAR * gain)
    if verdict:
        session.scene.diagnostics.setdefault(CONTRADICTING, {})[name] = verdict
    elif explained and name in contradicting_states(session):
        recorded = given if own is None else own.state
        session.refinement.set_state(index, given, recorded, search.deviations(index, scale))
        del session.scene.diagnostics[CONTRADICTING][name]
    session.refinement.weigh(index, float(contradicting_states(session).get(name) != LEFT_OUT))


def _own_fit(search: StateSearch, index: int, scale: float) -> StateFit | None:
    """Return the best fit of a frame with the prior about its recorded state, from several starts: a single fit may end
    in a local minimum. None where all leave the image."""
    given, precision = search.session.recorded.states[index], search.precision(index, scale)
    starts = [given, search.state(index), *_sampled(search, index, given, precision, N_OWN)]
    return max(_fits(search, index, starts, precision, given), key=lambda fit: fit.gain, default=None)


def _sampled(search: StateSearch, index: int, state: State, precision: Tensor, count: int) -> list[State]:
    """Return `count` samples of the prior with precision [P, P] about `state`; the frame's index seeds them."""
    spread = torch.linalg.cholesky(torch.linalg.inv(precision))
    random = torch.Generator().manual_seed(index)
    samples = torch.randn((count, len(spread)), generator=random, dtype=torch.float64)
    return [search.fitter.parameters.moved(state, spread @ at) for at in samples]


def _suspects(search: StateSearch, misfits: Misfits) -> list[int]:
    """Return frames of instruments with stated links whose states may be wrong though they are no outliers: explained
    worse than most, or not much better than the mirrored state, which is another one."""
    session, weights = search.session, search.session.refinement.weights
    if not (math.isfinite(misfits.limit) and search.linked):
        return []
    noted = contradicting_states(session)
    scores: dict[int, float] = {}
    for index, misfit in misfits.of_frame.items():
        if not (math.isfinite(misfit) and weights[index] > 0) or session.recorded.names[index] in noted:
            continue
        state, alike = search.state(index), 0.0
        other = mirrored_state(search, index, state)
        if _distance(search, index, state, other, 1.0) > MIN_DISTANCE:
            alike = ALIKE * misfit / max(search.misfit(index, other), 1e-9)
        scores[index] = max(misfit / misfits.suspect_limit, alike)
    most = min(int(MAX_SHARE * len(misfits.of_frame)), MAX_SUSPECTS)
    return [index for index in sorted(scores, key=lambda index: -scores[index])[:most] if scores[index] > 1]


def _states_of(search: StateSearch, frames: Sequence[int]) -> list[State]:
    """Return the states of at most N_OTHERS frames."""
    return [search.state(frames[place]) for place in evenly_spaced(len(frames), N_OTHERS)]


def _distance(search: StateSearch, index: int, given: State, state: State, scale: float) -> float:
    """Return the root mean square of a correction of frame `index` in standard deviations of the prior."""
    apart = search.session.refinement.layout.increments_between(given, state)
    return math.sqrt(float((apart @ search.precision(index, scale) @ apart) / len(apart)))


def mirrored_state(search: StateSearch, index: int, state: State) -> State:
    """Return the state that looks alike from afar in frame `index`, of instruments with stated links."""
    camera_from_world = search.session.recorded.cameras[index].world_from_camera.inverse().cpu().double().numpy()
    return _changed(search, state, lambda tree, shaft, *own: mirrored(tree, shaft, camera_from_world, *own))


def half_turned_state(search: StateSearch, state: State) -> State:
    """Return the state with every instrument, of stated links, turned by half a turn about its shaft."""
    return _changed(search, state, half_turned)


def _changed(
    search: StateSearch,
    state: State,
    change: Callable[[KinematicTree, np.ndarray, np.ndarray, dict[str, float]], tuple[np.ndarray, dict[str, float]]],
) -> State:
    """Return the state with pose and readings of each instrument by `change` of (tree, shaft, pose, readings)."""
    found: dict[str, InstrumentState] = {}
    for item, shaft in zip(search.session.scene.instruments, search.shafts, strict=True):
        own = state.instruments[item.name]
        assert item.kinematics is not None
        joints = {name: float(value) for name, value in own.joints.items()}
        pose, joints = change(item.kinematics, shaft.numpy(), own.pose.cpu().double().numpy(), joints)
        found[item.name] = InstrumentState(torch.from_numpy(pose).to(own.pose), joints)
    return replace(state, instruments={**state.instruments, **found})


def report_contradictions(session: GaussianSession) -> None:
    """Report in one line which training states contradict the others, and what became of them."""
    noted = contradicting_states(session)
    if not noted:
        return
    names = sorted(noted)
    shown = ", ".join(names[:MAX_NAMED]) + (f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else "")
    out = sum(verdict == LEFT_OUT for verdict in noted.values())
    session.report(
        f"{len(names)} of {len(session.recorded.names)} states contradict the others: {shown}; {len(names) - out} were "
        f"fitted to their images from other states, {out} left out"
    )


def _other_starts(search: StateSearch, index: int, others: Sequence[State]) -> list[State]:
    """Return states from which a frame is fitted: those of others, and its own with joints bent the other way."""
    given, layout = search.session.recorded.states[index], search.fitter.parameters
    bent = [[-2 * given.instruments[own.name].joints[joint] for joint in own.joints] for own in layout.instruments]
    still = [torch.zeros(6, dtype=torch.float64)] * len(bent)
    return [
        *(replace(given, instruments=state.instruments) for state in others),
        layout.moved_by_parts(given, still, bent),
    ]


def _fits_from(search: StateSearch, index: int, starts: Sequence[State]) -> list[StateFit]:
    """Return fits of a frame from the most promising starts, and from states about the best of these; none where all
    leave the image."""
    fits = _fits(search, index, starts, search.precision(index, START_SCALE))
    return [*fits, *_fits_near(search, index, _best(fits).state)] if fits else []


def _fits_near(search: StateSearch, index: int, state: State) -> list[StateFit]:
    """Return fits of a frame from states about `state`, and about its mirrored one."""
    precision = search.precision(index, START_SCALE)
    about = [state, *([mirrored_state(search, index, state)] if search.linked else [])]
    near = [start for center in about for start in _sampled(search, index, center, precision, N_NEAR // len(about))]
    return _fits(search, index, near, precision)


def _best(fits: Sequence[StateFit]) -> StateFit:
    return max(fits, key=lambda fit: fit.gain)


def _fits(
    search: StateSearch, index: int, starts: Sequence[State], precision: Tensor, about: State | None = None
) -> list[StateFit]:
    """Return fits of a frame from the N_TRIED most promising starts, with a prior of such precision [P, P] about each
    (or `about` one state)."""
    view = search.view(index, None)
    fits = (
        search.fitter.fit(view, about or start, precision, start, levels=LEVELS, steps=STEPS)
        for start in search.fitter.ranked(view, starts, LEVELS[0])[:N_TRIED]
    )
    return [fit for fit in fits if fit is not None]
