"""Label images with the class ids of public data sets, to pool synthetic images with theirs.

    endovis2018/{train,val}/images/             images (hard links)
    endovis2018/{train,val}/labels/NNNNNN.png   class ids
    endovis2018/classes.json                    names of the ids

Parts become shaft, wrist or clasper by their names. Everything else is 0: tissue, and what those sets label beside
instruments.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from PIL import Image

from neeco.base.files import write_json, write_unsynced
from neeco.capture.images import read_labels
from neeco.synthesis.writers import Writer, WrittenImages, link, stem

CLASSES = {"shaft": "shaft|tube", "wrist": "wrist", "clasper": "clasp|jaw|grip|blade|finger|end_effector"}


class _PublicSet(Writer):
    """classes: id and the set's own name of each class; palette: RGB of the ids where the set's files are coloured."""

    classes: ClassVar[Mapping[str, tuple[int, str]]]
    palette: ClassVar[bytes] = b""

    def refusal(self, parts: Sequence[str]) -> str:
        if wrong := next((part for part in parts if _class_of(part) is None), None):
            problem = f"{self.format} has shaft, wrist and clasper, and the name of part {wrong!r} is like none of them"
            return f"{problem}; rename the link in the capture's kinematics, or leave {self.format} out"
        return ""

    def write(self, images: WrittenImages) -> None:
        """(Re)write images (hard links), label images and classes.json. Raises NeecoError."""
        id_of_part = np.zeros(256, np.uint8)
        for number, (_, part) in enumerate(images.labeller.names, 1):
            id_of_part[number] = self.classes[_class_of(part) or ""][0]
        for record in images.records:
            name, folder = stem(record["index"]), images.root / self.format / record["split"]
            link(images.root / record["image"], folder / "images" / Path(record["image"]).name)
            labels = Image.fromarray(id_of_part[read_labels(images.root / "parts" / f"{name}.png").numpy()])
            if self.palette:  # a pixel's value is its id still
                labels.putpalette(self.palette)
            labels.save(content := io.BytesIO(), "PNG")
            write_unsynced(folder / "labels" / f"{name}.png", content.getvalue())
        named = {str(number): name for number, name in sorted(self.classes.values())}
        write_json(images.root / self.format / "classes.json", {"0": "background"} | named)


def _class_of(part: str) -> str | None:
    """Return shaft, wrist or clasper; None where the part's name has the words of none, or of several."""
    matching = [name for name, words in CLASSES.items() if re.search(words, part, re.IGNORECASE)]
    return matching[0] if len(matching) == 1 else None


class EndoVis2017(_PublicSet):
    """The parts task of 2017 (Allan et al., arXiv:1902.06426)."""

    format = "endovis2017-parts"
    description = "`endovis2017-parts/{train,val}/labels/`: class ids of EndoVis 2017"
    classes: ClassVar = {"shaft": (10, "Shaft"), "wrist": (20, "Wrist"), "clasper": (30, "Claspers")}


class EndoVis2018(_PublicSet):
    """The scene segmentation of 2018 (Allan et al., arXiv:2001.11190)."""

    format = "endovis2018"
    description = "`endovis2018/{train,val}/labels/`: class ids of EndoVis 2018, in its colours"
    classes: ClassVar = {
        name: (number, f"instrument-{name}") for number, name in enumerate(("shaft", "clasper", "wrist"), 1)
    }
    palette = bytes((0, 0, 0, 0, 255, 0, 0, 255, 255, 125, 255, 12))  # RGB of ids 0 to 3


class SarRarp50(_PublicSet):
    """SAR-RARP50 (Psychogyios et al., arXiv:2401.00496)."""

    format = "sar-rarp50"
    description = "`sar-rarp50/{train,val}/labels/`: class ids of SAR-RARP50"
    classes: ClassVar = {name: (number, f"Tool {name}") for number, name in enumerate(("clasper", "wrist", "shaft"), 1)}
