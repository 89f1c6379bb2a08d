"""An ingest says in its last lines how good it is, and what in its recording contradicts."""

from __future__ import annotations

import json

from neeco.cli import main


def ingested(recorded, capsys, sync: str, *words: str) -> tuple[int, str]:
    """Exit status and output of `neeco ingest` of the recording with this `sync`."""
    path = recorded.write()
    text = path.read_text().replace("registration_steps: 1", "registration_steps: 6")
    path.write_text(text.replace("sync: sync.json", f"sync: {sync}"))
    status = main(["ingest", str(path), "--output", str(recorded.folder / "out"), *words])
    return status, capsys.readouterr().out


def test_a_stated_clock_that_motion_contradicts_is_doubtful(recorded, capsys):
    status, told = ingested(recorded, capsys, "{em: 0.14}")
    verdict = told[told.index("how good it is: ") :]
    assert verdict.startswith("how good it is: DOUBTFUL: sync: em: 140.0 ms contradicts")
    assert "which gives 4" in verdict
    assert status == 0
    assert "DOUBTFUL" not in (recorded.folder / "out" / "ingest.html").read_text()
    assert "Doubtful: sync: em" in (recorded.folder / "out" / "ingest.html").read_text()


def test_strict_ends_a_doubtful_ingest_with_status_1(recorded, capsys):
    status, told = ingested(recorded, capsys, "{em: 0.14}", "--strict", "--json")
    assert status == 1
    found = json.loads(told)
    assert found["verdict"] == "doubtful"
    assert found["clocks"]["em"]["offset_s"] == 0.14
    assert any("sync: em" in doubt.lower() for doubt in found["doubts"])
    assert (recorded.folder / "out" / "transforms.json").is_file()
