"""Ways to damage files: values, texts, bytes, and the file as such. Each edits in place, all alike for one seed."""

from __future__ import annotations

import copy
import json
import os
import random
import re
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from neeco.files import parse_yaml

SCRIPT = "<script>alert(1)</script>"
DELETE = object()
LARGE = 20 * 2**30  # bytes of a file that takes no room on the disk
NUMBERS = [-1, 0, 1, 0.5, -0.0, 1e-300, 1e300, -1e308, 2**31, 2**63, 10**12, 10**400, float("nan"), float("inf")]
TEXTS = [
    "",
    " ",
    "x",
    "..",
    "../..",
    "../outside/secret.png",
    "../outside/secret.txt",
    "/etc/passwd",
    "a\0b",
    "a\nb",
    "\x1b[31mred\x1b[0m",
    "\r\x1b[2K",
    SCRIPT,
    "[bold]x[/bold]",
    "[/]",
    "{{7*7}}",
    "%s%n",
    "\ud800",
    "é\u202e",
    "x" * 5000,
    "1",
    "nan",
    "cuda",
    "train",
    "images/000001.png",
    ".",
]
CONTAINERS: list[Any] = [
    [],
    {},
    [[]],
    [None] * 4,
    [[0.0] * 4] * 4,
    {"name": 3},
    [1, 2],
    {"\x1b[31m\n": 1},
    [0] * 20_000,
]
CELLS = [
    "",
    "nan",
    "inf",
    "-inf",
    "1e300",
    "1e400",
    "1e19",
    "0",
    "-1",
    "x",
    "1,5",
    '"',
    "é",
    "\0",
    "9" * 400,
    "\x1b[31m",
]
NAMES = ["<b>bold</b>.png", "[red]x.png", "\x1b[31mred.png", "a\nb.png", "-rf.png", "é\u202e.png", "%s.png"]


def nested(levels: int) -> Any:
    value: Any = 1
    for level in range(levels):
        value = [value] if level % 2 else {"a": value}
    return value


def a_value(pick: random.Random) -> Any:
    pool = pick.choice((NUMBERS, TEXTS, CONTAINERS, [None, True, False, DELETE, DELETE, nested(60)]))
    return copy.deepcopy(pick.choice(pool)) if pool[-1:] != [DELETE] else pick.choice(pool)


def places(value: Any, path: tuple[Any, ...] = (), limit: int = 4000) -> Iterator[tuple[Any, ...]]:
    """The path of values inside a document."""
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in children:
        yield (*path, key)
        if limit > 0:
            yield from places(child, (*path, key), limit - 1)


def edit(document: Any, pick: random.Random) -> Any:
    """The document with one value deleted, replaced, doubled, renamed or swapped; or another document."""
    if pick.random() < 0.03:
        return a_value(pick) if pick.random() < 0.5 else nested(pick.choice((5, 400)))
    found = list(places(document))
    if not found:
        return a_value(pick)
    shallow = [path for path in found if len(path) <= 3]
    path = pick.choice(shallow if pick.random() < 0.6 else found)
    parent = document
    for key in path[:-1]:
        parent = parent[key]
    key, way = path[-1], pick.random()
    if way < 0.65:
        value = a_value(pick)
        if value is DELETE:
            del parent[key]
        else:
            parent[key] = value
    elif way < 0.8 and isinstance(parent, list):
        parent.insert(pick.randrange(len(parent) + 1), copy.deepcopy(parent[key]))
    elif way < 0.9 and isinstance(parent, dict):
        parent[pick.choice([*TEXTS, *map(str, parent)])] = parent.pop(key)
    else:
        other = pick.choice(found)
        value = document
        for step in other:
            value = value[step]
        parent[key] = copy.deepcopy(value)
    return document


def edit_json(path: Path, pick: random.Random) -> None:
    raw = pick.random()
    if raw < 0.03:
        deep = ("[" * 100_000, '{"a":' * 100_000, "9" * 10_000, '{"frames": [' + "{}," * 50_000)
        text = pick.choice((*deep, "", "\ufeff{}", "null", "3", "[]", "true", '"x"'))
        path.write_text(text)
        return
    document = json.loads(path.read_text())
    if raw < 0.08 and isinstance(document, dict) and document:  # a key given twice
        key = pick.choice(list(document))
        value = json.dumps(pick.choice((document[key], None, 3, [], {})))
        path.write_text("{" + f"{json.dumps(key)}: {value}, " + json.dumps(document)[1:])
    elif raw < 0.12 and path.name == "transforms.json":  # a capture that is another one since training
        other = pick.choice((20, 60, 200))
        path.write_text(re.sub(r'"(fl_[xy])": [\d.]+', rf'"\1": {other}', json.dumps(document)))
    else:
        path.write_text(json.dumps(edit(document, pick)))


