"""Checks of instrument states: missing instruments and joints, limits, degrees, and states that never change."""

from __future__ import annotations

import numpy as np

from neeco.base.plausible import Fault, exceeds_limits, joint_fault, limits_fault
from neeco.capture.checks.settings import SETTINGS
from neeco.capture.documents import Node, printable
from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import MIN_DEVIATION, Instrument
from neeco.capture.readers.parsed import Parsed


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
    """Report readings that a tree takes and nobody recorded, and readings that the others explain."""
    place, name = parsed.header("instruments"), printable(instrument.name)
    if missing := [reading for reading in tree.readings if reading not in instrument.joints]:
        recorded = ", ".join(instrument.joints) or "none"
        message = f"kinematics of {name}: {printable(missing[0])} is no joint of it (recorded: {recorded})"
        place.error(message, "name the recorded readings under `value`")
        return
    if unknown := [joint for joint in instrument.unrecorded if joint not in tree.readings]:
        place.error(f"{name}: nothing says what joint {printable(unknown[0])} moves", "name it in its kinematics")
    if tree.pose_of is not None and (needed := tree.readings_of(tree.pose_of) & set(instrument.unrecorded)):
        message = f"the pose of {printable(tree.pose_of)} depends on {printable(min(needed))}, which nobody recorded"
        place.error(f"kinematics of {name}: {message}", "record the pose of a link before that joint")
    known = sorted(set(tree.readings) - set(instrument.unrecorded))
    states = [state for _, state in parsed.states_of(instrument.name) if set(known) <= set(state.joints)]
    for link in tree.links:
        values = [link.joint_value(state.joints) for state in states if set(link.value) <= set(known)]
        if beyond := [value for value in values if exceeds_limits(value, link.limits)]:
            message = f"joint of link {printable(link.name)} of {name}: {beyond[0]:g} in {len(beyond)} of {len(values)}"
            place.warning(f"{message} frames, outside its limits", "check its gains, offset and limits")
    if len(states) < SETTINGS.min_states:
        return
    readings = np.array([[state.joints[joint] for joint in known] for state in states])  # [S, R]
    readings = readings - readings.mean(0)
    for index, joint in enumerate(known):
        own, others = readings[:, index], np.delete(readings, index, 1)
        if own.std() < MIN_DEVIATION or not others.shape[1]:
            continue
        explained = 1 - (own - others @ np.linalg.lstsq(others, own, rcond=1e-6)[0]).var() / own.var()
        if explained > SETTINGS.max_explained:
            message = f"joint {printable(joint)} of {name} follows from the others ({explained:.1%} of its variance)"
            place.warning(message, "move joints one by one, too, or their axes mix")


def _check_rolls(parsed: Parsed) -> None:
    """Warn of instruments found in video whose roll nobody logged or posed: they cannot be learned."""
    for instrument in parsed.instruments:
        stated = [state.uncertainty for _, state in parsed.states_of(instrument.name) if state.uncertainty is not None]
        unknown = sum(uncertainty.rotation_deg[2] > SETTINGS.max_known_roll_deg for uncertainty in stated)
        if 2 * unknown > len(stated):
            message = f"the roll of {printable(instrument.name)} is not known in {unknown} of {len(stated)} frames"
            parsed.header("frames").warning(message, "log it, or pose frames by hand: neeco view CAPTURE --annotate")


def _check_changes(parsed: Parsed) -> None:
    """Report states that are the same in every frame: other states cannot be learned from them."""
    frames, moving, still = parsed.header("frames"), False, []
    for instrument in parsed.instruments:
        states, name = [state for _, state in parsed.states_of(instrument.name)], printable(instrument.name)
        if len(states) < 2:
            continue
        travels = float(np.ptp(np.stack([state.pose.numpy() for state in states]), axis=0).max()) > MIN_DEVIATION
        values = {joint: [one.joints[joint] for one in states if joint in one.joints] for joint in instrument.joints}
        moves = {joint: max(found) - min(found) > MIN_DEVIATION for joint, found in values.items() if found}
        moving = moving or travels or any(moves.values())
        if travels:
            for joint in (joint for joint, moved in moves.items() if not moved):
                message = f"joint {printable(joint)} of {name} is always {values[joint][0]:g}"
                frames.warning(message, "its other values cannot be learned")
        elif any(moves.values()):
            frames.warning(f"the pose of {name} never changes", "is its tracker connected?")
        else:
            still.append(name)
    for name in still:
        message = f"the state of {name} never changes: pose and joints are the same in every frame"
        remedy = "is its tracker connected? remove it from the capture if it is fixed"
        (frames.warning if moving else frames.error)(message, remedy)
