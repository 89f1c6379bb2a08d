"""`neeco track`: estimate the states of footage, with the trust in each, and write a capture.

Frames are tracked forwards from the first detection, then backwards to the beginning. Intervals of low trust are
tracked again, backwards from the frame after them; the more trusted result is kept. Every step is written immediately,
so that interrupted work continues to the same bytes.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Literal

import torch

import neeco
from neeco.base.errors import NeecoError
from neeco.base.files import own_folder, read_begun, read_json, require_same, write_json
from neeco.capture.model import Capture, Frame, InstrumentState, State
from neeco.capture.readers import read_capture
from neeco.capture.writer import fingerprint, write_capture
from neeco.scene import Recorded
from neeco.scene.io import save_scene
from neeco.synthesis.tissue_replacement import merged_scene
from neeco.tracking.follow import FOLLOW, Follower, Step
from neeco.tracking.parameters import TrackedParameters, fitter_of
from neeco.tracking.trust import Reference
from neeco.training.run import SCENE_FILE, scene_digest, stored_config, write_config

if TYPE_CHECKING:
    from neeco.scene import GaussianScene
    from neeco.training.run import GaussianRun

SCHEMA = "neeco-track/1"
INFO = "track.json"
STEPS = "steps"  # folder of finished steps, removed at the end
PAGE = "track.html"
RUN = "run"  # folder of the run used for footage over another tissue


@dataclass(frozen=True, kw_only=True)
class TrackSettings:
    """Thresholds of tracking."""

    other_tissue_misfit: float = 3.0  # ratio of the misfit over another run's tissue to that over their own
    min_trust: float = 0.5  # trust of a frame's state below which the frame is excluded
    min_trusted_share: float = 0.5  # share of frames below which the result is DOUBTFUL
    certain: float = 0.8  # trust at which tracking starts immediately
    n_beginnings: int = 8  # frames searched for a first detection, until one is certain
    follow_again: float = 0.7  # trust below which an interval is tracked again, from its far end


TRACK = TrackSettings()

LEARN_TISSUE = "`neeco train --method 3dgs FOOTAGE --output RUN2`, then `neeco track RUN FOOTAGE --tissue RUN2`"

Start = Literal["first", "none"]


@dataclass(frozen=True)
class Tracked:
    """The result: a record of every frame, in order of time, and the capture of the trusted ones."""

    output: Path
    footage: Capture
    records: list[dict[str, Any]]
    written: int
    min_trust: float
    scene: GaussianScene

    @property
    def page(self) -> Path:
        """Return the page about all frames, once `write_track_page` has written it."""
        return self.output / PAGE

    def __repr__(self) -> str:
        return f"Tracked({str(self.output)!r}, {self.written} of {len(self.records)} frames)"

    @property
    def verdict(self) -> str:
        """One sentence on the trust in the states; the verdict DOUBTFUL is in capitals."""
        count, missing = len(self.records), sum(record["how"] == "lost" for record in self.records)
        typical = median(record["trust"]["value"] for record in self.records)
        summary = f"trust is {typical:.2f} (median)"
        summary += f", and in {missing} of {count} frames nothing was found" if missing else ""
        if self.written < TRACK.min_trusted_share * count:
            return f"DOUBTFUL: {summary}; check that it shows the run's instrument over its tissue"
        return f"{'good' if self.written == count else 'usable'}: {summary}"

    def require_trusted(self) -> None:
        """Raise NeecoError if no frame is trusted."""
        if not self.written:
            best = max(record["trust"]["value"] for record in self.records)
            raise NeecoError(
                f"{self.footage.root}: no frame has a trust of {self.min_trust:g}, the highest is {best:.2f}; check "
                f"that it shows the run's instrument over its tissue (if not: {LEARN_TISSUE}); results: {self.output}"
            )


def track_footage(
    run: GaussianRun,
    footage: Capture,
    output: Path,
    *,
    start: Start = "none",
    tissue: GaussianRun | None = None,
    min_trust: float = TRACK.min_trust,
    resume: bool = False,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Tracked:
    """Find the states of the run's instruments in every frame of `footage`, and write those that are trusted as a
    capture.

    tissue: a run that learned the tissue of the footage, in the world of its cameras; the scene used for tracking, the
    instruments over that tissue, becomes the output's own run (`RUN`). None: the footage shows the tissue of `run`.

    States of the footage are ignored, except that of its first frame where `start` is "first". Interrupted (Ctrl-C) or
    failing, it keeps finished steps for `resume`. The caller sets the number of torch threads (`open_run`). Raises
    NeecoError for a run that cannot track, footage without the state that is asked for, a `min_trust` outside [0, 1],
    and an `output` that is not empty (without `resume`) or was begun otherwise.
    """
    if not 0 <= min_trust <= 1:
        raise NeecoError(f"--min-trust: {min_trust} is not a share; give 0 to 1")
    parameters = TrackedParameters.of(run.scene)
    scene = run.scene if tissue is None else over_tissue(run.scene, tissue.scene)
    frames = sorted(footage.frames, key=lambda frame: frame.state.time)
    first_state = _first_state(footage, frames[0], scene) if start == "first" else None
    trained_on = run.capture()
    info: dict[str, Any] = {
        "schema": SCHEMA,
        "version": neeco.__version__,
        "run": os.path.abspath(run.path),
        "footage": os.path.abspath(footage.root),
        "scene_sha256": scene_digest(run.path),
        "captures_sha256": [fingerprint(capture) for capture in (footage, trained_on)],
        "start": start,
        "tissue": "run" if tissue is None else os.path.abspath(tissue.path),
        **({} if tissue is None else {"tissue_sha256": scene_digest(tissue.path)}),
        "min_trust": min_trust,
    }
    if (begun := read_begun(output, INFO, resume, "tracked footage")) is not None:
        keys = ("schema", "version", "scene_sha256", "captures_sha256", "start", "tissue", "tissue_sha256")
        require_same(str(output / INFO), ((key, begun.get(key), info.get(key)) for key in keys))
    with own_folder(output):
        stored = read_json(output / INFO) if (output / INFO).exists() else {}
        if not stored.get("complete"):
            write_json(output / INFO, info | {"complete": False})
            fitter, allowance = fitter_of(run.scene), 1.0
            reference = Reference.of(fitter, trained_on.split("train"))
            if tissue is not None:
                fitter, allowance = fitter_of(scene), TRACK.other_tissue_misfit
            follower = Follower.of(frames, fitter, reference, allowance)
            steps = StepFiles(output / STEPS, follower, on_progress).all_steps(first_state)
            records = [_record(frames[k], step, parameters) for k, step in enumerate(steps)]
            info |= {"complete": True, "reference": reference.to_json(), "frames": records}
        else:
            info = stored | {"min_trust": min_trust}  # with the same steps, other frames may be trusted
        registered = trained_on.registered or tissue is not None
        chosen = tuple(
            replace(frame, state=state_of(record))
            for frame, record in zip(frames, info["frames"], strict=True)
            if record["trust"]["value"] >= min_trust
        )
        trusted = replace(footage, frames=chosen, registered=registered)
        if trusted.frames:
            write_tracked(trusted, output, scene, trained_on)
        elif stored.get("complete"):
            info = stored  # its capture is kept
        if tissue is not None and (trusted.frames or not stored.get("complete")):
            _write_run(output, run, scene)
        write_json(output / INFO, info)
        if (output / STEPS).exists():
            shutil.rmtree(output / STEPS)
    return Tracked(output, footage, info["frames"], len(trusted.frames), min_trust, scene)


def over_tissue(instruments: GaussianScene, tissue: GaussianScene) -> GaussianScene:
    """Return the instruments of one scene over the tissue of another, in its light.

    The recording is that of the first, corrected by its registration, which is removed. Raises NeecoError for a scene
    that does not separate tissue from moving parts.
    """
    if tissue.deformation.motion(tissue.canonical) is None:
        raise NeecoError(f"--tissue: method {tissue.method} learns no tissue by itself; use a run of method 3dgs")
    merged = merged_scene(tissue, [instruments])
    with torch.no_grad():
        merged.falloff[1] = instruments.falloff[1]
    recorded = instruments.recorded
    merged.recorded = replace(recorded, states=tuple(instruments.registered(state) for state in recorded.states))
    return merged


def _write_run(output: Path, run: GaussianRun, scene: GaussianScene) -> None:
    """Write the scene used for tracking as a run of its own, trained on the capture at `output`, if there is one."""
    folder, digest = output / RUN, ""
    if (output / "transforms.json").exists():
        capture = read_capture(output)
        scene.recorded = Recorded.of(capture.frames, scene.instruments, lens=capture.lens, still=capture.still)
        digest = fingerprint(capture)
    folder.mkdir(exist_ok=True)
    save_scene(scene, folder / SCENE_FILE)
    config = stored_config(Path(run.path), run.config)
    write_config(folder, output, replace(config, transforms="transforms.json"), digest)


@dataclass
class StepFiles:
    """Steps, one file each: computed once, then read."""

    folder: Path
    follower: Follower
    on_progress: Callable[[int, int], None]
    done: int = 0

    def all_steps(self, first_state: State | None) -> list[Step]:
        """Return the best step of every frame, in order of time."""
        count = len(self.follower.frames)
        if first_state is None:
            first = self._beginning()
        else:
            first = self._step("begin-0", lambda: self.follower.begin(0, first_state))
        steps: dict[int, Step] = {first.frame: first}
        self._count(count)
        for way, end in ((1, count), (-1, -1)):
            before = first
            for frame in range(first.frame + way, end, way):
                before = steps[frame] = self._follow("pass", before, frame)
                self._count(count)
        self._again(steps)
        return [steps[frame] for frame in range(count)]

    def _beginning(self) -> Step:
        """Return the first step: the most trusted of several frames spread over the footage."""
        count, steps = len(self.follower.frames), []
        spread = [k * count // TRACK.n_beginnings for k in range(TRACK.n_beginnings)]
        for frame in dict.fromkeys(spread):
            steps.append(self._step(f"find-{frame}", partial(self.follower.find, frame)))
            if steps[-1].trust.value >= TRACK.certain:
                break
        return max(steps, key=lambda step: step.trust.value)

    def _again(self, steps: dict[int, Step]) -> None:
        """Track backwards through every interval of low trust that precedes a trusted frame.

        Other rolls are searched in each of its frames, so that both results are judged by the same measure.
        """
        before: Step | None = None
        for frame in range(len(steps) - 1, -1, -1):
            if steps[frame].trust.value >= TRACK.follow_again:
                before = steps[frame]
                continue
            if before is None:
                continue
            if before is steps.get(frame + 1):  # its motion was estimated in the other direction
                before = replace(before, motion=self.follower.motion.begin(before.motion.state))
            before = self._follow("again", replace(before, unsearched=FOLLOW.search_rolls_every), frame)
            if before.trust.value > steps[frame].trust.value:
                steps[frame] = before

    def _follow(self, name: str, before: Step, frame: int) -> Step:
        return self._step(f"{name}-{frame}", lambda: self.follower.follow(before, frame))

    def _step(self, name: str, make: Callable[[], Step]) -> Step:
        """Return one step from its file, which is written first if absent."""
        path = self.folder / f"{name}.json"
        if not path.exists():
            write_json(path, make().to_json())
        return Step.from_json(read_json(path), str(path))

    def _count(self, total: int) -> None:
        self.done += 1
        self.on_progress(self.done, total)


def _record(frame: Frame, step: Step, parameters: TrackedParameters) -> dict[str, Any]:
    """Return a frame's record for track.json; `deviation`: standard deviations of rotation (rad), position (mm) and
    every joint."""
    instruments = {}
    variance = step.motion.covariance.diagonal()
    for item, (pose, rows) in zip(parameters.instruments, parameters.rows, strict=True):
        state, pose_variance = step.motion.state.instruments[item.name], variance[pose].clamp_min(0)
        deviation = {"rotation": float(pose_variance[:3].sum().sqrt()), "place": float(pose_variance[3:].sum().sqrt())}
        most = (item.high - item.low) / math.sqrt(12)  # of a joint uniformly distributed between its bounds
        joints = torch.minimum(variance[rows].clamp_min(0).sqrt(), most).tolist()
        deviation |= {f"joint.{name}": value for name, value in zip(item.joints, joints, strict=True)}
        instruments[item.name] = {
            "pose": state.pose.tolist(),
            "joints": dict(state.joints),
            "deviation": {name: round(value, 5) for name, value in deviation.items()},
        }
    return {
        "frame": frame.name,
        "split": frame.split,
        "time": frame.state.time,
        "how": step.how,
        "trust": step.trust.to_json(),
        "misfit": round(step.misfit, 4),
        "instruments": instruments,
    }


def state_of(record: dict[str, Any]) -> State:
    """Return the state in a record of track.json."""
    trust = record["trust"]["value"]
    instruments = {
        name: InstrumentState(torch.tensor(entry["pose"], dtype=torch.float64), entry["joints"], trust)
        for name, entry in record["instruments"].items()
    }
    return State(instruments, record["time"])


def write_tracked(trusted: Capture, output: Path, scene: GaussianScene, trained_on: Capture) -> None:
    """Write tracked frames as a capture whose states include every joint.

    Other data of the footage (its lens, a still scope) are kept.
    """
    points = trusted.points if trusted.points.measured else trained_on.points
    instruments = tuple(replace(item, unrecorded=()) for item in scene.instruments)
    write_capture(replace(trusted, instruments=instruments, points=points), output, overwrite=True)


def _first_state(footage: Capture, frame: Frame, scene: GaussianScene) -> State:
    """Return the stated state of the first frame. Raises NeecoError where it lacks an instrument or joint."""
    states = {}
    for item in scene.instruments:
        stated = frame.state.instruments.get(item.name)
        missing = [name for name in item.joints if stated is not None and name not in stated.joints]
        if stated is None or missing:
            absent = f"instrument {item.name!r}" if stated is None else f"joint {missing[0]!r} of {item.name!r}"
            raise NeecoError(
                f"{footage.root}: {frame.name}: instruments: the first frame does not state {absent}; state it there, "
                "or use --start none"
            )
        states[item.name] = InstrumentState(stated.pose.double(), {name: stated.joints[name] for name in item.joints})
    return State(states, frame.state.time)