def edit_lines(path: Path, pick: random.Random) -> None:
    """JSON lines."""
    lines = path.read_text().splitlines()
    row = pick.randrange(len(lines))
    way = pick.random()
    if way < 0.7:
        lines[row] = json.dumps(edit(json.loads(lines[row]), pick))
    elif way < 0.8:
        lines[row] = lines[row][: pick.randrange(len(lines[row]))]
    elif way < 0.9:
        lines[row] = pick.choice(("[" * 50_000, "null", "{}", "9" * 10_000, "\x1b[31m", "\0"))
    else:
        lines.insert(row, lines[row])
    path.write_text("\n".join(lines) + pick.choice(("", "\n", "\n\n")), encoding="utf-8", errors="surrogatepass")


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{','.join(['*' + chr(97 + k)] * 9)}]\n" for k in range(12)
)
YAML_TEXTS = [
    BOMB,
    "[" * 5000,
    "a: " * 3000,
    "!!python/object/apply:os.system ['touch pwned']",
    "&a [*a]",
    "*a",
    "@",
    "",
    "- 1\n- 2",
    "a: 1\na: 2\n",
    "2020-13-45",
    "? [1, 2]\n: 3",
    "%YAML 9.9\n---\na",
    "\t",
    "!!binary x",
    "!!timestamp x",
    "<<: 3",
    "\x07",
]
YAML_VALUES = [
    "2020-13-45",
    "!!set {a}",
    "*nothing",
    "{? [a] : b}",
    "0x10",
    "1_000",
    "12:30:45",
    "~",
    "!!float x",
    "&x [*x]",
]


def edit_yaml(path: Path, pick: random.Random) -> None:
    way, text = pick.random(), path.read_text()
    if way < 0.1:
        path.write_text(pick.choice(YAML_TEXTS))
    elif way < 0.2:
        lines = text.splitlines()
        row = pick.randrange(len(lines))
        key = lines[row].partition(":")[0]
        lines[row] = f"{key}: {pick.choice(YAML_VALUES)}"
        path.write_text("\n".join(lines) + "\n")
    elif way < 0.25:
        path.write_text(text + "\n" + pick.choice(YAML_TEXTS))
    else:
        document = edit(parse_yaml(path, text, "as it was"), pick)  # which stops at an earlier edit's aliases
        path.write_text(yaml.safe_dump(document), encoding="utf-8", errors="surrogatepass")


def edit_tensors(path: Path, pick: random.Random) -> None:
    """A safetensors file: its header, the JSON of ours in its header, or its numbers."""
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    header, body = json.loads(content[8 : 8 + length]), content[8 + length :]
    way = pick.random()
    names = [name for name in header if name != "__metadata__"]
    if way < 0.35 and "__metadata__" in header:
        header["__metadata__"]["neeco"] = json.dumps(edit(json.loads(header["__metadata__"]["neeco"]), pick))
    elif way < 0.5:
        header = edit(header, pick)
    elif way < 0.6:
        entry = header[pick.choice(names)]
        change = pick.choice(("shape", "offsets", "dtype", "huge", "flat"))
        if change == "shape":
            entry["shape"] = pick.choice(
                ([], [0], [1], [2**40, 2**40], [2**63], [*entry["shape"], 1], entry["shape"][::-1])
            )
        elif change == "offsets":
            entry["data_offsets"] = pick.choice(([0, 2**62], [4, 0], [0, 0], [-1, 3], [0, len(body) + 8]))
        elif change == "dtype":
            entry["dtype"] = pick.choice(("F64", "F16", "BF16", "I64", "U8", "BOOL", "F8_E4M3", "X"))
        elif change == "huge":
            entry |= {"shape": [2**36], "data_offsets": [0, 2**38]}
        else:
            entry["shape"] = [int(np.prod(entry["shape"], dtype=np.int64))]
    elif way < 0.85:
        name = pick.choice(names)
        tensors = read_tensors(header, body)
        body = edited_numbers(header, body, name, tensors, pick)
    elif way < 0.9:
        one, two = pick.choice(names), pick.choice(names)
        header[one], header[two] = header[two], header[one]
    else:
        path.write_bytes(
            struct.pack("<Q", pick.choice((2**63, 2**40, 0, length - 1, length + 8, 100_000_001))) + content[8:]
        )
        return
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(struct.pack("<Q", len(text)) + text + body)


