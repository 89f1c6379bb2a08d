"""States are fitted to their images where their errors are larger than a tracker's, and wrong ones judged again."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from neeco.methods.kinematic import state_passes as module
from neeco.methods.kinematic.contradictions import CONTRADICTING


def session_of(*, cameras: int = 1) -> Any:
    """One instant that so many cameras show."""
    refinement = SimpleNamespace(frames_of_instant=[tuple(range(cameras))], deviations={})
    refinement.set_deviations = refinement.deviations.__setitem__
    scene = SimpleNamespace(instruments=(SimpleNamespace(kinematics=None),), diagnostics={})
    config = SimpleNamespace(refine=SimpleNamespace(frame_poses=True))
    return SimpleNamespace(scene=scene, refinement=refinement, config=config, report=lambda text: None)


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize(
    ("size", "stated", "large"), [(0.15, 0.0, False), (0.3, 0.0, True), (0.0, 0.1, False), (0.0, 1.0, True)]
)
def test_corrections_are_as_uncertain_as_errors_are_large(
    cameras: int, size: float, stated: float, large: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By what images show, or the recording states; of instants that several cameras show, too."""
    session = session_of(cameras=cameras)
    search = SimpleNamespace(session=session, deviations=lambda index, scale: scale, stated_scale=lambda: stated)
    monkeypatch.setattr(module, "size_of_errors", lambda search, outliers: size)
    assert module.size_errors(search, ()) == large  # type: ignore[arg-type]
    assert (module.STATE_ERRORS in session.scene.diagnostics) == large
    assert session.refinement.deviations == ({0: module.SCALE} if large else {})


@pytest.mark.parametrize(
    ("diagnostics", "judged"),
    [({}, False), ({module.STATE_ERRORS: 1.0}, True), ({CONTRADICTING: {"000001": "fitted anew"}}, True)],
)
def test_states_are_judged_again_where_some_may_be_wrong(
    diagnostics: dict[str, Any], judged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, seen = session_of(), []
    session.scene.diagnostics = diagnostics
    monkeypatch.setattr(module.StateSearch, "of", lambda session, articulated: None)
    monkeypatch.setattr(module, "judge_again", seen.append)
    module.judge_states_again(session, None)  # type: ignore[arg-type]
    assert bool(seen) == judged


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
