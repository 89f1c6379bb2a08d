"""What is told of work that goes on."""

import re
import time
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.cli import _progress
from neeco.cli._progress import Bars, ProgressSettings, counting
from neeco.studies.study import JobEvent
from neeco.training.train import ProgressRow


def test_a_progress_bar_says_nothing_before_there_is_news(capsys):
    with pytest.raises(NeecoError), counting("synthesize", 3):
        raise NeecoError("bad input")
    assert capsys.readouterr().err == ""
    with counting("synthesize", 3) as advance:
        advance(3)
    assert "3/3" in capsys.readouterr().err


def test_a_file_gets_a_line_at_intervals_with_what_how_far_and_how_long_still(capsys, monkeypatch):
    monkeypatch.setattr("neeco.cli._progress.PROGRESS", ProgressSettings(line_interval_s=0.02))
    row = ProgressRow(
        iteration=1234, loss=0.1, psnr=30.04, num_gaussians=23456, phase=1, progress=0.25, seconds=0.4, prepared=0.1
    )
    with Bars() as bars:
        bars.training(row)
        time.sleep(0.1)
    first, *_, last = capsys.readouterr().err.splitlines()
    assert first.startswith("training: 25 %, iteration 1234, PSNR 30.0 dB, 23456 Gaussians, 0:00:00 passed")
    assert first.endswith("left")
    assert last.startswith("training: 25 %")
    assert len(first) > 80


def test_a_stage_that_reports_nothing_is_told_too_and_an_error_alone_ends_it(capsys, monkeypatch):
    monkeypatch.setattr(_progress, "PROGRESS", ProgressSettings(line_interval_s=0.02))

    def work() -> None:
        with Bars() as bars:
            bars.stage("reading", 0, 0)
            bars.stage("matching", 0, 0)
            time.sleep(0.1)
            raise NeecoError("bad input")

    with pytest.raises(NeecoError):
        work()
    assert set(capsys.readouterr().err.splitlines()) == {"matching: 0:00:00 passed"}


def test_the_time_left_counts_down_between_two_news_and_leaves_preparation_out(capsys, monkeypatch):
    monkeypatch.setattr(_progress, "PROGRESS", ProgressSettings(line_interval_s=0.02))
    clock = iter(np.arange(0.0, 1e6, 5.0))  # s: every look at it is 5 s later
    with Bars() as bars:
        monkeypatch.setattr(bars.bar, "get_time", lambda: next(clock))
        bars.training(ProgressRow(iteration=100, progress=0.1, seconds=1000.0, prepared=900.0))
        time.sleep(0.15)
    lines = [line for line in capsys.readouterr().err.splitlines() if "left" in line]
    passed, left = zip(*(map(seconds, re.findall(r"(\d+:\d\d:\d\d)", line)) for line in lines[:4]), strict=True)
    assert 1000 <= passed[0] < 1100  # preparation included
    assert 800 < left[0] <= 900  # 100 s for a tenth
    assert all(later < earlier for earlier, later in pairwise(left))


def seconds(words: str) -> int:
    hours, minutes, rest = map(int, words.split(":"))
    return 3600 * hours + 60 * minutes + rest


def test_jobs_that_all_ended_have_said_so_and_leave_no_last_line(capsys):
    job = SimpleNamespace(title="kinematic, seed 0")
    with Bars() as bars:
        bars.job(JobEvent(index=0, total=1, job=job, stage="training", share=0.5))
        bars.job(JobEvent(index=0, total=1, job=job, stage="done", result={"iterations": 3}))
    assert capsys.readouterr().err == "1/1 kinematic, seed 0: done: 3 iterations (1 of 1 ended)\n"


def test_work_of_some_length_ends_with_its_total_time(capsys, monkeypatch):
    monkeypatch.setattr(_progress, "PROGRESS", ProgressSettings(min_shown_s=0.0))
    with Bars() as bars:
        bars.stage("reading", 1, 1)
    assert capsys.readouterr().err.splitlines()[-1] == "total: 0:00:00"
