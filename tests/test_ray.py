"""A Ray that neeco starts itself is this machine's own."""

from __future__ import annotations

import pytest

from neeco.cluster import joined

pytest.importorskip("ray")


def test_what_is_started_here_listens_on_loopback_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with joined(1) as ray:
        [node] = ray.nodes()
        assert node["NodeManagerAddress"] == "127.0.0.1"
        assert ray.get_runtime_context().gcs_address.startswith("127.0.0.1:")
