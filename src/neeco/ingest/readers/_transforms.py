"""Transforms of a bag (tf) chained from any frame to any other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.documents import printable
from neeco.errors import NeecoError
from neeco.ingest.readers import Table
from neeco.ingest.readers._bagsurvey import Survey
from neeco.ingest.readers.columns import BASE, PoseColumns
from neeco.ingest.readers.frame_names import meaning_of, of_dvrk
from neeco.ingest.readers.interpolate import poses_at
from neeco.ingest.readers.logs import NORM_TOLERANCE, read_pose_log

CHAIN_HEADER = ("t_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")


def chained(survey: Survey, stream: str, images: set[str]) -> Table:
    """Poses of `tf:CHILD in FRAME`, at the times of the child's nearest transform that moves. images: frames of the
    bag's images."""
    child, word, frame = stream.removeprefix("tf:").partition(" in ")
    where = f"{survey.path}: {stream}"
    known = {name.removeprefix("tf:") for name in survey.poses if name.startswith("tf:")}
    parents = {parent for name in known for parent in survey.poses[f"tf:{name}"].frames}
    for name, there in ((child, known | parents if word else known), (frame, known | parents)):
        if name not in there and (word or name is child):
            listed = printable(", ".join(sorted(there)), 300).strip("'")
            remedy = f"name one of {listed}" if there else "the bag has no tf; name a topic"
            raise NeecoError(f"{where}: there is no transform of {printable(name)}; {remedy}")
    ups, downs = _path(survey, where, child, frame)
    moving = [edge for edge in (*ups, *downs) if not survey.poses[f"tf:{edge}"].static]
    if not moving:
        raise NeecoError(f"{where}: does not move: all transforms between are static; name another frame")
    clock = survey.poses[f"tf:{moving[0]}"]
    seconds = np.unique(survey.seconds(clock.stamps, clock.received))
    frame_from_child = np.linalg.inv(_composed(survey, downs, seconds))
    frame_from_child = frame_from_child @ _composed(survey, ups, seconds)
    known_rows = np.isfinite(frame_from_child).all(axis=(1, 2))
    quats = np.full((len(seconds), 4), np.nan)
    quats[known_rows] = Rotation.from_matrix(frame_from_child[known_rows, :3, :3]).as_quat()
    rows = np.column_stack([seconds, frame_from_child[:, :3, 3], quats])
    return Table(
        survey.path, CHAIN_HEADER, rows, np.arange(1, len(rows) + 1), stream=stream, record="message",
        stated_in=frame, meaning=meaning_of(frame, images, dvrk=of_dvrk(child)),
    )  # fmt: skip


def fixed_transform(survey: Survey, child: str, frame: str) -> np.ndarray | None:
    """[4, 4] mm frame_from_child where static transforms join the two; None elsewhere."""
    try:
        ups, downs = _path(survey, str(survey.path), child, frame)
    except NeecoError:
        return None
    if not all(survey.poses[f"tf:{edge}"].static for edge in (*ups, *downs)):
        return None
    once = np.zeros(1)
    return np.asarray((np.linalg.inv(_composed(survey, downs, once)) @ _composed(survey, ups, once))[0])


def _path(survey: Survey, where: str, child: str, frame: str) -> tuple[list[str], list[str]]:
    """The transforms from a child and from a frame up to what both hang from, each by its child. Raises NeecoError."""
    ups, downs = (_to_root(survey, where, name) for name in (child, frame))
    while ups and downs and ups[-1] == downs[-1]:
        ups.pop()
        downs.pop()
    ends = [_parent(survey, where, edges[-1]) if edges else name for edges, name in ((ups, child), (downs, frame))]
    if ends[0] != ends[1]:
        raise NeecoError(f"{where}: nothing joins {child} to {frame}; they hang from {ends[0]} and {ends[1]}")
    return ups, downs


def _composed(survey: Survey, edges: Sequence[str], seconds: np.ndarray) -> np.ndarray:
    """[N, 4, 4] mm: pose of the first edge's child in the last one's parent; NaN where any is not known."""
    total = np.tile(np.eye(4), (len(seconds), 1, 1))
    for edge in edges:
        log = survey.poses[f"tf:{edge}"]
        if log.static:
            values, pose = log.table()[-1], np.eye(4)
            if not (np.isfinite(values).all() and abs(np.linalg.norm(values[3:]) - 1) < NORM_TOLERANCE):
                raise NeecoError(f"{survey.path}: tf:{edge}: is no rotation and translation; record it anew")
            pose[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
            pose[:3, 3] = 1000 * values[:3]
            poses = np.tile(pose, (len(seconds), 1, 1))
        else:
            # as it stands, whatever its parent's axes: those of the last frame alone matter
            log_of_edge = read_pose_log(PoseColumns(survey.path, stream=f"tf:{edge}", frame=BASE))
            poses, _ = poses_at(log_of_edge, seconds, 0.0)
        total = poses @ total
    return total


def _parent(survey: Survey, where: str, child: str) -> str:
    frames = survey.poses[f"tf:{child}"].frames
    if len(frames) > 1:
        raise NeecoError(f"{where}: {child} hangs from several frames ({', '.join(sorted(frames)[:4])}); name another")
    return next(iter(frames))


def _to_root(survey: Survey, where: str, name: str) -> list[str]:
    """The transforms from a frame up, each by its child."""
    edges: list[str] = []
    while f"tf:{name}" in survey.poses:
        if name in edges:
            raise NeecoError(f"{where}: the transforms go round in a circle at {name}; record them anew")
        edges.append(name)
        name = _parent(survey, where, name)
    return edges
