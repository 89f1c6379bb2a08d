"""Data set writers, one file per format: index files made from the per-image records that `folder.py` writes.

A writer is a subclass of `Writer`. Ours are found in this package, those of other packages by the entry point
`neeco.writers`, named as the format.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from neeco.labels.labellers import Labeller, instruments_of
from neeco.scene import GaussianScene
from neeco.synthesis.writers.folder import Record


@dataclass(frozen=True, kw_only=True)
class WrittenImages:
    """The images of a data set's folder and their labels, for a `Writer`.

    records: one per image, in the order of their numbers, with the keys of states.jsonl (docs/synthesis.md). Files are
    `root / record["image"]`, and `root / FOLDER / f"{stem(record['index'])}.png"` for the folders of labels.
    """

    root: Path
    records: Sequence[Record]
    part_names: tuple[tuple[str, str], ...]  # (instrument, part) of part id 1, 2, ...
    keypoint_names: tuple[str, ...]
    bones: Sequence[tuple[str, str]]  # pairs of keypoints that a line joins
    scene: GaussianScene  # that rendered the images and labels
    labeller: Labeller

    @property
    def instruments(self) -> tuple[str, ...]:
        """Names of the instruments, in the order of their part ids."""
        return instruments_of(self.part_names)


class Writer(ABC):
    """A data set format. Its class attributes are what the command line and the data set's README.md say of it."""

    format: ClassVar[str]  # name for --formats, and of the folder in the data set that holds all its files
    description: ClassVar[str]  # a line of README.md: which files, for what
    accepts_distortion: ClassVar[bool] = True  # whether it can describe images rendered with the recording's lens

    def refusal(self, parts: Sequence[str]) -> str:
        """Return why the format cannot describe these parts; "" when it can."""
        return ""

    @abstractmethod
    def write(self, images: WrittenImages) -> None:
        """(Re)write all files of the format; the same images give the same bytes. Raises NeecoError."""
