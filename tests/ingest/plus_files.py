"""Sequences in the layouts that PLUS writes, for tests that read them."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

import numpy as np


def matrix_text(matrix: np.ndarray) -> str:
    return " ".join(format(value, ".9g") for value in np.ravel(matrix))


def frame_fields(
    times: np.ndarray,
    transforms: dict[str, np.ndarray],
    statuses: dict[tuple[str, int], str] | None = None,
    bad_images: tuple[int, ...] = (),
) -> list[tuple[str, str]]:
    """(name, value) of every frame: transforms [N, 4, 4] by name, OK but where `statuses` says otherwise."""
    fields = []
    for frame, time in enumerate(times):
        start = f"Seq_Frame{frame:04d}_"
        for name, matrices in transforms.items():
            status = (statuses or {}).get((name, frame), "OK")
            fields.append((f"{start}{name}Transform", matrix_text(matrices[frame])))
            fields.append((f"{start}{name}TransformStatus", status))
        fields.append((f"{start}FrameNumber", str(frame)))
        fields.append((f"{start}UnfilteredTimestamp", format(time, ".9g")))
        fields.append((f"{start}Timestamp", format(time, ".9g")))
        fields.append((f"{start}ImageStatus", "INVALID" if frame in bad_images else "OK"))
    return fields


def write_mha(
    path: Path,
    fields: list[tuple[str, str]],
    images: np.ndarray | int,
    compressed: bool = False,
    beside: str | None = None,
) -> Path:
    """A MetaImage sequence. images: uint8 [N, H, W, C], or how many frames without images; beside: the data's file."""
    count = images if isinstance(images, int) else len(images)
    height, width, channels = (0, 0, 1) if isinstance(images, int) else images.shape[1:]
    data = b"" if isinstance(images, int) else images.tobytes()
    stored = zlib.compress(data) if compressed else data
    header = {"ObjectType": "Image", "NDims": 4, "AnatomicalOrientation": "RAI", "BinaryData": True}
    header |= {"BinaryDataByteOrderMSB": False, "CenterOfRotation": "0 0 0", "CompressedData": compressed}
    header |= {"CompressedDataSize": len(stored)} if compressed else {}
    header |= {"DimSize": f"{width} {height} 1 {count}", "ElementNumberOfChannels": channels}
    header |= {"ElementSpacing": "1 1 1 1", "ElementType": "MET_UCHAR", "Kinds": "domain domain domain list"}
    header |= {"UltrasoundImageOrientation": "MFA", "UltrasoundImageType": "RGB_COLOR"}
    lines = [f"{name} = {value}" for name, value in [*header.items(), *fields]]
    lines.append(f"ElementDataFile = {beside or 'LOCAL'}")
    text = ("\n".join(lines) + "\n").encode()
    path.write_bytes(text if beside else text + stored)
    if beside:
        (path.parent / beside).write_bytes(stored)
    return path


def write_nrrd(
    path: Path, fields: list[tuple[str, str]], images: np.ndarray, compressed: bool = False, beside: str | None = None
) -> Path:
    """The same as NRRD."""
    count, height, width, channels = images.shape
    vector = channels > 1
    data = gzip.compress(images.tobytes(), mtime=0) if compressed else images.tobytes()
    lines = ["NRRD0004", "# Complete NRRD file format specification at:", "type: unsigned char"]
    lines.append(f"dimension: {5 if vector else 4}")
    lines.append(f"sizes: {f'{channels} ' if vector else ''}{width} {height} 1 {count}")
    lines.append(f"kinds: {'vector ' if vector else ''}domain domain domain list")
    lines += ["endian: little", f"encoding: {'gzip' if compressed else 'raw'}", "space: right-anterior-superior"]
    lines += [f"{name}:={value}" for name, value in fields]
    lines += [f"data file: {beside}"] if beside else []
    text = ("\n".join(lines) + "\n\n").encode()
    path.write_bytes(text if beside else text + data)
    if beside:
        (path.parent / beside).write_bytes(data)
    return path
