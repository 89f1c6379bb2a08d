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
    monkeypatch.setattr(module, "size_of_errors", lambda search: size)
    monkeypatch.setattr(module, "doubt_states", lambda search, scale: None)
    session = session_of(Silhouettes((), 0.0) if observed else None, linked=linked, expected=expected)
    module.fit_states(session, None, module.DECIDED_AT)  # type: ignore[arg-type]
    assert (module.FOUND in session.scene.diagnostics) == fitted
