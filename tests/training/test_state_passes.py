"""States are fitted to their images where errors are larger than a tracker's, and only where images can tell."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from neeco.methods.kinematic import state_passes as module
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
    search = SimpleNamespace(deviations=lambda index, scale: None)
    monkeypatch.setattr(module.StateSearch, "of", lambda session, articulated: search)
    monkeypatch.setattr(module, "size_of_errors", lambda search, doubted: size)
    monkeypatch.setattr(module, "doubt_states", lambda search, scale, misfits: None)
    monkeypatch.setattr(module.Misfits, "of", lambda search: module.Misfits({}, 1.0, 1.0))
    session = session_of(Silhouettes((), 0.0) if observed else None, linked=linked, expected=expected)
    module.fit_states(session, None, module.DECIDED_AT)  # type: ignore[arg-type]
    assert (module.FOUND in session.scene.diagnostics) == fitted


def test_states_that_are_doubted_do_not_count_for_the_size_of_all_errors() -> None:
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
