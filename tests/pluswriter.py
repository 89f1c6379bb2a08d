"""Writes sequences in the layouts of the PLUS toolkit: MetaImage and NRRD."""

from __future__ import annotations

import shutil
import tempfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

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


def write_sequence(
    path: Path,
    fields: Fields,
    shape: Shape,
    images: Iterable[np.ndarray] = (),
    compressed: bool = False,
    beside: str | None = None,
) -> Path:
    """A sequence of images uint8 [H, W, C], as NRRD or MetaImage by its name; beside: the file for the images, else
    they follow the header."""
    count, height, width, channels = shape
    is_nrrd, vector = path.suffix in (".nrrd", ".nhdr"), channels > 1
    packer = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS | (16 if is_nrrd else 0)) if compressed else None
    with tempfile.TemporaryFile(dir=path.parent) as data:
        for image in images:
            content = np.ascontiguousarray(image).tobytes()
            data.write(content if packer is None else packer.compress(content))
        data.write(b"" if packer is None else packer.flush())
        if is_nrrd:
            lines = ["NRRD0004", "# Complete NRRD file format specification at:", "type: unsigned char"]
            lines.append(f"dimension: {5 if vector else 4}")
            lines.append(f"sizes: {f'{channels} ' if vector else ''}{width} {height} 1 {count}")
            lines.append(f"kinds: {'vector ' if vector else ''}domain domain domain list")
            lines += [
                "endian: little",
                f"encoding: {'gzip' if compressed else 'raw'}",
                "space: right-anterior-superior",
            ]
            lines += [f"{name}:={value}" for name, value in fields]
            lines += [f"data file: {beside}"] * bool(beside) + [""]
        else:
            header = {"ObjectType": "Image", "NDims": 4, "AnatomicalOrientation": "RAI", "BinaryData": True}
            header |= {"BinaryDataByteOrderMSB": False, "CenterOfRotation": "0 0 0", "CompressedData": compressed}
            header |= {"CompressedDataSize": data.tell()} if compressed else {}
            header |= {"DimSize": f"{width} {height} 1 {count}", "ElementNumberOfChannels": channels}
            header |= {"ElementSpacing": "1 1 1 1", "ElementType": "MET_UCHAR", "Kinds": "domain domain domain list"}
            header |= {"UltrasoundImageOrientation": "MFA", "UltrasoundImageType": "RGB_COLOR"}
            lines = [f"{name} = {value}" for name, value in [*header.items(), *fields]]
            lines.append(f"ElementDataFile = {beside or 'LOCAL'}")
        path.write_text("\n".join(lines) + "\n")
        data.seek(0)
        with path.open("ab") if beside is None else (path.parent / beside).open("wb") as file:
            shutil.copyfileobj(data, file)
    return path
