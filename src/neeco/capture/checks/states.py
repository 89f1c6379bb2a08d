"""Checks of instrument states: missing instruments and joints, limits, degrees, and states that never change."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neeco.capture.documents import Node, printable
from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import MIN_DEVIATION, Instrument, InstrumentState
from neeco.capture.readers.parsed import Parsed
from neeco.plausible import Fault, exceeds_limits, joint_fault, limits_fault

MAX_KNOWN_ROLL_DEG = 45.0  # standard deviation above which a roll counts as unknown
MAX_EXPLAINED = 0.98  # share of a reading's variance that the other readings of its kinematics may explain
MIN_STATES = 12  # for that share: fewer states explain each other anyway


def check_states(parsed: Parsed) -> None:
    """Report missing instruments and joints, exceeded limits, degrees for radians, and states that never change."""
    for instrument in parsed.instruments:
        frames = zip(parsed.frames, parsed.places, strict=True)
        without = [place for frame, place in frames if instrument.name not in frame.state.instruments]
        name = printable(instrument.name)
        if len(without) == len(parsed.frames):
            message = f"instrument {name} is declared but no frame has it"
            parsed.header("instruments").error(message, "remove it or give its poses")
        else:
            message = f"instrument {name} is missing here ({len(without)} of {len(parsed.frames)} frames lack it)"
            for place in without:
                place.child("instruments").error(message, "give its pose or drop the frame")
        for joint in instrument.joints:
            _check_joint(parsed, instrument, joint)
        if instrument.kinematics is not None:
            _check_kinematics(parsed, instrument, instrument.kinematics)
    _check_changes(parsed)
    _check_rolls(parsed)


def _check_joint(parsed: Parsed, instrument: Instrument, joint: str) -> None:
    limits, slides = instrument.joints[joint], instrument.slides(joint)
    if limits is not None and (fault := limits_fault(limits, slides)) is not None:
        parsed.header("instruments").error(f"limits of joint {printable(joint)} are {fault[0]}", fault[1])
    worst: tuple[float, Fault, Node] | None = None
    for state_place, state in parsed.states_of(instrument.name):
        place = state_place.child("joints").child(joint)
        if joint in instrument.unrecorded:
            if joint in state.joints:
                place.error("is stated here, and in the header as not recorded", "keep one of the two")
                return
            continue
        if joint not in state.joints:
            place.error("is missing", "give its value in every frame, or drop the frame")
            continue
        fault = joint_fault(state.joints[joint], limits, slides)
        if fault is not None and limits is not None:
            place.error(*fault)
        elif fault is not None and (worst is None or abs(state.joints[joint]) > worst[0]):
            worst = abs(state.joints[joint]), fault, place
    if worst is not None:  # without limits only the largest value is reported
        worst[2].error(*worst[1])


def _check_kinematics(parsed: Parsed, instrument: Instrument, tree: KinematicTree) -> None:
    """Report readings that a tree takes and nobody recorded, and values of its joints beyond their limits."""
    place, name = parsed.header("instruments"), printable(instrument.name)
    if missing := [reading for reading in tree.readings if reading not in instrument.joints]:
        recorded = ", ".join(instrument.joints) or "none"
        place.error(
            f"kinematics of {name}: {printable(missing[0])} is no joint of it (recorded: {recorded})",
            "name the recorded readings under `value`",
        )
        return
    if unknown := [joint for joint in instrument.unrecorded if joint not in tree.readings]:
        place.error(f"{name}: nothing says what joint {printable(unknown[0])} moves", "name it in its kinematics")
    if tree.pose_of is not None and (needed := tree.readings_of(tree.pose_of) & set(instrument.unrecorded)):
        place.error(
            f"kinematics of {name}: the pose of {printable(tree.pose_of)} depends on {printable(min(needed))}, which "
            "nobody recorded",
            "record the pose of a link before that joint",
        )
    known = set(tree.readings) - set(instrument.unrecorded)
    states = [state for _, state in parsed.states_of(instrument.name) if known <= set(state.joints)]
    _check_coupling(parsed, name, sorted(known), states)
    for link in tree.links:
        if not set(link.value) <= known:
            continue
        values = [link.joint_value(state.joints) for state in states]
        beyond = [value for value in values if exceeds_limits(value, link.limits)]
        if beyond:
            low, high = link.limits or (0.0, 0.0)
            message = f"joint of link {printable(link.name)} of {name}: {beyond[0]:g} in {len(beyond)} of {len(values)}"
            place.warning(f"{message} frames, outside its limits {low:g} .. {high:g}", "check its gains and offset")


def _check_coupling(parsed: Parsed, name: str, known: Sequence[str], states: Sequence[InstrumentState]) -> None:
    """Warn of readings that the others explain: the axes of their joints cannot be distinguished."""
    if len(states) < MIN_STATES:
        return
    readings = np.array([[state.joints[joint] for joint in known] for state in states])  # [S, R]
    readings = readings - readings.mean(0)
    for index, joint in enumerate(known):
        own, others = readings[:, index], np.delete(readings, index, 1)
        if own.std() < MIN_DEVIATION or not others.shape[1]:
            continue
        residual = own - others @ np.linalg.lstsq(others, own, rcond=1e-6)[0]
        explained = 1 - residual.var() / own.var()
        if explained > MAX_EXPLAINED:
            message = f"joint {printable(joint)} of {name} follows from the others ({explained:.1%} of its variance)"
            parsed.header("instruments").warning(message, "move joints one by one, too, or their axes mix")


def _check_rolls(parsed: Parsed) -> None:
    """Warn of instruments found in video whose roll nobody logged or posed: they cannot be learned."""
    for instrument in parsed.instruments:
        stated = [state.uncertainty for _, state in parsed.states_of(instrument.name) if state.uncertainty is not None]
        unknown = sum(uncertainty.rotation_deg[2] > MAX_KNOWN_ROLL_DEG for uncertainty in stated)
        if 2 * unknown > len(stated):
            message = f"the roll of {printable(instrument.name)} is not known in {unknown} of {len(stated)} frames"
            parsed.header("frames").warning(message, "log it, or pose frames by hand: neeco view CAPTURE --annotate")


def _check_changes(parsed: Parsed) -> None:
    """Report states that are the same in every frame: other states cannot be learned from them."""
    frames, changing, still = parsed.header("frames"), False, []
    for instrument in parsed.instruments:
        states = [state for _, state in parsed.states_of(instrument.name)]
        if len(states) < 2:
            continue
        name = printable(instrument.name)
        moves = float(np.ptp(np.stack([state.pose.numpy() for state in states]), axis=0).max()) > MIN_DEVIATION
        joints_move = False
        for joint in instrument.joints:
            values = [state.joints[joint] for state in states if joint in state.joints]
            joint_moves = len(values) > 1 and max(values) - min(values) > MIN_DEVIATION
            joints_move = joints_move or joint_moves
            if values and not joint_moves and moves:
                message = f"joint {printable(joint)} of {name} is always {values[0]:g}"
                frames.warning(message, "its other values cannot be learned")
        changing = changing or moves or joints_move
        if not (moves or joints_move):
            still.append(name)
        elif not moves:
            frames.warning(f"the pose of {name} never changes", "is its tracker connected?")
    for name in still:
        message = f"the state of {name} never changes: pose and joints are the same in every frame"
        remedy = "is its tracker connected? remove it from the capture if it is fixed"
        (frames.warning if changing else frames.error)(message, remedy)
