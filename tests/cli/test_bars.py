"""What is told of work that goes on."""

import time
from types import SimpleNamespace

import pytest

from neeco.base.errors import NeecoError
from neeco.cli._progress import Bars, counting
from neeco.studies.study import JobEvent
from neeco.training.train import ProgressRow


def test_a_progress_bar_says_nothing_before_there_is_news(capsys):
    with pytest.raises(NeecoError), counting("synthesize", 3):
        raise NeecoError("bad input")
    assert capsys.readouterr().err == ""
    with counting("synthesize", 3) as advance:
        advance(3)
    assert "3/3" in capsys.readouterr().err


def test_a_file_gets_a_line_at_intervals_with_what_how_far_and_how_long_still(capsys):
    row = ProgressRow(
        iteration=12345678, loss=0.1, psnr=30.04, num_gaussians=23456, phase=1, progress=0.25, seconds=0.4, prepared=0.1
    )
    with Bars(line_interval_s=0.02) as bars:
        bars.training(row)
        time.sleep(0.1)
    first, *_, last = capsys.readouterr().err.splitlines()
    assert first.startswith("training: 25 %, iteration 12345678, PSNR 30.0 dB, 23456 Gaussians, 0:00:00 elapsed")
    assert last.startswith("training: 25 %")
    assert len(first) > 80


def test_a_stage_that_reports_nothing_is_told_too_and_an_error_alone_ends_it(capsys):

    def work() -> None:
        with Bars(line_interval_s=0.02) as bars:
            bars.stage("reading", 0, 0)
            bars.stage("matching", 0, 0)
            time.sleep(0.1)
            raise NeecoError("bad input")

    with pytest.raises(NeecoError):
        work()
    assert set(capsys.readouterr().err.splitlines()) == {"matching: 0:00:00 elapsed"}


def test_the_time_left_follows_from_the_speed_without_preparation(capsys):
    with Bars(line_interval_s=0.02) as bars:
        clock = [1000.0]
        bars.bar.get_time = lambda: clock[0]
        for iteration, share in ((100, 0.1), (200, 0.2)):
            clock[0] += 50
            bars.training(ProgressRow(iteration=iteration, progress=share, seconds=1000.0, prepared=900.0))
        time.sleep(0.15)
    assert "about 0:06:40 left" in capsys.readouterr().err  # 50 s for a tenth


def test_jobs_that_all_ended_have_said_so_and_leave_no_last_line(capsys):
    job = SimpleNamespace(title="kinematic, seed 0")
    with Bars() as bars:
        bars.job(JobEvent(index=0, total=1, job=job, stage="training", share=0.5))
        bars.job(JobEvent(index=0, total=1, job=job, stage="done", result={"iterations": 3}))
    assert capsys.readouterr().err == "1/1 kinematic, seed 0: done: 3 iterations (1 of 1 finished)\n"


def test_work_of_some_length_ends_with_its_total_time(capsys):
    with Bars(min_shown_s=0.0) as bars:
        bars.stage("reading", 1, 1)
    assert capsys.readouterr().err.splitlines()[-1] == "total: 0:00:00"
