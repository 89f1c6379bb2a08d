"""`hand_posed.yaml` of a capture: rolls and joints that people set by hand, frame by frame.

    - {frame: '000123', instrument: maryland, roll_deg: 152.0, joints_deg: {jaw_angle: 31.0}, when: 2026-03-01 14:05}

roll_deg: angle about the shaft from the direction towards the camera to the hinge's axis (the instrument's x axis);
joints_deg: as they were posed. `when` and `who` are optional. Several answers for one frame are all kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import yaml

from neeco.base.errors import NeecoError
from neeco.base.files import YamlDumper, parse_yaml, read_text, write_text
from neeco.base.settings import Fault, faults_in, printable, read
from neeco.capture.documents import Node
from neeco.ingest.recording.sections import Name

FILE = "hand_posed.yaml"
HEADER = """\
# Frames posed by hand (`neeco view CAPTURE --annotate`), one answer a line; lines may be added, mended and removed.
# roll_deg: about the shaft, from the direction towards the camera to the hinge's axis. joints_deg: as they stand.
"""
OPTIONAL = ("when", "who")
REMEDY = "mend or remove that line"
MAX_DEGREES = 720


def _degrees(node: Node) -> float:
    if type(node.value) not in (int, float) or not abs(node.value) <= MAX_DEGREES:
        raise Fault(node.field, f"{printable(node.value)} is no angle in degrees; {REMEDY}")
    return float(node.value)


def _joints(node: Node) -> dict[str, float]:
    if not isinstance(node.value, dict):
        raise Fault(node.field, f"is not name: degrees; {REMEDY}")
    return {str(name): _degrees(Node(value, node.file, str(name))) for name, value in node.value.items()}


def _remark(node: Node) -> str:
    return str(node.value)  # YAML reads some as dates


@dataclass(frozen=True)
class HandPose:
    """An answer: roll and joints of one instrument in one frame. frame: its image's name without the suffix."""

    frame: Name
    instrument: Name
    roll_deg: Annotated[float, _degrees]
    joints_deg: Annotated[dict[str, float], _joints] = field(default_factory=dict)
    when: Annotated[str, _remark] | None = None
    who: Annotated[str, _remark] | None = None


def read_answers(capture: Path) -> list[HandPose]:
    """Read the answers of a capture, in the file's order; none where there is no file. Raises NeecoError."""
    path = capture / FILE
    if not path.exists():
        return []
    entries = parse_yaml(path, read_text(path, "YAML"), REMEDY)
    with faults_in(path):
        return list(read(tuple[HandPose, ...], Node([] if entries is None else entries, str(path), "answers")))


def write_answers(capture: Path, answers: Iterable[HandPose]) -> None:
    """Write the file anew, whole or not at all. Raises NeecoError."""
    write_text(capture / FILE, HEADER + "".join(f"- {_line(answer)}\n" for answer in answers))


def answers_for(
    answers: Sequence[HandPose], instrument: str, frames: Sequence[str], joints: Iterable[str], place: Path
) -> list[tuple[int, HandPose]]:
    """Return those of one instrument, each with the index of its frame. Raises NeecoError for a frame that the capture
    at `place` has not, and for joints other than the instrument's."""
    index = {name: number for number, name in enumerate(frames)}
    wanted = set(joints)
    found = []
    for answer in answers:
        if answer.instrument != instrument:
            continue
        if answer.frame not in index:
            raise NeecoError(f"{place / FILE}: frame {answer.frame}: the capture has no such frame; {REMEDY}")
        if set(answer.joints_deg) != wanted:
            expected = ", ".join(sorted(wanted)) or "none"
            raise NeecoError(f"{place / FILE}: frame {answer.frame}: joints_deg: expected {expected}; {REMEDY}")
        found.append((index[answer.frame], answer))
    return found


def _line(answer: HandPose) -> str:
    value: dict[str, Any] = {
        "frame": answer.frame,
        "instrument": answer.instrument,
        "roll_deg": round(answer.roll_deg, 1),
        "joints_deg": {name: round(angle, 1) for name, angle in answer.joints_deg.items()},
    }
    value |= {key: getattr(answer, key) for key in OPTIONAL if getattr(answer, key) is not None}
    style: dict[str, Any] = {"default_flow_style": True, "sort_keys": False, "width": math.inf, "allow_unicode": True}
    return str(yaml.dump(value, Dumper=YamlDumper, **style)).strip()
