"""States are fitted to their images where errors are larger than a tracker's, and only where images can tell."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from neeco.methods.kinematic import state_passes as module
from neeco.methods.kinematic.contradictions import CONTRADICTING
from neeco.methods.kinematic.state_registration import LARGE_ERRORS
from neeco.training.silhouettes import Silhouettes


def session_of(silhouettes: Silhouettes | None, *, linked: bool, expected: bool) -> Any:
    refinement = SimpleNamespace(frames_of_instant=[(0,)], set_deviations=lambda index, deviations: None)
    tool = SimpleNamespace(kinematics="links" if linked else None)
    scene = SimpleNamespace(instruments=(tool,), diagnostics={LARGE_ERRORS: expected} if linked else {})
    config = SimpleNamespace(refine=SimpleNamespace(frame_poses=True))
    return SimpleNamespace(
        scene=scene, refinement=refinement, config=config, silhouettes=silhouettes, report=lambda text: None
    )


def decided(
    monkeypatch: pytest.MonkeyPatch, session: Any, mark: float, *, size: float = 0.0, stated: float = 0.0
) -> bool:
    """Whether states are fitted after a mark at which images show errors of a size, and the recording states others."""
    search = SimpleNamespace(
        session=session, deviations=lambda index, scale: None, stated_scale=lambda: stated, fitted=lambda *given: None
    )
    monkeypatch.setattr(module.StateSearch, "of", lambda session, articulated: search)
    monkeypatch.setattr(module, "size_of_errors", lambda search, outliers: size)
    monkeypatch.setattr(module, "refit_outliers", lambda search, scale, misfits, large: None)
    monkeypatch.setattr(module, "hold_back", lambda search, misfits: None)
    monkeypatch.setattr(module.Misfits, "of", lambda search: module.Misfits({}, 1.0, 1.0, 1.0))
    monkeypatch.setattr(module, "CARVED_AT", ())
    module.fit_states(session, None, mark)  # type: ignore[arg-type]
    return module.STATE_ERRORS in session.scene.diagnostics


@pytest.mark.parametrize(
    ("linked", "observed", "expected", "size", "fitted"),
    [
        (True, False, False, 1.0, False),  # colours and tissue tell nothing: no fit is to be believed
        (True, False, True, 0.15, False),
        (True, False, True, 0.3, True),
        (True, True, False, 0.06, False),
        (True, True, False, 0.15, True),
        (False, False, False, 0.15, False),
        (False, False, False, 0.3, True),
    ],
)
def test_errors_are_large_by_what_images_can_tell(
    linked: bool, observed: bool, expected: bool, size: float, fitted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = session_of(Silhouettes((), 0.0) if observed else None, linked=linked, expected=expected)
    assert decided(monkeypatch, session, module.DECIDED_AT[0], size=size) == fitted


@pytest.mark.parametrize("stated", [0.1, 1.0])
def test_stated_errors_are_believed_whatever_images_show(stated: float, monkeypatch: pytest.MonkeyPatch) -> None:
    session = session_of(None, linked=True, expected=False)
    assert decided(monkeypatch, session, module.DECIDED_AT[0], stated=stated) == (stated == 1.0)


def test_errors_that_images_show_only_later_are_found_then(monkeypatch: pytest.MonkeyPatch) -> None:
    session = session_of(Silhouettes((), 0.0), linked=True, expected=False)
    assert not decided(monkeypatch, session, module.DECIDED_AT[0], size=0.05)
    assert decided(monkeypatch, session, module.DECIDED_AT[1], size=0.15)


@pytest.mark.parametrize(
    ("diagnostics", "judged"),
    [({}, []), ({module.STATE_ERRORS: 1.0}, [0.45]), ({CONTRADICTING: {"000001": "fitted anew"}}, [0.45])],
)
def test_states_are_judged_again_where_some_may_be_wrong(
    diagnostics: dict[str, Any], judged: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    session, seen = session_of(None, linked=True, expected=False), []
    session.scene.diagnostics = diagnostics | {LARGE_ERRORS: False}
    session.refinement.frames_of_instant = []  # nothing else is to be fitted
    monkeypatch.setattr(module.StateSearch, "of", lambda session, articulated: None)
    monkeypatch.setattr(module, "leave_out_unexplained", lambda search, misfits: None)
    for mark in module.MARKS:
        if mark not in module.DECIDED_AT:
            monkeypatch.setattr(module, "judge_again", lambda search, mark=mark: seen.append(mark))
            module.fit_states(session, None, mark)  # type: ignore[arg-type]
    assert seen == judged


def test_outliers_do_not_count_for_the_size_of_all_errors() -> None:
    tried: list[int] = []
    session = SimpleNamespace(
        full_views=SimpleNamespace(frames=[None] * 12), refinement=SimpleNamespace(fitted=[False] * 12)
    )
    search = SimpleNamespace(
        session=session,
        fitted=lambda index, scale, about: tried.append(index) or index,
        scale_of=lambda fits: float(len(fits)),
    )
    assert module.size_of_errors(search, [3, 7]) == 10.0  # type: ignore[arg-type]
    assert not {3, 7} & set(tried)
