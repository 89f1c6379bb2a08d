"""What all browsers share: the runs, what is known of their frames, what is kept, and the thread that draws."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from neeco.errors import NeecoError
from neeco.viewer.artist import Artist
from neeco.viewer.keeping import Keeper
from neeco.viewer.source import Loaded, Source
from neeco.viewer.timeline import Score, Timeline, score_frame
from neeco.viewer.window import DISTANCE_UNITS

LOOKS_AGAIN_S = 2.0  # at the run folders
MOST_SCORES = 4096  # remembered


class Studio:
    """Opens the runs; `start` begins to draw and to watch them."""

    def __init__(self, runs: Sequence[Path], device: torch.device | None = None) -> None:
        """Raises NeecoError where a run folder holds nothing to look at."""
        self.sources = [Source(path, device) for path in runs]
        self.keeper = Keeper(self.sources[0].path)
        self.artist = Artist(self._spare)
        self.distance = self.sources[0].loaded.distance  # mm
        self.unit = DISTANCE_UNITS / self.distance  # viser's, per mm
        self.timelines = [Timeline(source.loaded) for source in self.sources]
        self._scores: dict[tuple[int, int, int], Score] = {}
        self._photographs: dict[int, tuple[tuple[int, int], np.ndarray]] = {}
        self._ended = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="neeco-watcher", daemon=True)

    def start(self) -> None:
        """Draw, and look at the run folders from time to time."""
        self.artist.start()
        self._watcher.start()

    def stop(self) -> None:
        """End both."""
        self._ended.set()
        self.artist.stop()

    @property
    def loaded(self) -> list[Loaded]:
        """What the runs held when they were read last."""
        return [source.loaded for source in self.sources]

    def score(self, number: int, loaded: Loaded, frame: int) -> Score | None:
        """How well run `number` draws a recorded frame; None where its capture is not at hand. Raises NeecoError."""
        if not loaded.frames:
            return None
        key = number, loaded.serial, frame
        if key not in self._scores:
            if len(self._scores) >= MOST_SCORES:
                self._scores.clear()
            self._scores[key] = score_frame(loaded, frame)
        return self._scores[key]

    def photograph(self, number: int, loaded: Loaded, frame: int) -> np.ndarray:
        """A frame's photograph [H, W, 3] in [0, 1]; the last one is remembered. Raises NeecoError."""
        key = loaded.serial, frame
        known = self._photographs.get(number)
        if known is None or known[0] != key:
            known = key, loaded.frames[frame].load_image().numpy()
            self._photographs[number] = known
        return known[1]

    def refresh(self) -> bool:
        """Read what has changed; whether anything was. Its frames are scored anew."""
        changed = [source.refresh() for source in self.sources]
        for number, source in enumerate(self.sources):
            if changed[number]:
                self.timelines[number] = Timeline(source.loaded)
                self._scores.clear()
        return any(changed)

    def _watch(self) -> None:
        while not self._ended.wait(LOOKS_AGAIN_S):
            troubles = [source.trouble for source in self.sources]
            if self.refresh() or troubles != [source.trouble for source in self.sources]:
                self.artist.ask()

    def _spare(self) -> bool:
        """Find out about one more frame."""
        for timeline in self.timelines:
            if not timeline.done:
                # of a frame whose photograph cannot be read the status says so to whoever goes there
                with timeline.loaded.scene.torch_threads(), contextlib.suppress(NeecoError):
                    timeline.advance()
                return True
        return False
