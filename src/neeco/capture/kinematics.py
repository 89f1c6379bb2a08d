"""Kinematic trees: the links of an instrument, their joints, and their poses at a state's readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neeco.base.errors import NeecoError
from neeco.geometry.rotations import rigid, rigid_fault, rotation_from_vector

FIXED, REVOLUTE, PRISMATIC = "fixed", "revolute", "prismatic"
JOINT_TYPES = (FIXED, REVOLUTE, PRISMATIC)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid link, and the joint that connects it to its parent.

    `origin` [4, 4] is parent_from_link, mm, at a joint value of 0; `axis` [3] unit, in the parent's frame. The joint
    rotates the link about the axis through the origin (revolute, rad) or slides it along (prismatic, mm) by its value:
    the sum of readings, each times its gain, plus `offset`. `body`: a visible part of the instrument moves with the
    link; otherwise it is a frame only, such as the point that a robot reports.
    """

    name: str
    parent: str | None = None  # None: the tree's root
    type: str = FIXED
    origin: Array = field(default_factory=lambda: np.eye(4))
    axis: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    value: Mapping[str, float] = field(default_factory=dict)  # gain of every reading that drives the joint
    _: KW_ONLY
    offset: float = 0.0  # rad or mm
    limits: tuple[float, float] | None = None  # of the value
    body: bool = True

    def joint_value(self, readings: Mapping[str, float]) -> float:
        """rad, or mm where the joint slides, at a state's readings. Raises KeyError for a reading that is missing."""
        return sum((gain * readings[name] for name, gain in self.value.items()), self.offset)

    def parent_from_link(self, readings: Mapping[str, float]) -> Array:
        """[4, 4] mm at a state's readings."""
        if self.type == FIXED:
            return self.origin
        motion = self.joint_value(readings) * self.axis
        if self.type == PRISMATIC:
            return rigid(np.eye(3), motion) @ self.origin
        turn = rotation_from_vector(torch.from_numpy(motion)).numpy()
        return rigid(turn, self.origin[:3, 3] - turn @ self.origin[:3, 3]) @ self.origin


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """Links from the root on. A recorded pose is that of the link `pose_of` (None: the root).

    Raises NeecoError where the links are no tree.
    """

    links: tuple[Link, ...]
    pose_of: str | None = None

    def __post_init__(self) -> None:
        links = self.links
        names = [link.name for link in links]
        if not links:
            raise NeecoError("there are no links; give at least the root")
        if twice := [name for name in names if names.count(name) > 1]:
            raise NeecoError(f"{twice[0]!r} is defined twice; give every link a unique name")
        roots = [link for link in links if link.parent is None]
        if len(roots) != 1:
            root_names = ", ".join(repr(link.name) for link in roots) or "none"
            raise NeecoError(f"one link has no parent, the root; found {root_names}")
        for link in links:
            if link.parent is not None and link.parent not in names:
                raise NeecoError(
                    f"{link.name!r}: its parent {link.parent!r} is no link; name one of {', '.join(names)}"
                )
            if link.type == FIXED and link.value:
                raise NeecoError(f"{link.name!r}: readings drive a fixed joint; make it revolute or prismatic")
            if link.parent is None and link.type != FIXED:
                raise NeecoError(f"{link.name!r}: the root has no parent to move against; leave its type out")
            if (fault := rigid_fault(link.origin)) is not None:
                raise NeecoError(f"{link.name!r}: origin: {fault[0]}; {fault[1]}")
        ordered = list(roots)
        for link in ordered:  # grows as it is gone through
            ordered += [child for child in links if child.parent == link.name]
        if len(ordered) < len(links):
            circle = sorted(set(names) - {link.name for link in ordered})
            raise NeecoError(f"the links form a cycle: {', '.join(map(repr, circle))}; connect every link to the root")
        object.__setattr__(self, "links", tuple(ordered))  # the root first
        if self.pose_of is not None and self.pose_of not in self._index:
            raise NeecoError(f"pose_of: there is no link {self.pose_of!r}; name one of {', '.join(self._index)}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, KinematicTree) and self.to_json() == other.to_json()

    def __hash__(self) -> int:
        return hash((self.pose_of, *(link.name for link in self.links)))

    @cached_property
    def _index(self) -> dict[str, int]:
        return {link.name: index for index, link in enumerate(self.links)}

    @property
    def readings(self) -> tuple[str, ...]:
        """Names of all readings that drive a joint, in the order of the links, alphabetically within a joint."""
        return tuple(dict.fromkeys(name for link in self.links for name in sorted(link.value)))

    @property
    def bodies(self) -> tuple[Link, ...]:
        """Links with a visible body, parents first."""
        return tuple(link for link in self.links if link.body)

    @property
    def joints(self) -> tuple[Link, ...]:
        """Links with a moving joint, outermost first: the order in which joints move the links at rest."""
        return tuple(link for link in reversed(self.links) if link.type != FIXED)

    def poses(self, readings: Mapping[str, float]) -> dict[str, Array]:
        """root_from_link [4, 4] mm of every link (forward kinematics). Raises KeyError for a reading that is
        missing."""
        poses: dict[str, Array] = {}
        for link in self.links:
            parent_from_link = link.parent_from_link(readings)
            poses[link.name] = parent_from_link if link.parent is None else poses[link.parent] @ parent_from_link
        return poses

    def readings_of(self, name: str) -> set[str]:
        """Readings that move a link against the root."""
        chain = [self.links[self._index[name]]]
        while (parent := chain[-1].parent) is not None:
            chain.append(self.links[self._index[parent]])
        return {reading for link in chain for reading in link.value}

    def root_from_recorded(self, readings: Mapping[str, float]) -> Array:
        """[4, 4] mm of the link `pose_of`, whose pose is recorded. Raises KeyError without a reading that moves it."""
        if self.pose_of is None:
            return np.eye(4)
        relevant = {name: readings[name] for name in self.readings_of(self.pose_of)}
        return self.poses(dict.fromkeys(self.readings, 0.0) | relevant)[self.pose_of]

    def world_from_root(self, pose: Array, readings: Mapping[str, float]) -> Array:
        """[4, 4] mm from the recorded pose of the link `pose_of`. Raises KeyError without a reading that moves it."""
        return pose if self.pose_of is None else pose @ np.linalg.inv(self.root_from_recorded(readings))

    @cached_property
    def rest_poses(self) -> dict[str, Array]:
        """root_from_link [4, 4] mm of every link where the values of all joints are 0."""
        poses: dict[str, Array] = {}
        for link in self.links:
            poses[link.name] = link.origin if link.parent is None else poses[link.parent] @ link.origin
        return poses

    @cached_property
    def axes_at_rest(self) -> tuple[Array, Array]:
        """(points [J, 3] mm, unit directions [J, 3]) of the axes of `joints` in the root's frame, where the values of
        all joints are 0."""
        rest = self.rest_poses
        points = [rest[link.name][:3, 3] for link in self.joints]
        parents = [np.eye(4) if link.parent is None else rest[link.parent] for link in self.joints]
        directions = [parent[:3, :3] @ link.axis for parent, link in zip(parents, self.joints, strict=True)]
        return np.array(points).reshape(-1, 3), np.array(directions).reshape(-1, 3)

    def values(self, readings: Mapping[str, float]) -> Array:
        """Return [J, B]: the value by which each of `joints` moves each of `bodies`, for links beyond it, else 0.
        Together with `axes_at_rest` sufficient for posing. Raises KeyError for a missing reading."""
        rows = [[link.joint_value(readings) * self.carries(link, body) for body in self.bodies] for link in self.joints]
        return np.array(rows, np.float64).reshape(len(self.joints), len(self.bodies))

    def carries(self, joint: Link, body: Link) -> bool:
        """Return True if `body` moves with the joint of `joint`."""
        link: Link | None = body
        while link is not None and link.name != joint.name:
            link = None if link.parent is None else self.links[self._index[link.parent]]
        return link is not None

    def to_json(self) -> dict[str, Any]:
        """The `kinematics` block that `neeco.capture.readers.kinematics` reads."""
        written: dict[str, Any] = {} if self.pose_of is None else {"pose_of": self.pose_of}
        written["links"] = links = []
        for link in self.links:
            shifted_only = np.array_equal(link.origin[:3, :3], np.eye(3))
            entry: dict[str, Any] = {"name": link.name} | ({} if link.parent is None else {"parent": link.parent})
            entry |= {"type": link.type, "origin": (link.origin[:3, 3] if shifted_only else link.origin).tolist()}
            if link.type != FIXED:
                entry |= {"axis": link.axis.tolist(), "value": dict(link.value), "offset": link.offset}
            entry |= {} if link.limits is None else {"limits": list(link.limits)}
            links.append(entry if link.body else entry | {"body": False})
        return written
