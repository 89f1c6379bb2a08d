"""An ingest says in its last lines how good it is, and what in its recording contradicts."""

from __future__ import annotations

from neeco.cli import main


def test_a_stated_clock_that_motion_contradicts_is_doubtful_and_strict_ends_it_with_status_1(recorded, capsys):
    path = recorded.write()
    text = path.read_text().replace("registration_steps: 1", "registration_steps: 6")
    path.write_text(text.replace("sync: sync.json", "sync: {em: 0.14}"))
    assert main(["ingest", str(path), "--output", str(recorded.folder / "out"), "--strict"]) == 1
    told = capsys.readouterr().out
    verdict = told[told.index("verdict: ") :]
    assert verdict.startswith("verdict: DOUBTFUL: sync: em: 140.0 ms contradicts")
    assert "which gives 4" in verdict
    assert verdict.splitlines()[-1].startswith("do not train: ")
    assert told.count("140.0 ms contradicts") == 1  # once is enough
    page = (recorded.folder / "out" / "ingest.html").read_text()
    assert "DOUBTFUL" not in page
    assert "Doubtful: sync: em" in page
    assert (recorded.folder / "out" / "transforms.json").is_file()
