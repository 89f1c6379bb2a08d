"""The one thread that draws: the latest wish first, then sharp what stands still, then what nobody waits for."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Protocol

STILL_S = 0.15  # since the last wish: what is shown stands still and is drawn sharp
IDLE_S = 0.5

log = logging.getLogger(__name__)


class Sitter(Protocol):
    """One browser, as the artist sees it."""

    @property
    def key(self) -> int:
        """Which browser it is."""
        ...

    def draw(self, sharp: bool) -> None:
        """Draw what is wished for now, and show it."""
        ...

    def tick(self, now: float) -> float | None:
        """Let time go on; when to be called again (s, of time.perf_counter), or None: nothing moves by itself."""
        ...


class Artist:
    """Draws for all browsers in turn. While it draws, further wishes of one browser replace each other. Any thread may
    ask; `spare` is called when there is nothing to draw, and says whether it did something."""

    def __init__(self, spare: Callable[[], bool] = lambda: False) -> None:
        self._spare = spare
        self._lock, self._wake = threading.Lock(), threading.Event()
        self._sitters: dict[int, Sitter] = {}
        self._wished: dict[int, float] = {}  # when, of wishes that nothing was drawn for; the oldest first
        self._blurred: dict[int, float] = {}  # when the last wish was, of pictures that are to be drawn sharp
        self._jobs: list[Callable[[], None]] = []
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="neeco-artist", daemon=True)

    @property
    def sitters(self) -> tuple[Sitter, ...]:
        """Those who are here."""
        with self._lock:
            return tuple(self._sitters.values())

    def start(self) -> None:
        """Begin to draw."""
        self._thread.start()

    def stop(self) -> None:
        """End after what is being drawn."""
        self._stopped = True
        self._wake.set()
        self._thread.join(timeout=10)

    def seat(self, sitter: Sitter) -> None:
        """A browser has come."""
        with self._lock:
            self._sitters[sitter.key] = sitter
        self.ask(sitter.key)

    def leave(self, key: int) -> None:
        """A browser has gone."""
        with self._lock:
            for kept in (self._sitters, self._wished, self._blurred):
                kept.pop(key, None)

    def ask(self, key: int | None = None) -> None:
        """A browser, or every one, wishes for another picture."""
        now = time.perf_counter()
        with self._lock:
            for which in list(self._sitters) if key is None else [key]:
                if which in self._sitters:
                    self._wished.setdefault(which, now)
                    self._blurred[which] = now
        self._wake.set()

    def do(self, job: Callable[[], None]) -> None:
        """Have something else done between two pictures, by the thread that draws."""
        with self._lock:
            self._jobs.append(job)
        self._wake.set()

    def _run(self) -> None:
        while not self._stopped:
            self._wake.clear()
            until = self._tick()
            if self._draw_once():
                continue
            try:
                if self._spare():
                    continue
            except Exception:
                log.exception("what was to be found out in spare time failed")
            now = time.perf_counter()
            waits = [IDLE_S, *(moment - now for moment in until), *self._settling(now)]
            self._wake.wait(max(0.0, min(waits)))

    def _tick(self) -> list[float]:
        now = time.perf_counter()
        moments = []
        for sitter in self.sitters:
            try:
                moments.append(sitter.tick(now))
            except Exception:
                # one browser's trouble must not end the others' pictures
                log.exception("letting time go on failed")
                self.leave(sitter.key)
        return [moment for moment in moments if moment is not None]

    def _draw_once(self) -> bool:
        """Do the most urgent thing; whether there was one."""
        with self._lock:
            job = self._jobs.pop(0) if self._jobs else None
            wished = min(self._wished, key=self._wished.__getitem__, default=None)
            still = [key for key, since in self._blurred.items() if time.perf_counter() - since >= STILL_S]
            key = wished if wished is not None else next(iter(still), None)
            sitter = None if job is not None or key is None else self._sitters[key]
            if sitter is not None and wished is not None:
                del self._wished[wished]
            elif sitter is not None:
                del self._blurred[still[0]]
        try:
            if job is not None:
                job()
            elif sitter is not None:
                sitter.draw(sharp=wished is None)
        except Exception:
            # one browser's trouble must not end the others' pictures
            log.exception("drawing failed")
        return job is not None or sitter is not None

    def _settling(self, now: float) -> list[float]:
        with self._lock:
            return [STILL_S - (now - since) for since in self._blurred.values()]
