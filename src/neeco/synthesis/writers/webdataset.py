"""WebDataset: tar files of samples, read in a row: `webdataset/{train,val}-NNNNNN.tar`.

A sample's files have its number as key: `.png` (image), `.mask.png`, `.parts.png`, `.ignore.png`, `.depth.png` and
`.json` (its record: state, camera, labels).
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from neeco.files import write_atomically
from neeco.synthesis.writers.folder import Record, stem, told

FOLDER = "webdataset"
SHARD = 1000  # samples in a tar file
ENDINGS = {"images": "png", "masks": "mask.png", "parts": "parts.png", "ignore": "ignore.png", "depth": "depth.png"}


def write_webdataset(root: Path, records: Sequence[Record]) -> None:
    """(Re)write the shards; the same data set gives the same bytes. Raises NeecoError."""
    for old in (root / FOLDER).glob("*.tar"):
        old.unlink()
    for split in sorted({record["split"] for record in records}):
        chosen = [record for record in records if record["split"] == split]
        for number, start in enumerate(range(0, len(chosen), SHARD)):
            path = root / FOLDER / f"{split}-{number:06d}.tar"
            shard = chosen[start : start + SHARD]
            write_atomically(path, partial(_write_shard, root, shard))


def _write_shard(root: Path, records: Sequence[Record], path: Path) -> None:
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for record in records:
            key = stem(record["index"])
            for folder, ending in ENDINGS.items():
                _add(tar, f"{key}.{ending}", (root / folder / f"{key}.png").read_bytes())
            _add(tar, f"{key}.json", json.dumps(told(record), allow_nan=False).encode())


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    entry = tarfile.TarInfo(name)  # of the year 1970 and nobody's, so that bytes depend on content alone
    entry.size = len(content)
    tar.addfile(entry, io.BytesIO(content))
