"""Single wrong states (mirrored, another moment's), found by what they leave unexplained of their image.

Outliers are found at once. Where there are any, or all states have errors, others may be wrong, too, though they are
explained as well as right ones: a mirrored state looks alike, and the scene has learned from it. Such frames are held
back, and judged by a scene that went on learning without them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neeco.capture.model import InstrumentState, State, evenly_spaced
from neeco.fitting.link_silhouette import mirrored
from neeco.fitting.state_fitter import StateFit
from neeco.methods.kinematic.state_search import LEVELS, STEPS, StateSearch
from neeco.training.session import GaussianSession

CONTRADICTING = "contradicting_states"  # of a scene's diagnostics: what became of each, by the frame's name
HELD_BACK = "held_back"  # of a scene's diagnostics: names of frames that the scene does not learn from, to judge them
OUTLYING = 3.0  # robust standard deviations of a log misfit above which a state is an outlier
REJECTED = 6.0  # above which a frame that no state explains is left out
BETTER = 0.6  # of an outlier's misfit: that of another state which refutes it
MIN_DISTANCE = 3.0  # standard deviations of the prior, root mean square, of a state that is another one
EXPLAINED = 1.0  # misfit up to which a state explains its image
MIN_SPREAD = 0.25  # standard deviation of log misfits, at least
N_OTHERS = 60  # frames whose states are tried
N_TRIED = 3  # of them that are fitted
MIN_FRAMES = 8  # with fewer, no state contradicts the others
START_SCALE = 3.0  # of the prior about another start, times usual errors
SUSPECT = 1.0  # robust standard deviations of a log misfit above which a state may be wrong
ALIKE = 1.15  # times a state's misfit, below which the mirrored state may be right instead
REFUTED, CLEARLY_REFUTED = 0.8, 0.5  # of a suspect's misfit: that of the mirrored state, or another, which refutes it
USUAL = 1.2  # times the median misfit, up to which a suspect is explained
MAX_SHARE, MAX_SUSPECTS = 1 / 3, 24  # of all frames
MAX_NAMED = 8  # frames in a line
FITTED_ANEW, LEFT_OUT = "fitted anew", "left out"


@dataclass(frozen=True)
class Misfits:
    """Misfits of training frames in their present states, infinite where no instrument is in the image; `limit` above
    which a state is an outlier, `rejection_limit` above which a frame that no other state explains is left out,
    `suspect_limit` above which a state may be wrong."""

    of_frame: dict[int, float]
    limit: float
    rejection_limit: float
    suspect_limit: float

    @classmethod
    def of(cls, search: StateSearch) -> Misfits:
        """Measure them. With few frames, or where half of them would be, there are no outliers."""
        count = len(search.session.recorded.names)
        misfits = {index: search.misfit(index, search.state(index)) for index in range(count)}
        shown = torch.tensor([misfit for misfit in misfits.values() if math.isfinite(misfit)])
        if len(shown) < MIN_FRAMES:
            return cls(misfits, math.inf, math.inf, math.inf)
        logs = shown.clamp(1e-3, 1e3).log()
        spread = max(1.4826 * float((logs - logs.median()).abs().median()), MIN_SPREAD)
        median = float(logs.median())
        limits = (max(median + many * spread, math.log(EXPLAINED)) for many in (OUTLYING, REJECTED, SUSPECT))
        found = cls(misfits, *map(math.exp, limits))
        if len(found.outliers) > len(shown) // 2:
            return replace(found, limit=math.inf, rejection_limit=math.inf)
        return found

    @property
    def outliers(self) -> list[int]:
        """Frames whose states leave much more unexplained than those of the others."""
        return [index for index, misfit in self.of_frame.items() if self.limit < misfit < math.inf]


@torch.no_grad()
def refit_outliers(search: StateSearch, scale: float, misfits: Misfits, *, large: bool) -> None:
    """Fit states that are outliers from other starts, or leave them out, and note them in the scene's diagnostics.
    Where there are any, or all states have errors (`large`), hold back frames whose states may be wrong, too.

    scale: of the errors of all states (see `StateSearch.fitted`).
    """
    session, refinement, diagnostics = search.session, search.session.refinement, search.session.scene.diagnostics
    limit, names = misfits.limit, session.recorded.names
    others = _states_of(search, [index for index, misfit in misfits.of_frame.items() if misfit <= limit])
    noted: dict[str, str] = dict(diagnostics.get(CONTRADICTING, {}))
    for index in misfits.outliers:
        if names[index] in noted:
            continue
        own, given = search.fitted(index, scale), session.recorded.states[index]
        misfit = misfits.of_frame[index] if own is None else own.fit.misfit
        if misfit <= limit:
            continue
        found = _fit_from(search, index, _other_starts(search, index, others))
        verdict = ""
        if found is not None and found[0].misfit < BETTER * misfit:
            if _distance(search, index, given, found[0].state, scale) > MIN_DISTANCE:
                verdict = FITTED_ANEW if found[0].misfit < limit else LEFT_OUT
                refinement.set_state(index, given, found[0].state, found[1])
        elif misfit > misfits.rejection_limit:
            verdict = LEFT_OUT
        if verdict == LEFT_OUT:
            refinement.weights[index] = 0
        if verdict:
            noted[names[index]] = verdict
    if noted:
        diagnostics[CONTRADICTING] = noted
    if noted or large:
        hold_back(search, misfits)


def hold_back(search: StateSearch, misfits: Misfits) -> None:
    """Let the scene no longer learn from frames whose states may be wrong; note their names in its diagnostics."""
    session, suspects = search.session, _suspects(search, misfits)
    session.refinement.weights[suspects] = 0
    session.scene.diagnostics[HELD_BACK] = [session.recorded.names[index] for index in suspects]


@torch.no_grad()
def judge_held_back(search: StateSearch) -> None:
    """Compare the states of frames that were held back, or left out, with others, by a scene that went on without them:
    wrong ones are fitted anew, right ones count again."""
    session, refinement, diagnostics = search.session, search.session.refinement, search.session.scene.diagnostics
    held: list[str] = diagnostics.pop(HELD_BACK)
    noted: dict[str, str] = dict(diagnostics.get(CONTRADICTING, {}))
    certain = [index for index in range(len(refinement.weights)) if refinement.weights[index] > 0]
    misfits = torch.tensor([search.misfit(index, search.state(index)) for index in certain])
    usual = max(USUAL * float(misfits.median()), EXPLAINED)
    others = _states_of(search, certain)
    for index, name in enumerate(session.recorded.names):
        if name not in held and noted.get(name) != LEFT_OUT:
            continue
        given = session.recorded.states[index]
        own = search.fitted(index, 1.0, start=given)
        misfit = math.inf if own is None else own.fit.misfit
        mirror = [mirrored_state(search, index, given)] if search.linked else []
        for starts, refuted in ((mirror, REFUTED), (_other_starts(search, index, others), CLEARLY_REFUTED)):
            found = _fit_from(search, index, starts)
            if (
                found is not None
                and found[0].misfit < min(refuted * misfit, usual)
                and _distance(search, index, given, found[0].state, 1.0) > MIN_DISTANCE
            ):
                noted[name] = FITTED_ANEW
                refinement.set_state(index, given, found[0].state, found[1])
                break
        refinement.weights[index] = float(noted.get(name) != LEFT_OUT)
    if noted:
        diagnostics[CONTRADICTING] = noted


def _suspects(search: StateSearch, misfits: Misfits) -> list[int]:
    """Return frames of instruments with stated links whose states may be wrong though they are no outliers: explained
    worse than most, or not much better than the mirrored state, which is another one."""
    session, weights = search.session, search.session.refinement.weights
    if not (math.isfinite(misfits.limit) and search.linked):
        return []
    noted = session.scene.diagnostics.get(CONTRADICTING, {})
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
    found: dict[str, InstrumentState] = {}
    for item, shaft in zip(search.session.scene.instruments, search.shafts, strict=True):
        own = state.instruments[item.name]
        assert item.kinematics is not None
        pose = own.pose.cpu().double().numpy()
        joints = {name: float(value) for name, value in own.joints.items()}
        pose, joints = mirrored(item.kinematics, shaft.numpy(), camera_from_world, pose, joints)
        found[item.name] = InstrumentState(torch.from_numpy(pose).to(own.pose), joints)
    return replace(state, instruments={**state.instruments, **found})


def report_contradictions(session: GaussianSession) -> None:
    """Report in one line which training states contradict the others, and what became of them."""
    noted: dict[str, str] = session.scene.diagnostics.get(CONTRADICTING, {})
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


def _fit_from(search: StateSearch, index: int, starts: Sequence[State]) -> tuple[StateFit, Tensor] | None:
    """Return the best fit of a frame from the most promising starts, with its standard deviations [P]; None where none
    stays in the image."""
    view = search.view(index, None)
    best: tuple[StateFit, Tensor] | None = None
    for start in search.fitter.ranked(view, starts, 0.25)[:N_TRIED]:
        precision = search.precision(index, START_SCALE)
        fit = search.fitter.fit(view, start, precision, levels=LEVELS, steps=STEPS)
        if fit is not None and (best is None or fit.misfit < best[0].misfit):
            best = fit, fit.deviations(precision)
    return best
