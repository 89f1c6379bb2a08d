"""Sparse points: read and written as PLY, and random ones where a capture has none."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes, write_atomically
from neeco.geometry.lines import across_projectors, nearest_point

MAX_SAMPLED_POINTS = 500
UNKNOWN_DISTANCE_MM = 100.0  # assumed distance of the scene for a single, still camera
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


@dataclass(frozen=True)
class PointCloud:
    """Sparse coloured points in the world frame. Arrays of other types become float32, no colours become grey.

    Raises NeecoError when the positions are not [P, 3], or the colours not of their shape.
    """

    positions: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # [P, 3] float32, mm
    colors: np.ndarray = None  # type: ignore[assignment]  # [P, 3] float32 in [0, 1]
    measured: bool = True  # False: random points, because the capture has none

    def __post_init__(self) -> None:
        positions = np.asarray(self.positions, np.float32)
        colors = np.full_like(positions, 0.5) if self.colors is None else np.asarray(self.colors, np.float32)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise NeecoError(f"PointCloud.positions: expected shape [P, 3], found {list(positions.shape)}")
        if colors.shape != positions.shape:
            raise NeecoError(f"PointCloud.colors: expected shape {list(positions.shape)}, found {list(colors.shape)}")
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "colors", colors)

    def __repr__(self) -> str:
        return f"PointCloud({len(self.positions)} points, measured={self.measured})"


def sampled(positions: np.ndarray) -> np.ndarray:
    """Return MAX_SAMPLED_POINTS to twice as many of positions [P, 3], evenly spaced in their order; all of fewer."""
    return positions[:: max(1, len(positions) // MAX_SAMPLED_POINTS)]


def measured_sample(cloud: PointCloud | None) -> np.ndarray:
    """Return some of the measured points, [P, 3] float64 mm; none where there are none."""
    if cloud is None or not cloud.measured:
        return np.zeros((0, 3))
    return sampled(cloud.positions).astype(np.float64)


def read_ply(path: Path) -> PointCloud:
    """Read a PLY file's vertices: x y z and, where present, red green blue (grey otherwise). Other data is ignored.

    Positions may hold NaN. Raises NeecoError when the file is missing, damaged or has no usable vertices.
    """
    path = Path(path)
    encoding, count, properties, body = _parse_header(path, read_bytes(path, "a point cloud as PLY"))
    short = NeecoError(f"{path}: holds fewer than the {count} vertices its header promises; it is truncated")
    if encoding == "ascii":
        # every value needs a digit and a separator, so this bounds what a wrong header can make us allocate
        words = body.split() if count * len(properties) <= len(body) else []
        if len(words) < count * len(properties):
            raise short
        try:
            table = np.array(words[: count * len(properties)], dtype=np.float64).reshape(count, len(properties))
        except ValueError:
            raise NeecoError(f"{path}: a vertex value is not a number; repair the file") from None
        with np.errstate(all="ignore"):
            vertices = {name: table[:, column].astype(kind) for column, (name, kind) in enumerate(properties)}
    else:
        dtype = np.dtype([(name, _ORDERS[encoding] + kind) for name, kind in properties])
        if len(body) < count * dtype.itemsize:
            raise short
        rows = np.frombuffer(body, dtype=dtype, count=count)
        vertices = {name: rows[name] for name, _ in properties}
    if not {"x", "y", "z"} <= vertices.keys():
        raise NeecoError(f"{path}: vertex: has no x, y, z; write a point cloud with positions")
    positions = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float32)
    for names in _COLORS:
        if set(names) <= vertices.keys():
            channels = np.stack([vertices[name] for name in names], axis=1)
            if channels.dtype.kind == "u":
                return PointCloud(positions, (channels / np.iinfo(channels.dtype).max).astype(np.float32))
            return PointCloud(positions, np.clip(np.nan_to_num(channels), 0, 1).astype(np.float32))
    return PointCloud(positions)


def write_ply(path: Path, points: PointCloud) -> None:
    """Write points as binary PLY, xyz float32 and rgb 8 bit, atomically. Raises NeecoError."""
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.empty(len(points.positions), dtype=fields)
    for column, axis in enumerate("xyz"):
        vertices[axis] = points.positions[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        vertices[name] = np.clip(np.rint(points.colors[:, column] * 255), 0, 255)
    write_atomically(Path(path), lambda temporary: temporary.write_bytes(encoded_ply(vertices)))


def encoded_ply(vertices: np.ndarray) -> bytes:
    """Return the content of a binary PLY of a structured array of float32 and uint8, little-endian."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind, *_ in vertices.dtype.descr]
    return "\n".join([*header, "end_header", ""]).encode("ascii") + vertices.tobytes()


def random_points(center: np.ndarray, half_size: float, count: int = 20_000, seed: int = 0) -> PointCloud:
    """Grey points spread evenly in a cube, as 3DGS starts where SfM gave nothing. center [3]. Seeded."""
    generator = np.random.default_rng(seed)
    positions = np.asarray(center) + generator.uniform(-half_size, half_size, (count, 3))
    return PointCloud(positions.astype(np.float32), measured=False)


def points_in_view(poses: np.ndarray) -> PointCloud:
    """Return random points in the cameras' common view, world_from_camera [F, 4, 4], for captures without points.

    A cube around the point nearest to all optical axes, as wide as its distance from the cameras. If the axes do not
    intersect in front of the cameras (a scope rotating about its trocar), the distance is unknown.
    """
    centers, axes = poses[:, :3, 3], poses[:, :3, 2]
    meeting = centers.mean(axis=0) + UNKNOWN_DISTANCE_MM * axes.mean(axis=0)
    if np.linalg.eigvalsh(across_projectors(axes).sum(axis=0))[0] >= 1e-3 * len(poses):  # else the axes are parallel
        nearest = nearest_point(centers, axes)
        if np.median(((nearest - centers) * axes).sum(axis=1)) > 0:
            meeting = nearest
    distance = float(np.median(np.linalg.norm(centers - meeting, axis=1)))
    return random_points(meeting, 0.5 * max(distance, 1e-3))


def _parse_header(path: Path, content: bytes) -> tuple[str, int, list[tuple[str, str]], bytes]:
    """The encoding, number of vertices, (name, type) of each vertex property, and what follows the header."""
    end = content.find(b"end_header")
    line_end = content.find(b"\n", end)
    if not content.startswith(b"ply") or end < 0 or line_end < 0:
        raise NeecoError(f"{path}: not a PLY file (no complete header)")
    encoding, count, element, properties = "", -1, "", []
    for line in content[:end].decode("ascii", errors="replace").splitlines():
        match line.split():
            case ["format", name, *_]:
                encoding = name
            case ["element", name, number] if number.isdecimal() and len(number) < 12:
                if name != "vertex" and count < 0 and int(number) > 0:
                    raise NeecoError(f"{path}: element {name!r} before the vertices; write the vertices first")
                element, count = name, int(number) if name == "vertex" else count
            case ["property", kind, name] if element == "vertex" and kind in _TYPES:
                properties.append((name, _TYPES[kind]))
            case ["property", *_] if element == "vertex":
                raise NeecoError(f"{path}: vertex property {line.strip()!r} is not understood; write plain numbers")
    if encoding not in _ORDERS:
        raise NeecoError(f"{path}: format {encoding!r} is not understood; write ascii or binary_little_endian")
    if count < 0:
        raise NeecoError(f"{path}: has no vertices; expected a point cloud")
    if len({name for name, _ in properties}) != len(properties):
        raise NeecoError(f"{path}: two vertex properties have one name; write each once")
    return encoding, count, properties, content[line_end + 1 :]
