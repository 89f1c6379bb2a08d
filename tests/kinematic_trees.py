"""Random kinematic trees."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from neeco.capture.kinematics import PRISMATIC, REVOLUTE, KinematicTree, Link


def turned(axis: str, angle: float, *shift: float) -> np.ndarray:
    """[4, 4]: a turn about x, y or z, then a shift."""
    c, s, pose = math.cos(angle), math.sin(angle), np.eye(4)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    pose[i, i], pose[j, j], pose[j, i], pose[i, j] = c, c, s, -s
    pose[: len(shift), 3] = shift
    return pose


@st.composite
def kinematic_trees(draw: st.DrawFn) -> KinematicTree:
    """Any tree to a depth of six, of all types of joints, several readings to a joint and several joints to one."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    links = [Link("0")]
    for index in range(1, 1 + draw(st.integers(1, 6))):
        origin = turned("x", rng.uniform(-3, 3), *rng.uniform(-9, 9, 3)) @ turned("y", rng.uniform(-3, 3))
        axis = rng.normal(size=3)
        kind = draw(st.sampled_from([REVOLUTE, PRISMATIC, "fixed"]))
        gains = {f"q{k}": float(rng.uniform(-1, 1)) for k in range(draw(st.integers(1, 3)))}
        parent = str(draw(st.integers(0, index - 1)))
        moves = {} if kind == "fixed" else {"value": gains, "offset": float(rng.uniform(-1, 1))}
        body = draw(st.booleans())
        links.append(Link(str(index), parent, kind, origin, axis / np.linalg.norm(axis), **moves, body=body))
    return KinematicTree(tuple(links))


def at_rest(tree: KinematicTree) -> dict[str, np.ndarray]:
    """root_from_link [4, 4] of every link where all joints' values are 0."""
    links = (Link(link.name, link.parent, link.type, link.origin, link.axis) for link in tree.links)
    return KinematicTree(tuple(links)).poses({})