KINDS = {"F32": "<f4", "F64": "<f8", "I64": "<i8", "I32": "<i4", "U8": "u1", "BOOL": "u1", "F16": "<f2"}


def read_tensors(header: dict[str, Any], body: bytes) -> dict[str, np.ndarray]:
    return {
        name: np.frombuffer(body[slice(*entry["data_offsets"])], KINDS[entry["dtype"]])
        for name, entry in header.items()
        if name != "__metadata__" and entry["dtype"] in KINDS
    }


def edited_numbers(
    header: dict[str, Any], body: bytes, name: str, tensors: dict[str, np.ndarray], pick: random.Random
) -> bytes:
    """Some numbers of one tensor are others; or the tensor has other rows than its neighbours."""
    values = tensors[name].copy()
    if not len(values):
        return body
    if pick.random() < 0.25 and header[name]["shape"]:  # fewer rows, the rest of the file as it was
        rows = header[name]["shape"][0]
        kept = pick.randrange(rows) if rows else 0
        out, at = {}, 0
        parts = []
        for other, array in tensors.items():
            entry = header[other]
            shape = [kept, *entry["shape"][1:]] if other == name else entry["shape"]
            data = array[: int(np.prod(shape, dtype=np.int64))].tobytes()
            out[other] = {"dtype": entry["dtype"], "shape": shape, "data_offsets": [at, at + len(data)]}
            at += len(data)
            parts.append(data)
        for other in out:
            header[other] = out[other]
        return b"".join(parts)
    where = slice(None) if pick.random() < 0.4 else pick.randrange(len(values))
    with np.errstate(all="ignore"):
        odd = np.array(
            pick.choice([float("nan"), float("inf"), -float("inf"), 1e38, 1e30, -1e38, 0.0, 1e-38, -1.0, 1e6, 255.0])
        )
        values[where] = odd.astype(values.dtype)
    begin, end = header[name]["data_offsets"]
    return body[:begin] + values.tobytes() + body[end:]


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, depth: int = 8, color: int = 2, data: bytes = b"") -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def edit_image(path: Path, pick: random.Random) -> None:
    match pick.randrange(8):
        case 0:
            path.write_bytes(png(60_000, 60_000))
        case 1:
            path.write_bytes(
                png(*pick.choice([(0, 0), (2**31 - 1, 1), (1, 1), (48, 40), (12_000, 12_000)]), data=bytes(20_000))
            )
        case 2:
            mode = pick.choice(("L", "1", "RGBA", "LA", "P", "I;16", "I", "F", "CMYK"))
            size = pick.choice((Image.open(path).size, (1, 1), (3, 500)))
            image = Image.new(mode, size)
            image.save(path, format="TIFF" if mode in ("F", "CMYK") else "PNG")
        case 3:
            Image.open(path).convert("RGB").save(path, format=pick.choice(("GIF", "BMP", "TIFF", "WEBP")))
        case 4:
            text = zlib.compress(b"x" * 200_000_000, 9)
            content = path.read_bytes()
            path.write_bytes(content[:33] + chunk(b"zTXt", b"bomb\0\0" + text) + content[33:])
        case 5:
            pixels = np.asarray(Image.open(path).convert("L")).copy()
            pixels[:] = pick.choice((0, 1, 5, 77, 255))
            Image.fromarray(pixels).save(path, format="PNG")
        case _:
            edit_bytes(path, pick)


def edit_bytes(path: Path, pick: random.Random) -> None:
    content = bytearray(path.read_bytes())
    match pick.randrange(6):
        case 0:
            content = content[: pick.randrange(len(content) + 1)]
        case 1:
            content = bytearray()
        case 2:
            content = bytearray(pick.randbytes(pick.randrange(3000)))
        case 3:
            begin = pick.randrange(len(content) + 1)
            content[begin : begin + 64] = bytes(64)
        case _:
            for _ in range(pick.choice((1, 1, 5, 50))):
                if content:
                    content[pick.randrange(len(content))] ^= 1 << pick.randrange(8)
    path.write_bytes(content)


