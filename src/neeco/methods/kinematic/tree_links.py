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
        for group in groups:
            one = group[0]
            off = np.linalg.norm(np.cross(joint.origin[:3, 3] - one.origin[:3, 3], one.axis))
            same = (one.parent, one.type) == (joint.parent, joint.type)
            if same and np.allclose(one.axis, joint.axis, atol=1e-6) and off < 1e-6:
                group.append(joint)
                break
        else:
            groups.append([joint])
    return groups


def common_name(names: Sequence[str]) -> str:
    """Return the common prefix of the names without a separator at its end: jaw for jaw_left and jaw_right."""
    common = takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in common).rstrip("_- ") or "+".join(sorted(names))
