"""A capture whose roll and joints are solved from its video's measurements and hand-posed frames: suggested frames,
uncertainties, and its states written anew.

`hand_posed.yaml` of a capture: rolls and joints that people set by hand, frame by frame.

    - {frame: '000123', instrument: maryland, roll_deg: 152.0, joints_deg: {jaw_angle: 31.0}, when: 2026-03-01 14:05}

roll_deg: angle about the shaft from the direction towards the camera to the hinge's axis (the instrument's x axis);
joints_deg: as they were posed. `when` and `who` are optional. Several answers for one frame are all kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml

from neeco.base.errors import NeecoError
from neeco.base.files import YamlDumper, parse_yaml, read_json, read_text, write_json, write_text
from neeco.base.settings import Fault, faults_in, printable, read
from neeco.capture.documents import Node
from neeco.capture.model import UNKNOWN_DEG, Capture, Instrument
from neeco.capture.readers import read_capture
from neeco.ingest.posing.along_shaft import Load, Measurements, Shafts, measure, read_measurements, write_measurements
from neeco.ingest.posing.angles import SETTINGS, AnglePosterior, chain_breaks, solve_joint, solve_rolls
from neeco.ingest.readers.sections import Name

FILE = "hand_posed.yaml"
HEADER = """\
# Frames posed by hand (`neeco view CAPTURE --annotate`), one answer a line; lines may be added, mended and removed.
# roll_deg: about the shaft, from the direction towards the camera to the hinge's axis. joints_deg: as they stand.
"""
REMEDY = "mend or remove that line"


@dataclass(frozen=True, kw_only=True)
class PosingSettings:
    """Thresholds of suggested frames and of answers that contradict each other."""

    n_suggested: int = 10  # number of suggested frames
    jaw_limits: tuple[float, float] = (0.0, 2.1)  # rad, limits of unknown jaws
    frame_s: float = 0.04  # s between frames, where the recording states no times
    near_break: int = 3  # distance in frames from a break of the chain that counts as at it
    extreme: float = 0.05  # share of the frames in which jaws are called widest or narrowest
    outlier_deg: float = 12.0  # minimum difference of an outlier from the other answers
    outlier_sd: float = 3.0  # the same in standard deviations
    min_answers: int = 3  # minimum number of answers that can contradict each other
    max_degrees: int = 720  # maximum angle in the file of answers


POSING = PosingSettings()


def _degrees(node: Node) -> float:
    if type(node.value) not in (int, float) or not abs(node.value) <= POSING.max_degrees:
        raise Fault(node.field, f"{printable(node.value)} is no angle in degrees; {REMEDY}")
    return float(node.value)


def _joints(node: Node) -> dict[str, float]:
    if not isinstance(node.value, dict):
        raise Fault(node.field, f"is not name: degrees; {REMEDY}")
    return {str(name): _degrees(Node(value, node.file, str(name))) for name, value in node.value.items()}


Remark = Annotated[str, lambda node: str(node.value)]  # YAML reads some as dates


@dataclass(frozen=True)
class HandPose:
    """An answer: roll and joints of one instrument in one frame. frame: its image's name without the suffix."""

    frame: Name
    instrument: Name
    roll_deg: Annotated[float, _degrees]
    joints_deg: Annotated[dict[str, float], _joints] = field(default_factory=dict)
    when: Remark | None = None
    who: Remark | None = None

    @property
    def degrees(self) -> dict[str, float]:
        """Roll and joints by name."""
        return {"roll": self.roll_deg, **self.joints_deg}


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
    style: dict[str, Any] = {"default_flow_style": True, "sort_keys": False, "width": math.inf, "allow_unicode": True}
    lines = []
    for answer in answers:
        value = {key: item for key, item in vars(answer).items() if item is not None}
        value["roll_deg"] = round(answer.roll_deg, 1)
        value["joints_deg"] = {name: round(angle, 1) for name, angle in answer.joints_deg.items()}
        lines.append(f"- {str(yaml.dump(value, Dumper=YamlDumper, **style)).strip()}\n")
    write_text(capture / FILE, HEADER + "".join(lines))


@dataclass(frozen=True)
class Suggestion:
    """A frame that would help if it were posed by hand, and why, in a few words."""

    frame: int
    reason: str


@dataclass(frozen=True)
class OutlierAnswer:
    """An answer that others contradict. degrees: by how much; against: "an earlier answer" or "its neighbours"."""

    frame: int
    what: str  # roll, or a joint's name
    degrees: float
    against: str

    def __str__(self) -> str:
        return f"{self.what} differs by {abs(self.degrees):.0f}° from {self.against}"


