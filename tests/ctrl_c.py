"""Ctrl-C at a moment that a progress callback tells of."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

from neeco.studies.study import JobEvent


def ctrl_c_at(job: int, iteration: int | None = None) -> Callable[[JobEvent], None]:
    """A `progress` of jobs that sends SIGINT in the training of the job at this place; after this
    iteration, where its log_interval is 1."""
    said = "" if iteration is None else f"iteration {iteration} "

    def shown(event: JobEvent) -> None:
        if event.index == job and event.stage == "training" and event.text.startswith(said):
            os.kill(os.getpid(), signal.SIGINT)

    return shown
