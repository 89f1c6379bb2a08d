"""How well roll and joints of an instrument found in a video are known once ten frames were posed by hand.

    python benchmarks/hand_posed.py CAPTURE [--truth TRUE] [--answers 10] [--seed 1]
    python benchmarks/hand_posed.py TRUE --shaft-from-truth --output CAPTURE [--masks FILE.npz]

CAPTURE was made by `neeco ingest --shaft-diameter`; TRUE is the rendered capture of the same frames (default: CAPTURE
itself), with truth/transforms.json. "Posed by hand" is the truth with a normal, seeded error of 3 degrees on frames
that the program asks for one after another; nothing else of the truth is read, except for the scores. Prints the
errors of roll and joints without any answer and with each number of them, and writes hand_posed.yaml and the states
that follow into CAPTURE.

--shaft-from-truth is a control, of roll and joints alone: it makes CAPTURE from TRUE with the true shaft, off by 1
degree of tilt, .2 mm across, 1 mm in depth and .6 mm along (smooth over some frames), and with masks from a file (key
`mask`, bits packed; key `shape`) or, without one, the true ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from neeco.capture import Capture, Instrument, InstrumentState, State, read_capture, write_capture
from neeco.capture.model import FromVideo, Uncertainty, swap_camera_axes
from neeco.files import read_json
from neeco.ingest.posing.hand_posed import Answer, write_answers
from neeco.ingest.posing.posed_capture import PosedCapture, Posing, prepare

HAND_DEG = 3.0
SMOOTH_FRAMES = 3.0  # of the shaft's errors in the control
TILT_DEG, ACROSS_MM, DEPTH_MM, ALONG_MM = 1.0, 0.2, 1.0, 0.6
SHAFTS = {"maryland": (6.0, 26.0), "scissors": (4.8, 20.5)}  # diameter and working length, mm, as those READMEs say


@dataclass(frozen=True)
class Truth:
    """True poses [F, 4, 4] in the true camera, the frame's z along the shaft, and x the hinge's axis; joint [F] rad."""

    camera_from_instrument: np.ndarray
    joint: np.ndarray
    shaft_mm: tuple[float, float]  # diameter, working length


def read_truth(root: Path) -> Truth:
    frames = read_json(root / "truth" / "transforms.json")["frames"]
    camera = np.array([swap_camera_axes(np.array(frame["transform_matrix"])) for frame in frames])
    pose = np.array([frame["instruments"][0]["pose"] for frame in frames])
    joint = np.array([next(iter(frame["instruments"][0]["joints"].values())) for frame in frames])
    name = frames[0]["instruments"][0]["name"]
    if not (root / "truth" / "hinge.json").exists():
        return Truth(np.linalg.inv(camera) @ pose, joint, SHAFTS[name])
    hinge = read_json(root / "truth" / "hinge.json")
    z, x = np.array(hinge["shaft_direction"]), np.array(hinge["hinge_axis"])
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    sensor_from_instrument = np.eye(4)
    sensor_from_instrument[:3, :3] = np.stack([x, np.cross(z, x), z], -1)
    sensor_from_instrument[:3, 3] = np.array(hinge["shaft_origin"]) + hinge["wrist_starts_mm"] * z
    length = hinge["hinge_along_shaft_mm"] + max(hinge["jaw_lengths_mm"].values())
    opening = joint - hinge["joint"]["jaw_angle"]["zero"]
    shaft = (2 * hinge["shaft_radius_mm"], length)
    return Truth(np.linalg.inv(camera) @ pose @ sensor_from_instrument, opening, shaft)


def capture_with_shaft(true: Capture, truth: Truth, output: Path, seed: int) -> Capture:
    """A capture as one found in the video is, its shaft the true one with errors, its roll of no meaning."""
    random = np.random.default_rng(seed)

    def error(deviation: float) -> np.ndarray:
        smooth = gaussian_filter1d(random.normal(size=len(true.frames)), SMOOTH_FRAMES, mode="wrap")
        return np.asarray(deviation * smooth / smooth.std())[:, None]

    origin, z = truth.camera_from_instrument[:, :3, 3].copy(), truth.camera_from_instrument[:, :3, 2]
    ray = origin / np.linalg.norm(origin, axis=1, keepdims=True)
    across = np.cross(z, -ray)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    towards = np.cross(across, z)
    origin += error(ACROSS_MM) * across + error(DEPTH_MM) * ray + error(ALONG_MM) * z
    z = z + np.radians(TILT_DEG) / np.sqrt(2) * (error(1.0) * across + error(1.0) * towards)
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(np.cross(z, towards), z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    name = true.instruments[0].name
    joint = next(iter(true.instruments[0].joints), "jaw_angle")
    uncertainty = Uncertainty((ACROSS_MM, ACROSS_MM, DEPTH_MM), (TILT_DEG, TILT_DEG, 180.0), {joint: 60.0})
    frames = []
    for index, frame in enumerate(true.frames):
        pose = np.eye(4)
        pose[:3, :3] = np.stack([x[index], np.cross(z[index], x[index]), z[index]], -1)
        pose[:3, 3] = origin[index]
        camera = frame.camera.world_from_camera.double()
        state = InstrumentState(camera @ torch.from_numpy(pose), {joint: 0.0}, None, uncertainty)
        frames.append(replace(frame, state=State({name: state}, frame.state.time)))
    instrument = Instrument(name, {joint: (0.0, 1.6)}, from_video=FromVideo(*truth.shaft_mm))
    write_capture(replace(true, frames=tuple(frames), instruments=(instrument,)), output)
    return read_capture(output)


def masks_of(capture: Capture, true: Path, file: Path | None) -> Callable[[int], np.ndarray]:
    if file is not None:
        packed = np.load(file)
        shape = tuple(packed["shape"])
        masks = np.unpackbits(packed["mask"])[: np.prod(shape)].reshape(shape).astype(bool)
        return lambda frame: np.asarray(masks[frame])
    return lambda frame: cv2.imread(str(true / "truth" / "masks" / f"{capture.frames[frame].name}.png"), 0) > 0


def scores(posing: Posing, truth: Truth, free: bool) -> tuple[np.ndarray, np.ndarray]:
    """Errors [F] of roll and joint, degrees; free: of roll as far as one turn for all frames can explain it."""
    true_roll = posing.shafts.rolls(truth.camera_from_instrument[:, :3, 0])
    roll = np.exp(1j * (posing.rolls.values - true_roll))
    if free:
        roll /= roll.mean()
    solved = next(iter(posing.joints.values()))
    return np.degrees(np.angle(roll)), np.degrees(solved.values - truth.joint)


def row(label: str, posing: Posing, truth: Truth, free: bool = False) -> str:
    found = []
    doubts = [posing.rolls.deviations, next(iter(posing.joints.values())).deviations]
    for errors, doubt in zip(scores(posing, truth, free), doubts, strict=True):
        rms, median, most = np.sqrt((errors**2).mean()), np.median(np.abs(errors)), np.quantile(np.abs(errors), 0.95)
        found.append(f"{rms:6.1f} {median:6.1f} {most:6.1f} {np.degrees(np.median(doubt)):6.1f}")
    return f"{label:>9} | {found[0]} | {found[1]}"


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--answers", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--shaft-from-truth", action="store_true")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--masks", type=Path)
    arguments = parser.parse_args(words)
    root, true_root = arguments.capture, arguments.truth or arguments.capture
    truth = read_truth(true_root)
    if arguments.shaft_from_truth:
        if arguments.output is None:
            parser.error("--shaft-from-truth: give --output")
        true = read_capture(true_root)
        made = capture_with_shaft(true, truth, arguments.output, arguments.seed)
        name = made.instruments[0].name
        prepare(arguments.output, {name: masks_of(made, true_root, arguments.masks)})
        root = arguments.output
    posed = PosedCapture(root)
    name, instrument = next(iter(posed.instruments.items()))
    random = np.random.default_rng(arguments.seed)
    answers: list[Answer] = []
    print(f"{root.name}, {name}: errors, degrees (rms, median, 95 %, and the median standard deviation that is stated)")
    print(f"{'answers':>9} | {'roll':^27} | {'joint':^27}")
    while True:
        posing = posed.solve(answers)[name]
        label = str(len(answers)) if answers else "automatic"
        print(row(label, posing, truth, free=not answers))
        if len(answers) >= arguments.answers:
            break
        frame = posing.suggestions(1)[0].frame
        roll = np.degrees(posing.shafts.rolls(truth.camera_from_instrument[:, :3, 0])[frame])
        joint = next(iter(instrument.joints))
        opening = np.degrees(truth.joint[frame]) + HAND_DEG * random.normal()
        drawn = {joint: max(0.0, float(opening))}
        answers.append(Answer(posed.frames[frame], name, float(roll + HAND_DEG * random.normal()), drawn))
    breaks = posed.solve([])[name].breaks
    print(f"the chain of rolls breaks before frames {', '.join(posed.frames[frame] for frame in breaks) or 'none'}")
    print(f"asked for: {', '.join(answer.frame for answer in answers)}")
    write_answers(root, answers)
    posed.write_states(posed.solve(answers))


if __name__ == "__main__":
    main()