@dataclass(frozen=True, eq=False)
class SolvedPosing:
    """Roll and joints of one instrument in all frames, given answers (frame's index, answer)."""

    instrument: Instrument
    shafts: Shafts
    measured: Measurements
    answers: Sequence[tuple[int, HandPose]]
    rolls: AnglePosterior
    joints: dict[str, AnglePosterior]

    @property
    def angles(self) -> dict[str, AnglePosterior]:
        """Roll and joints by name."""
        return {"roll": self.rolls, **self.joints}

    def suggestions(self, count: int = POSING.n_suggested) -> list[Suggestion]:
        """The frames whose answers would help most, each as if those before it were answered already."""
        solved = list(self.angles.values())
        usable = self.measured.seen.copy()
        usable[[frame for frame, _ in self.answers]] = False
        chosen: list[Suggestion] = []
        # frames before which texture alone does not determine the roll
        breaks = np.array(chain_breaks(self.measured.pairs, self.rolls))
        for _ in range(min(count, int(usable.sum()))):
            variance = np.asarray(sum(np.diag(some.covariance) for some in solved))
            if not self.answers and not chosen:  # all are equal; open jaws show their hinge best
                variance = self.measured.widths
            frame = int(np.argmax(np.where(usable, variance, -np.inf)))
            widths = self.measured.widths
            reason = "the chain of rolls breaks here"
            if self.joints and widths[frame] >= np.quantile(widths, 1 - POSING.extreme):
                reason = "jaws at their widest"
            elif not len(breaks) or np.abs(breaks - frame).min() > POSING.near_break:
                deviations = {name: some.deviations_deg[frame] for name, some in zip(self.angles, solved, strict=True)}
                least = max(deviations, key=lambda name: deviations[name])
                reason = f"largest deviation: {least} ± {deviations[least]:.0f}°"
                if self.joints and widths[frame] <= np.quantile(widths, POSING.extreme):
                    reason = "jaws at their narrowest"
            chosen.append(Suggestion(frame, reason))
            usable[frame] = False
            for number, some in enumerate(solved):  # with one more hand-posed frame; the values stay
                column = some.covariance[:, frame]
                gained = np.outer(column, column) / (column[frame] + np.radians(SETTINGS.hand_sd_deg) ** 2)
                solved[number] = AnglePosterior(some.values, some.covariance - gained)
        return chosen

    def outliers(self) -> list[OutlierAnswer]:
        """Answers that differ from an earlier one of the same frame; and of roll and of each joint the one that differs
        most from the others' prediction, as a wrong one makes others look wrong, too."""
        outliers = []
        for which, solved in self.angles.items():
            worst, least = None, POSING.outlier_sd
            for position, (frame, answer) in enumerate(self.answers):
                angle = answer.degrees[which]
                earlier = next((old for other, old in self.answers[:position][::-1] if other == frame), None)
                apart = 0.0 if earlier is None else half_turn(angle - earlier.degrees[which])
                if abs(apart) > POSING.outlier_deg:
                    outliers.append(OutlierAnswer(frame, which, apart, "an earlier answer"))
                # leaving one answer out of a Gaussian posterior
                share = max(1 - (float(solved.deviations[frame]) / math.radians(SETTINGS.hand_sd_deg)) ** 2, 0.02)
                apart = half_turn(angle - math.degrees(solved.values[frame])) / share
                far = abs(apart) * math.sqrt(share) / SETTINGS.hand_sd_deg
                if len(self.answers) >= POSING.min_answers and abs(apart) > POSING.outlier_deg and far > least:
                    worst, least = OutlierAnswer(frame, which, half_turn(apart), "what its neighbours say"), far
            outliers += [] if worst is None else [worst]
        return outliers

    def deviations(self) -> dict[str, tuple[float, float]]:
        """Median and 95 % quantile of the standard deviations, degrees, of roll and each joint; 180 where nothing is
        known."""
        quantiles = {}
        for name, solved in self.angles.items():
            deviations = solved.deviations_deg
            if name == "roll" and not self.answers:
                deviations = np.full(len(deviations), UNKNOWN_DEG)
            quantiles[name] = (float(np.median(deviations)), float(np.quantile(deviations, 0.95)))
        return quantiles


def prepare(root: Path, load_mask: Mapping[str, Load]) -> None:
    """Measure roll and joints in the images of a new capture, keep that there, declare unlogged joints, and write the
    states that follow without any hand-posed frame. load_mask: as `measure` takes it. Raises
    NeecoError."""
    capture = read_capture(root)
    measured = measure(capture, load_mask)
    path = root / "transforms.json"
    document = read_json(path)
    for item in [*document["instruments"], *(item for frame in document["frames"] for item in frame["instruments"])]:
        if item["name"] in measured and (new := measured[item["name"]].joints):
            in_frame = "pose" in item
            item["joints"] = {joint: 0.0 if in_frame else {"limits": list(POSING.jaw_limits)} for joint in new}
    write_json(path, document)
    write_measurements(capture, measured)
    posed = PosedCapture(root)
    posed.write_states(posed.solve())