def edit_table(path: Path, pick: random.Random) -> None:
    """CSV, and columns of text: a cell, a column, a row, the header; and counts of rows that are not there."""
    rows = [line.split(",") for line in path.read_text(errors="replace").splitlines()]
    match pick.randrange(9):
        case 0:
            for _ in range(pick.choice((1, 5, 60))):
                row = pick.choice(rows)
                row[pick.randrange(len(row))] = pick.choice(CELLS)
        case 1:
            column = pick.randrange(len(rows[0]))
            rows = [row[:column] + row[column + 1 :] for row in rows]
        case 2:
            rows[0][pick.randrange(len(rows[0]))] = pick.choice([*CELLS, "t", "t_ns", "x_m", "qx", "Frame", "NUMBER"])
        case 3:
            rows = rows[: pick.randrange(len(rows) + 1)]
        case 4:
            rows = [rows[0], *[[str(10**9)] * len(rows[0])], *rows[1:]]
        case 5:
            rows = [rows[0] * 3000]
        case 6:  # time begins anew: two runs in one file, or a counter that wraps
            rows += rows[1:]
        case 7:
            half = len(rows) // 2
            rows[1:] = rows[half:] + rows[1:half]
        case _:
            rows[1:] = [[cell[:-1] + "e9" if pick.random() < 0.1 else cell for cell in row] for row in rows[1:]]
    path.write_text("\n".join(",".join(row) for row in rows) + "\n", encoding="utf-8", errors="surrogatepass")


def edit_ply(path: Path, pick: random.Random) -> None:
    head, end, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    row = pick.randrange(len(lines))
    match pick.randrange(5):
        case 0:
            counts = (10**9, 10**11, 0, -1, 3, "NUMBER", "1e9")
            lines = [f"element vertex {pick.choice(counts)}" if "element" in line else line for line in lines]
        case 1:
            del lines[row]
        case 2:
            lines.insert(row, lines[row])
        case 3:
            lines[row] = pick.choice(
                ("property list uchar int x", "property float \x1b[31m", "element face 999999999", "format x")
            )
        case _:
            body = np.frombuffer(body[: len(body) // 4 * 4], "<f4").copy().tobytes()
            body = struct.pack("<f", pick.choice((float("nan"), float("inf"), 1e38))) + body[4:]
    path.write_bytes("\n".join(lines).encode() + b"\n" + end + body)


def edit_npy(path: Path, pick: random.Random) -> None:
    content = path.read_bytes()
    match pick.randrange(5):
        case 0:
            array = np.array(np.load(path, mmap_mode="r"))  # mapped: an earlier edit may have promised terabytes
            array[pick.randrange(len(array)), pick.randrange(array.shape[1])] = pick.choice(
                [*NUMBERS[:9], float("nan")]
            )
            np.save(path, array)
        case 1:
            shape = pick.choice(("(1000000000, 17)", "(10, 17, 1)", "()", "(-1, 17)", "(99999999999999, 1)"))
            head = content[:128].replace(b"(12, 17)", shape.encode()[:40])
            path.write_bytes(head[:128].ljust(128) + content[128:])
        case 2:
            path.write_bytes(content.replace(b"'<f8'", pick.choice((b"'|O' ", b"'<U9'", b"'<i8'", b"'<c8'"))))
        case 3:
            np.savez(path.with_suffix(".npz"), np.load(path, mmap_mode="r"))
            path.with_suffix(".npz").rename(path)
        case _:
            edit_bytes(path, pick)


EDITORS: dict[str, Callable[[Path, random.Random], None]] = {
    ".json": edit_json, ".jsonl": edit_lines, ".yaml": edit_yaml, ".safetensors": edit_tensors, ".png": edit_image,
    ".jpg": edit_image, ".csv": edit_table, ".ply": edit_ply, ".npy": edit_npy, ".txt": edit_table,
}  # fmt: skip


def edit_file(path: Path, others: Sequence[Path], outside: Path, pick: random.Random) -> None:
    """The file as such: absent, a folder, a pipe, a link, huge, another one's content, another name."""
    match pick.randrange(11):
        case 0:
            path.unlink()
        case 1:
            path.unlink()
            path.mkdir()
        case 2:
            path.unlink()
            os.mkfifo(path)
        case 3:
            path.unlink()
            path.symlink_to(path.name)
        case 4:
            path.unlink()
            path.symlink_to(pick.choice(("/dev/zero", "/dev/null", "/etc/passwd", "/", "nothing")))
        case 5 | 6:
            other = pick.choice(others)
            shutil.copy(other, path)
        case 7:
            link = outside / f"secret{path.suffix}"
            path.unlink()
            path.symlink_to(link if link.exists() else outside / "secret.txt")
        case 8:  # a link within the folder, which many make to save room
            path.rename(kept := path.with_name(f"kept{path.suffix}"))
            path.symlink_to(kept.name)
        case 9:
            os.truncate(path, pick.choice((LARGE, 3 * 2**30)))
        case _:
            path.rename(path.with_name(pick.choice(NAMES)))
