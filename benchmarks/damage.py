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

from neeco.base.files import parse_yaml

SCRIPT = "<script>alert(1)</script>"
DELETE = object()
LARGE = 20 * 2**30  # bytes of a file that takes no room on the disk
NUMBERS = (-1, 0, 0.5, 1e-300, 1e300, 2**63, 10**400, float("nan"), float("inf"))
TEXTS = ("", "..", "../outside/secret.png", "/etc/passwd", "a\0b", "a\nb", "\x1b[31mred", SCRIPT, "\ud800", "x" * 5000)
CONTAINERS: tuple[Any, ...] = ([], {}, [[]], [None] * 4, [[0.0] * 4] * 4, {"name": 3}, [0] * 20_000)
CELLS = ("", "nan", "inf", "1e400", "-1", "x", "1,5", '"', "\0", "9" * 400, "\x1b[31m")
NAMES = ("<b>bold</b>.png", "[red]x.png", "\x1b[31mred.png", "a\nb.png", "-rf.png")


def nested(levels: int) -> Any:
    value: Any = 1
    for level in range(levels):
        value = [value] if level % 2 else {"a": value}
    return value


def a_value(pick: random.Random) -> Any:
    pool = pick.choice((NUMBERS, TEXTS, CONTAINERS, (None, True, DELETE, DELETE, nested(60))))
    value = pick.choice(pool)
    return value if value is DELETE else copy.deepcopy(value)


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
    way, document = pick.random(), json.loads(path.read_text())
    if way < 0.03:
        path.write_text(pick.choice(("[" * 100_000, "9" * 10_000, "", "\ufeff{}", "null", "[]", '"x"')))
    elif way < 0.08 and isinstance(document, dict) and document:  # a key given twice
        key = pick.choice(list(document))
        path.write_text("{" + f"{json.dumps(key)}: null, " + json.dumps(document)[1:])
    elif way < 0.12 and path.name == "transforms.json":  # a capture that is another one since training
        path.write_text(re.sub(r'"(fl_[xy])": [\d.]+', r'"\1": 60', json.dumps(document)))
    else:
        path.write_text(json.dumps(edit(document, pick)))


def edit_lines(path: Path, pick: random.Random) -> None:
    """JSON lines."""
    lines = path.read_text().splitlines()
    row, way = pick.randrange(len(lines)), pick.random()
    if way < 0.7:
        lines[row] = json.dumps(edit(json.loads(lines[row]), pick))
    elif way < 0.85:
        lines[row] = lines[row][: pick.randrange(len(lines[row]))]
    else:
        lines[row] = pick.choice(("[" * 50_000, "null", "{}", "\x1b[31m", "\0"))
    path.write_text("\n".join(lines) + pick.choice(("", "\n")), encoding="utf-8", errors="surrogatepass")


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{','.join(['*' + chr(97 + k)] * 9)}]\n" for k in range(12)
)
YAML_TEXTS = (BOMB, "[" * 5000, "!!python/object/apply:os.system ['touch pwned']", "&a [*a]", "@", "", "- 1")
YAML_VALUES = ("2020-13-45", "!!set {a}", "*nothing", "0x10", "~", "!!float x", "&x [*x]")


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
    else:
        document = edit(parse_yaml(path, text, "as it was"), pick)  # which stops at an earlier edit's aliases
        path.write_text(yaml.safe_dump(document), encoding="utf-8", errors="surrogatepass")


def edit_tensors(path: Path, pick: random.Random) -> None:
    """A safetensors file: its length, its header, the JSON of ours in its header, or its numbers."""
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    header, body, way = json.loads(content[8 : 8 + length]), content[8 + length :], pick.random()
    entry = header[pick.choice([name for name in header if name != "__metadata__"])]
    if way < 0.35:
        header["__metadata__"]["neeco"] = json.dumps(edit(json.loads(header["__metadata__"]["neeco"]), pick))
    elif way < 0.5:
        header = edit(header, pick)
    elif way < 0.65:
        field, values = pick.choice(
            (
                ("shape", ([], [0], [1], [2**40, 2**40], [*entry["shape"], 1], entry["shape"][::-1])),
                ("data_offsets", ([0, 2**62], [4, 0], [0, 0], [0, len(body) + 8])),
                ("dtype", ("F64", "F16", "I64", "U8", "BOOL", "X")),
            )
        )
        entry[field] = pick.choice(values)
    elif way < 0.9:
        begin, end = entry["data_offsets"]
        values = np.frombuffer(body[begin:end], np.uint8).copy()
        if len(values) >= 4 and entry["dtype"] == "F32":
            numbers = values.view("<f4")
            where = slice(None) if pick.random() < 0.4 else pick.randrange(len(numbers))
            numbers[where] = pick.choice((float("nan"), float("inf"), 1e38, -1e38, 0.0, -1.0, 1e6))
        body = body[:begin] + values.tobytes() + body[end:]
    else:
        path.write_bytes(struct.pack("<Q", pick.choice((2**63, 2**40, 0, length - 1, length + 8))) + content[8:])
        return
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(struct.pack("<Q", len(text)) + text + body)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def edit_image(path: Path, pick: random.Random) -> None:
    match pick.randrange(6):
        case 0:  # a header that promises more than there is
            size = pick.choice(((60_000, 60_000), (0, 0), (2**31 - 1, 1), (48, 40)))
            header = chunk(b"IHDR", struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0))
            data = chunk(b"IDAT", zlib.compress(bytes(20_000))) + chunk(b"IEND", b"")
            path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + data)
        case 1:
            mode = pick.choice(("L", "1", "RGBA", "P", "I;16"))
            Image.new(mode, pick.choice((Image.open(path).size, (1, 1), (3, 500)))).save(path, format="PNG")
        case 2:
            Image.open(path).convert("RGB").save(path, format=pick.choice(("GIF", "BMP", "TIFF", "WEBP")))
        case 3:
            text, content = zlib.compress(b"x" * 200_000_000, 9), path.read_bytes()
            path.write_bytes(content[:33] + chunk(b"zTXt", b"bomb\0\0" + text) + content[33:])
        case 4:
            Image.new("L", Image.open(path).size, pick.choice((0, 1, 5, 77, 255))).save(path, format="PNG")
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
    """CSV: cells, a column, the header, rows."""
    rows = [line.split(",") for line in path.read_text(errors="replace").splitlines()]
    match pick.randrange(6):
        case 0:
            for _ in range(pick.choice((1, 5, 60))):
                row = pick.choice(rows)
                row[pick.randrange(len(row))] = pick.choice(CELLS)
        case 1:
            column = pick.randrange(len(rows[0]))
            rows = [row[:column] + row[column + 1 :] for row in rows]
        case 2:
            rows[0][pick.randrange(len(rows[0]))] = pick.choice([*CELLS, "t", "t_ns", "x_m", "qx"])
        case 3:
            rows = rows[: pick.randrange(len(rows) + 1)]
        case 4:  # time begins anew: two runs in one file, or a counter that wraps
            rows += rows[1:]
        case _:
            half = len(rows) // 2
            rows[1:] = rows[half:] + rows[1:half]
    path.write_text("\n".join(",".join(row) for row in rows) + "\n", encoding="utf-8", errors="surrogatepass")


EDITORS: dict[str, Callable[[Path, random.Random], None]] = {
    ".json": edit_json, ".jsonl": edit_lines, ".yaml": edit_yaml, ".safetensors": edit_tensors, ".png": edit_image,
    ".csv": edit_table,
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