class PosedCapture:
    """A capture with instruments found in its video, its answers and what follows from them."""

    def __init__(self, root: Path) -> None:
        """Raises NeecoError for a capture without such instruments, or whose measurements or answers cannot be read."""
        self.root = root
        self.capture: Capture = read_capture(root)
        in_video = [item for item in self.capture.instruments if item.from_video is not None]
        if not in_video:
            raise NeecoError(
                f"{root}: no instrument was found in the video: all poses are known; "
                "give a capture made by `neeco ingest --shaft-diameter`"
            )
        self.measured = read_measurements(self.capture)
        self.instruments = {item.name: item for item in in_video if item.name in self.measured}
        self.frames = [frame.name for frame in self.capture.frames]
        times = np.array([frame.state.time for frame in self.capture.frames], float)
        self.times = times if self.capture.timed else np.arange(len(times)) * POSING.frame_s
        self.shafts = {name: Shafts.of(self.capture, item) for name, item in self.instruments.items()}

    def solve(self, answers: Sequence[HandPose] | None = None) -> dict[str, SolvedPosing]:
        """Solve all instruments from the answers; those in the file where none are given. Raises NeecoError."""
        answers = read_answers(self.root) if answers is None else answers
        joints = {
            name: [joint for joint in self.measured[name].joints if joint in item.joints]
            for name, item in self.instruments.items()
        }
        for answer in answers:
            if answer.instrument not in joints:
                known = ", ".join(joints)
                raise NeecoError(f"{self.root}: hand_posed.yaml: no instrument {answer.instrument!r}; known: {known}")
            where = f"{self.root / FILE}: frame {answer.frame}"
            if answer.frame not in self.frames:
                raise NeecoError(f"{where}: the capture has no such frame; {REMEDY}")
            if set(answer.joints_deg) != set(joints[answer.instrument]):
                expected = ", ".join(sorted(joints[answer.instrument])) or "none"
                raise NeecoError(f"{where}: joints_deg: expected {expected}; {REMEDY}")
        posings = {}
        for name, instrument in self.instruments.items():
            measured, shafts = self.measured[name], self.shafts[name]
            hand = [(self.frames.index(answer.frame), answer) for answer in answers if answer.instrument == name]
            in_time = sorted(hand, key=lambda item: item[0])
            frames = np.array([frame for frame, _ in in_time], int)
            angles = {
                angle: np.radians([answer.degrees[angle] for _, answer in in_time]) for angle in ("roll", *joints[name])
            }
            rolls = solve_rolls(measured.pairs, shafts.carried(), self.times, frames, angles.pop("roll"))
            solved = {
                joint: solve_joint(measured, rolls, self.times, frames, values, instrument.joints[joint])
                for joint, values in angles.items()
            }
            posings[name] = SolvedPosing(instrument, shafts, measured, hand, rolls, solved)
        return posings

    def write_states(self, posings: dict[str, SolvedPosing]) -> None:
        """Write the solved rolls and joints, and their uncertainties, into transforms.json, whole or not at all. The
        caller owns the folder where others may write. Raises NeecoError."""
        path = self.root / "transforms.json"
        document = read_json(path)
        for index, frame in enumerate(document["frames"]):
            for item in frame["instruments"]:
                if (posing := posings.get(item["name"])) is None:
                    continue
                pose = np.array(item["pose"], float)
                pose[:3, :3] = posing.shafts.rotation(index, float(posing.rolls.values[index]))
                item["pose"] = pose.tolist()
                values = {name: float(solved.values[index]) for name, solved in posing.joints.items()}
                item["joints"] = item.get("joints", {}) | values
                deviations = {name: float(solved.deviations_deg[index]) for name, solved in posing.angles.items()}
                roll = deviations.pop("roll")
                stated = item.get("uncertainty", {})
                tilts = stated.get("rotation_deg", [0.0, 0.0, 0.0])[:2]
                item["uncertainty"] = {
                    "translation_mm": stated.get("translation_mm", [0.0, 0.0, 0.0]),
                    "rotation_deg": [*tilts, roll if posing.answers else UNKNOWN_DEG],
                    "joints_deg": stated.get("joints_deg", {}) | deviations,
                }
        write_json(path, document)


def half_turn(degrees: float) -> float:
    """Return the same angle, in degrees, between -180 and 180."""
    return (degrees + 180) % 360 - 180
