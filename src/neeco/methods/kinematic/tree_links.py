"""Links of a kinematic tree that move apart, and joints by the axes they share."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile

import numpy as np

from neeco.capture.kinematics import KinematicTree, Link


def signature(tree: KinematicTree, name: str | None) -> frozenset[str]:
    """Return the names of the joints that move a link."""
    link = next((link for link in tree.links if link.name == name), tree.links[0])
    return frozenset(joint.name for joint in tree.joints if tree.carries(joint, link))


def links_apart(tree: KinematicTree) -> list[Link]:
    """Return links with a body that move relative to each other, one of each group; first the one that no joint
    moves."""
    chosen = {signature(tree, link.name): link for link in reversed(tree.bodies)}
    still = chosen.pop(frozenset(), tree.links[0])
    return [still, *sorted(chosen.values(), key=tree.links.index)]


def joints_by_axis(tree: KinematicTree) -> list[list[Link]]:
    """Return joints that move a body, grouped by the axis and parent that they share, outermost first."""
    groups: list[list[Link]] = []
    for joint in tree.joints:
        if not any(tree.carries(joint, body) for body in tree.bodies):
            continue
        same = [group for group in groups if _same_axis(group[0], joint)]
        if same:
            same[0].append(joint)
        else:
            groups.append([joint])
    return groups


def _same_axis(one: Link, other: Link) -> bool:
    if (one.parent, one.type) != (other.parent, other.type) or not np.allclose(one.axis, other.axis, atol=1e-6):
        return False
    between = other.origin[:3, 3] - one.origin[:3, 3]
    return bool(np.linalg.norm(np.cross(between, one.axis)) < 1e-6)


def common_name(names: Sequence[str]) -> str:
    """Return the common prefix of the names without a separator at its end: jaw for jaw_left and jaw_right."""
    common = takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in common).rstrip("_- ") or "+".join(sorted(names))
