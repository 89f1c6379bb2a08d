"""Labelled frames in the colours of another recording's frames, which nobody labelled: the arm `match`."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from neeco.studies.downstream.samples import Example, RecordedSample, Sample, loaded
from neeco.synthesis.backgrounds import ImageFolder

MATCHED_IMAGES = 200  # recoloured: as many as there are synthetic ones with --match-colors of 400


@dataclass(frozen=True)
class MatchedSample:
    """A labelled frame with the mean and the standard deviation of each colour channel of frame `number` of `frames`,
    as `neeco synthesize --match-colors` recolours synthetic images."""

    source: RecordedSample
    frames: ImageFolder
    number: int

    @property
    def name(self) -> str:
        return f"{self.source.name} in the colours of {self.frames.files[self.number].name}"

    @property
    def key(self) -> Hashable:
        return "matched", self.source.key, self.frames.files[self.number]

    def load(self) -> Example:
        """Raises NeecoError where the frame or the other image cannot be read."""
        example = loaded(self.source)
        pixels = self.frames.colors(self.number).given_to(example.image.astype(np.float32) / 255)
        return replace(example, image=(pixels * 255).round().astype(np.uint8))


def matched_samples(samples: Sequence[RecordedSample], folder: Path, seed: int) -> list[Sample]:
    """The labelled frames, each as often as it is and in the colours of frames of the folder, sampled at random.
    Raises NeecoError for a folder without images."""
    frames, rng = ImageFolder.of(folder, "match_colors"), np.random.default_rng(np.random.SeedSequence([seed, 2]))
    found: list[Sample] = []
    for _ in range(max(1, -(-MATCHED_IMAGES // max(1, len(samples))))):
        for sample in samples:
            found += [sample, MatchedSample(sample, frames, int(rng.integers(len(frames.files))))]
    return found
