"""Ctrl-C while training: the first is heard between two steps, the second stops at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclass
class StopRequest:
    """Whether someone asked the run to stop."""

    heard: bool = False

    def hear(self, number: int, frame: object) -> None:
        """A signal handler. Raises KeyboardInterrupt when it is asked a second time."""
        if self.heard:
            raise KeyboardInterrupt
        self.heard = True


@contextmanager
def hearing_stops() -> Iterator[StopRequest]:
    """Until the end of the block, the first SIGINT or SIGTERM only sets `heard`.

    Signals that are ignored (a job in the background of a script) stay ignored, and outside the main thread, where
    Python lets nobody listen, none are heard.
    """
    request = StopRequest()
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            handler = signal.getsignal(number)
            if handler not in (signal.SIG_IGN, None):
                before[number] = handler
                signal.signal(number, request.hear)
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
