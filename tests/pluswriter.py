"""Writes sequences in the layouts of the PLUS toolkit: MetaImage and NRRD."""

from __future__ import annotations

import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

Shape = tuple[int, int, int, int]  # frames, height, width, channels
Fields = list[tuple[str, str]]


def frame_fields(
    times: np.ndarray,
    transforms: Mapping[str, np.ndarray],
    statuses: Mapping[tuple[str, int], str] | None = None,
    bad_images: tuple[int, ...] = (),
) -> Fields:
    """(name, value) of every frame at times [N] s: transforms [N, 4, 4] mm by name (`StylusToTracker`), OK but where
    `statuses` says otherwise."""
    fields = []
    for frame, time in enumerate(times):
        start = f"Seq_Frame{frame:04d}_"
        for name, matrices in transforms.items():
            numbers = " ".join(format(value, ".12g") for value in np.ravel(matrices[frame]))
            fields.append((f"{start}{name}Transform", numbers))
            fields.append((f"{start}{name}TransformStatus", (statuses or {}).get((name, frame), "OK")))
        fields.append((f"{start}FrameNumber", str(frame)))
        fields.append((f"{start}UnfilteredTimestamp", format(time, ".12g")))
        fields.append((f"{start}Timestamp", format(time, ".12g")))
        fields.append((f"{start}ImageStatus", "INVALID" if frame in bad_images else "OK"))
    return fields


def write_mha(
    path: Path,
    fields: Fields,
    shape: Shape,
    images: Iterable[np.ndarray] = (),
    compressed: bool = False,
    beside: str | None = None,
) -> Path:
    """A MetaImage sequence of images uint8 [H, W, C]; beside: the file for them, else they follow the header."""
    count, height, width, channels = shape
    header: dict[str, Any] = {"ObjectType": "Image", "NDims": 4, "AnatomicalOrientation": "RAI", "BinaryData": True}
    header |= {"BinaryDataByteOrderMSB": False, "CenterOfRotation": "0 0 0", "CompressedData": compressed}

    def head(stored: int) -> str:
        given = header | ({"CompressedDataSize": stored} if compressed else {})
        given |= {"DimSize": f"{width} {height} 1 {count}", "ElementNumberOfChannels": channels}
        given |= {"ElementSpacing": "1 1 1 1", "ElementType": "MET_UCHAR", "Kinds": "domain domain domain list"}
        given |= {"UltrasoundImageOrientation": "MFA", "UltrasoundImageType": "RGB_COLOR"}
        lines = [f"{name} = {value}" for name, value in [*given.items(), *fields]]
        return "\n".join([*lines, f"ElementDataFile = {beside or 'LOCAL'}"]) + "\n"

    packer = zlib.compressobj(1) if compressed else None
    return _write(path, head, images, packer, beside)


def write_nrrd(
    path: Path,
    fields: Fields,
    shape: Shape,
    images: Iterable[np.ndarray] = (),
    compressed: bool = False,
    beside: str | None = None,
) -> Path:
    """The same as NRRD."""
    count, height, width, channels = shape
    vector = channels > 1
    lines = ["NRRD0004", "# Complete NRRD file format specification at:", "type: unsigned char"]
    lines.append(f"dimension: {5 if vector else 4}")
    lines.append(f"sizes: {f'{channels} ' if vector else ''}{width} {height} 1 {count}")
    lines.append(f"kinds: {'vector ' if vector else ''}domain domain domain list")
    lines += ["endian: little", f"encoding: {'gzip' if compressed else 'raw'}", "space: right-anterior-superior"]
    lines += [f"{name}:={value}" for name, value in fields]
    lines += [f"data file: {beside}"] if beside else []
    packer = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS | 16) if compressed else None
    return _write(path, lambda stored: "\n".join(lines) + "\n\n", images, packer, beside)


def _write(
    path: Path, head: Callable[[int], str], images: Iterable[np.ndarray], packer: Any, beside: str | None
) -> Path:
    """Write the images, then the header, which says how many bytes they take."""
    with tempfile.TemporaryFile(dir=path.parent) as data:
        for image in images:
            content = np.ascontiguousarray(image).tobytes()
            data.write(content if packer is None else packer.compress(content))
        data.write(b"" if packer is None else packer.flush())
        stored = data.tell()
        data.seek(0)
        with path.open("wb") as file:
            file.write(head(stored).encode())
            if beside is None:
                shutil.copyfileobj(data, file)
        if beside is not None:
            with (path.parent / beside).open("wb") as file:
                shutil.copyfileobj(data, file)
    return path
