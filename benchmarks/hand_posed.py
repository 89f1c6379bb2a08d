"""How well roll and joints of an instrument found in a video are known once ten frames were posed by hand.

    python benchmarks/hand_posed.py TRUE --output CAPTURE [--diameter MM] [--working-length MM] [--seeds 1]
    python benchmarks/hand_posed.py TRUE --output CAPTURE --shaft-from-truth

TRUE is a rendered capture with truth/transforms.json. Its cameras, points and images alone become CAPTURE, in which the
shaft is found as `neeco ingest --shaft-diameter` finds it. "Posed by hand" is the truth with a normal, seeded error of
3 degrees on frames that the program asks for one after another; nothing else of the truth is read, except for the
scores. Prints the errors of roll and joint without any answer and with each number of them (of further seeds with all),
and writes hand_posed.yaml and the states that follow into CAPTURE, which can be trained.

--shaft-from-truth is a control, of roll and joint alone: the true shaft, off by 1 degree of tilt, .2 mm across, 1 mm in
depth and .6 mm along, smooth over some frames.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

import numpy as np
import torch
from from_video import masks_of
from scipy.ndimage import gaussian_filter1d

from neeco.capture import Capture, Instrument, InstrumentState, State, read_capture, write_capture
from neeco.capture.model import REFERENCE_PIXELS, FromVideo, Uncertainty
from neeco.files import read_json
from neeco.geometry.conventions import swap_camera_axes
from neeco.geometry.lens import Lens
from neeco.ingest.frames.views import reduced
from neeco.ingest.posing.hand_posed import HandPose, write_answers
from neeco.ingest.posing.posed_capture import PosedCapture, SolvedPosing, prepare
from neeco.ingest.shaft.axis import ShaftVideo
from neeco.ingest.shaft.from_video import find_shaft

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


@dataclass(frozen=True)
class Shaft:
    """Poses [F, 4, 4] that have no roll, in which frames [F] they are known, and how well."""

    camera_from_instrument: np.ndarray
    known: np.ndarray
    uncertainties: tuple[Uncertainty, ...]
    seen: FromVideo


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
    reading = hinge["joint"][next(iter(hinge["joint"]))]
    opening = reading["sign"] * (joint - reading["zero"])
    shaft = (2 * hinge["shaft_radius_mm"], length)
    return Truth(np.linalg.inv(camera) @ pose @ sensor_from_instrument, opening, shaft)


def shaft_from_video(true: Capture, masks: np.ndarray, shaft: tuple[float, float | None]) -> Shaft:
    """As `neeco ingest` finds it, from a diameter and, if given, a working length; masks of the images reduced."""
    images = np.stack([reduced(frame.load_image_bytes().numpy()) for frame in true.frames])
    cameras = np.stack([frame.camera.world_from_camera.double().numpy() for frame in true.frames])
    times = np.array([frame.state.time for frame in true.frames])
    intrinsics = Lens.of(true.frames[0].camera.within(REFERENCE_PIXELS)).intrinsics
    scene = ShaftVideo(
        world_from_camera=cameras,
        times=times,
        episodes=np.zeros(len(times)),
        radius=shaft[0] / 2,
        intrinsics=intrinsics,
        trocar=True,
        scaled=True,
    )
    found = find_shaft(images, masks, scene, shaft[1])
    seen = FromVideo(shaft[0], found.working_length)
    return Shaft(np.linalg.inv(cameras) @ found.poses, found.known, found.uncertainties, seen)


def shaft_from_truth(truth: Truth, seed: int) -> Shaft:
    """The true one with errors; its roll has no meaning."""
    random = np.random.default_rng(seed)

    def error(deviation: float) -> np.ndarray:
        smooth = gaussian_filter1d(random.normal(size=len(truth.joint)), SMOOTH_FRAMES, mode="wrap")
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
    pose = np.tile(np.eye(4), (len(z), 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = np.stack([x, np.cross(z, x), z], -1), origin
    uncertainty = Uncertainty((ACROSS_MM, ACROSS_MM, DEPTH_MM), (TILT_DEG, TILT_DEG, 180.0))
    return Shaft(pose, np.ones(len(z), bool), (uncertainty,) * len(z), FromVideo(*truth.shaft_mm))


def capture_of(true: Capture, shaft: Shaft, output: Path) -> Capture:
    """A capture of the frames in which the shaft is known, as `neeco ingest` writes one."""
    name = true.instruments[0].name
    frames = []
    for index in np.flatnonzero(shaft.known):
        frame = true.frames[index]
        pose = frame.camera.world_from_camera.double() @ torch.from_numpy(shaft.camera_from_instrument[index])
        state = InstrumentState(pose, {}, None, shaft.uncertainties[index])
        frames.append(replace(frame, state=State({name: state}, frame.state.time)))
    instrument = Instrument(name, from_video=shaft.seen)
    write_capture(replace(true, frames=tuple(frames), instruments=(instrument,)), output)
    return read_capture(output)


def scores(posing: SolvedPosing, truth: Truth, free: bool) -> tuple[np.ndarray, np.ndarray]:
    """Errors [F] of roll and joint, degrees; free: of roll as far as one turn for all frames can explain it."""
    true_roll = posing.shafts.rolls(truth.camera_from_instrument[:, :3, 0])
    roll = np.exp(1j * (posing.rolls.values - true_roll))
    if free:
        roll /= roll.mean()
    solved = next(iter(posing.joints.values()))
    return np.degrees(np.angle(roll)), np.degrees(solved.values - truth.joint)


def row(label: str, posing: SolvedPosing, truth: Truth, free: bool = False) -> str:
    found = []
    doubts = [posing.rolls.deviations, next(iter(posing.joints.values())).deviations]
    for errors, doubt in zip(scores(posing, truth, free), doubts, strict=True):
        rms, median, most = np.sqrt((errors**2).mean()), np.median(np.abs(errors)), np.quantile(np.abs(errors), 0.95)
        found.append(f"{rms:6.1f} {median:6.1f} {most:6.1f} {np.degrees(np.median(doubt)):6.1f}")
    return f"{label:>9} | {found[0]} | {found[1]}"


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("true", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--diameter", type=float, help="of the shaft, mm; as the rendered capture states it")
    parser.add_argument(
        "--working-length", type=float, help="from the shaft's end to the tip, mm; measured if not given"
    )
    parser.add_argument("--answers", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=1, help="so many draws of the hand's errors; the first is written")
    parser.add_argument("--shaft-from-truth", action="store_true")
    arguments = parser.parse_args(words)
    true, truth = read_capture(arguments.true), read_truth(arguments.true)
    masks, _ = masks_of(true, np.stack([reduced(frame.load_image_bytes().numpy()) for frame in true.frames]))
    if arguments.shaft_from_truth:
        shaft = shaft_from_truth(truth, arguments.seed)
    else:
        shaft = shaft_from_video(true, masks, (arguments.diameter or truth.shaft_mm[0], arguments.working_length))
    root = arguments.output
    name = capture_of(true, shaft, root).instruments[0].name
    rows = np.flatnonzero(shaft.known)
    start = process_time()
    prepare(root, {name: lambda frame: masks[rows[frame]]})
    print(f"{len(rows)} of {len(masks)} frames; measured in {process_time() - start:.0f} processor seconds")
    truth = replace(truth, camera_from_instrument=truth.camera_from_instrument[rows], joint=truth.joint[rows])
    posed = PosedCapture(root)
    print(f"{root.name}, {name}: errors, degrees (rms, median, 95 %, and the median standard deviation that is stated)")
    print(f"{'answers':>9} | {'roll':^27} | {'joint':^27}")
    print(row("automatic", posed.solve([])[name], truth, free=True))
    for seed in range(arguments.seed, arguments.seed + arguments.seeds):
        answers = answer_by_truth(posed, name, truth, arguments.answers, seed)
        for count in range(1 if seed == arguments.seed else len(answers), len(answers) + 1):
            print(row(str(count), posed.solve(answers[:count])[name], truth))
        if seed == arguments.seed:
            write_answers(root, answers)
            posed.write_states(posed.solve(answers))
            print(f"{'':>9} | asked for: {', '.join(answer.frame for answer in answers)}")
    breaks = posed.solve([])[name].breaks
    print(f"the chain of rolls breaks before frames {', '.join(posed.frames[frame] for frame in breaks) or 'none'}")


def answer_by_truth(posed: PosedCapture, name: str, truth: Truth, count: int, seed: int) -> list[HandPose]:
    """Answers to what the program asks for, one after another, off by HAND_DEG."""
    random = np.random.default_rng(seed)
    joint = next(iter(posed.instruments[name].joints))
    rolls = np.degrees(posed.shafts[name].rolls(truth.camera_from_instrument[:, :3, 0]))
    answers: list[HandPose] = []
    for _ in range(count):
        frame = posed.solve(answers)[name].suggestions(1)[0].frame
        opening = max(0.0, float(np.degrees(truth.joint[frame]) + HAND_DEG * random.normal()))
        roll = float(rolls[frame] + HAND_DEG * random.normal())
        answers.append(HandPose(posed.frames[frame], name, roll, {joint: opening}))
    return answers


if __name__ == "__main__":
    main()
