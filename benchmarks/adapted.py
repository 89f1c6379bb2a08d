"""What `neeco adapt` reaches in footage with truth, and what the scene adds to it.

    python benchmarks/adapted.py SET CAPTURE [--seeds 3] [--arms cuts ...]

SET: output of `neeco adapt`. CAPTURE: its footage, with truth. Prints, for each round, IoU with the truth: of the
network in all frames, of the labels of accepted ones, of the parts; and how far the tip of the rendered state is from
the true one in the image, px. With --arms the same segmenter learns from SET's rendered images and, half of the time,
from its first round's frames by other labels; all steps, images and seeds are the same. Prints their IoU in all frames,
and differences to `accepted` with 95 % intervals over seeds and blocks of frames. Finished networks are kept in
SET/control.

    none        rendered images alone
    filtered    rendered images alone, without those whose label a network taught by the other half contradicts
    proposals   plain pseudo-labels: the network's own masks of all frames
    cuts        these masks cut out along the image's edges; no scene, no rejection
    accepted    as `adapt` does: accepted frames with their masks and parts, without doubtful pixels
    permuted    accepted frames, each with the labels of another
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import read_json, write_json
from neeco.capture.images import read_labels
from neeco.capture.model import Frame
from neeco.capture.readers import read_capture
from neeco.evaluation.masks import Masks, iou, open_truth
from neeco.evidence.image_cut import cut_out
from neeco.studies.adaptation import AdaptRequest
from neeco.studies.adaptation.adapt import INFO, ROUNDS, AcceptedFrame, rendered_samples
from neeco.studies.adaptation.footage import adapted_frames
from neeco.studies.adaptation.verification import ADAPT, PROPOSALS, Shared, Verifier, classes_of, state_of, with_nearest
from neeco.studies.downstream.model import Predict, TrainingTask, input_size, model_class
from neeco.studies.downstream.results import Arm, Scores, mask_scores
from neeco.studies.downstream.samples import Example, Sample, paired_parts
from neeco.studies.downstream.training_data import BatchSampler
from neeco.tracking.from_labels import LabelFitter
from neeco.training.run import SCENE_FILE, load_run

ARMS = ("none", "filtered", "proposals", "cuts", "accepted", "permuted")
TEST = "next"
AGREED = 0.7  # minimum IoU of a rendered label and of what a network predicts there, of the arm `filtered`


@dataclass(frozen=True)
class Labelled:
    """A frame with labels."""

    arm: str
    frame: Frame
    example: Example

    @property
    def name(self) -> str:
        return self.frame.name

    @property
    def key(self) -> tuple[str, str]:
        return self.arm, self.name

    def load(self) -> Example:
        return self.example


@dataclass(frozen=True)
class Control:
    """An adapted set, opened again."""

    output: Path
    settings: dict[str, Any]
    verifier: Verifier
    shared: Shared

    @classmethod
    def of(cls, output: Path) -> Control:
        info = read_json(output / INFO)
        settings = info["settings"]
        run = load_run(Path(info["scene"]), torch.device("cpu"), force=True)
        request = AdaptRequest(run=run.path, footage=Path(settings["footage"]), output=output)
        frames = adapted_frames(
            request.footage,
            output / ROUNDS / "frames",
            settings["frames"],
            settings["intrinsics"] and tuple(settings["intrinsics"]),
            run.scene.recorded,
            lambda done, total: None,
        )
        shared = Shared(run.path / SCENE_FILE, torch.device("cpu"), request, tuple(frames))
        fitter = LabelFitter.of(run.scene, *classes_of(run.scene, request))
        return cls(output, settings, Verifier(fitter, shared.frames, settings["min_overlap"]), shared)

    @property
    def first(self) -> Path:
        return self.output / ROUNDS / "1"

    def samples(self, arm: str) -> list[Sample]:
        """The frames that an arm adds."""
        if arm in ("accepted", "permuted"):
            records = self.verifier.verify(self.first, self.shared, lambda what, done, total: None)
            chosen: list[Any] = [AcceptedFrame(self.verifier, record) for record in records if record["accepted"]]
            if arm == "accepted":
                return chosen
            examples = [sample.load() for sample in chosen]
            others = np.roll(np.random.default_rng(0).permutation(len(chosen)), 1)
            return [
                Labelled(arm, self.verifier.frames[sample.record["index"]], replace(examples[other], image=own.image))
                for sample, own, other in zip(chosen, examples, others, strict=True)
            ]
        if arm in ("none", "filtered"):
            return []
        added: list[Sample] = []
        for frame in self.verifier.frames:
            classes = read_labels(self.first / PROPOSALS / f"{frame.name}.png").numpy()
            image = frame.load_image_bytes().numpy()
            if arm == "cuts":
                cut = cut_out(image, classes > 0, ADAPT.reach)
                classes = np.zeros_like(classes) if cut is None else with_nearest(cut, classes)
            if classes.any():
                added.append(Labelled(arm, frame, Example(image, classes)))
        return added

    def taught(self, arm: str, seed: int) -> list[np.ndarray]:
        """What a network that learned by this arm predicts for all frames, uint8 [H, W] each."""
        rendered: list[Sample] = [*rendered_samples(self.output / ROUNDS / "synthetic", self.verifier.fitter.classes)]
        if arm == "filtered":
            halves, kept = (rendered[::2], rendered[1::2]), []
            for teaching, judged in (halves, halves[::-1]):
                examples = [sample.load() for sample in judged]
                predictions = self._learned([teaching], seed)([example.image for example in examples])
                agreed = [
                    not iou(np.asarray(prediction) > 0, example.classes > 0) < AGREED  # NaN: both are empty
                    for prediction, example in zip(predictions, examples, strict=True)
                ]
                kept += [sample for sample, keep in zip(judged, agreed, strict=True) if keep]
            print(f"filtered: {len(kept)} of {len(rendered)} rendered images stay", flush=True)
            if not (rendered := kept):
                raise NeecoError(f"{self.output}: no rendered image is confirmed; adapt with more --steps")
        sources = [samples for samples in (rendered, self.samples(arm)) if samples]
        predict = self._learned(sources, seed)
        return [np.asarray(p) for p in predict([frame.load_image_bytes().numpy() for frame in self.verifier.frames])]

    def _learned(self, sources: Sequence[Sequence[Sample]], seed: int) -> Predict:
        kind, camera = model_class(self.settings["model"]), self.verifier.frames[0].camera
        task = TrainingTask(
            classes=self.verifier.fitter.classes,
            batches=BatchSampler((), sources, seed=seed, augmented=True),
            size=input_size((camera.width, camera.height), kind.image_size, kind.multiple),
            steps=self.settings["steps"] or kind.steps,
            batch=kind.batch,
            seed=seed,
            device=torch.device("cpu"),
            folder=self.output,
            keep_weights=False,
        )
        return kind().fit(task)


def tip_of(mask: np.ndarray) -> np.ndarray | None:
    """The pixel [2] of an instrument's mask that is farthest from where it enters the image; None where it is at the
    border itself, or nothing enters."""
    rows, columns = np.nonzero(mask)
    inside = (rows > 0) & (rows < mask.shape[0] - 1) & (columns > 0) & (columns < mask.shape[1] - 1)
    if inside.all() or not inside.any():
        return None
    points = np.stack([columns, rows], 1).astype(float)
    farthest = int(np.linalg.norm(points - points[~inside].mean(0), axis=1).argmax())
    return points[farthest] if inside[farthest] else None


def report(control: Control, truth: Masks) -> None:
    """Print the scores of each round."""
    frames, classes = control.verifier.frames, control.verifier.fitter.classes
    table = np.zeros(256, np.uint8)
    for number, pair in paired_parts(truth.names or {}).items():
        part = next((name for name in (pair, truth.names[number]) if name in classes), classes[0])
        table[number] = number and classes.index(part) + 1  # a wrist may be none of the scene's
    for folder in sorted((control.output / ROUNDS).glob("[0-9]*")):
        records = control.verifier.verify(folder, control.shared, lambda what, done, total: None)
        network, labels, clear, parts, tips = [], [], [], [], []
        for record in records:
            true = truth.load(record["frame"])
            network.append(iou(read_labels(folder / PROPOSALS / f"{record['frame']}.png").numpy() > 0, true > 0))
            if record["accepted"]:
                example = AcceptedFrame(control.verifier, record).load()
                rendered = control.verifier.fitter.shares(state_of(record), frames[record["index"]].camera)[1] > 0.5
                ends = tip_of(rendered), tip_of(true > 0)
                if ends[0] is not None and ends[1] is not None:
                    tips.append(float(np.linalg.norm(ends[0] - ends[1])))
                labels.append(iou(example.classes > 0, true > 0))
                clear.append(iou(example.classes > 0, true > 0, example.valid))
                parts.append([iou(example.classes == k + 1, table[true] == k + 1) for k in range(len(classes))])
        told = f"round {folder.name}: network {np.nanmean(network):.3f}; {len(labels)} of {len(records)} accepted"
        if not labels:
            print(told)
            continue
        named = ", ".join(f"{name} {score:.3f}" for name, score in zip(classes, np.nanmean(parts, 0), strict=True))
        print(
            f"{told}: labels {np.mean(labels):.3f} (lowest {min(labels):.3f}), without ignored {np.mean(clear):.3f}; "
            f"{named}; tips {np.median(tips):.1f} px (median of {len(tips)}; 90 % within {np.quantile(tips, 0.9):.1f})"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=[])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    control, truth = Control.of(arguments.set), open_truth(read_capture(arguments.capture))
    report(control, truth)
    jobs = []
    for seed in range(arguments.seeds):
        for arm in arguments.arms:
            file = arguments.set / "control" / f"{arm}-{seed}.json"
            if not file.exists():
                predictions = zip(control.verifier.frames, control.taught(arm, seed), strict=True)
                rows = [
                    mask_scores((mask > 0).astype(np.uint8), Example(mask, truth.load(frame.name) > 0), ["instrument"])
                    for frame, mask in predictions
                ]
                scores = {"iou": float(np.mean([row["iou"] for row in rows])), "per_frame": rows}
                write_json(file, {"model": "", "condition": arm, "real": 0, "fold": seed, "splits": {TEST: scores}})
            jobs.append(read_json(file))
            print(f"{arm} {seed}: {jobs[-1]['splits'][TEST]['iou']:.4f}", flush=True)
    scores, reference = Scores(jobs), Arm("", "accepted", 0)
    for arm in arguments.arms:
        one = scores.estimate(Arm("", arm, 0), TEST, "iou")
        line = f"{arm:10} {one.mean:.4f}" if one else arm
        if arm != "accepted" and (gain := scores.estimate(reference, TEST, "iou", Arm("", arm, 0))):
            ends = "" if gain.low is None else f" [{gain.low:+.4f}, {gain.high:+.4f}]"
            line += f"   accepted - {arm}: {gain.mean:+.4f}{ends}"
        print(line)


if __name__ == "__main__":
    main()
