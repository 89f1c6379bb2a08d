"""Held-out PSNR over processor time, method beside method.

    python benchmarks/learning_curve.py run CAPTURE --name NAME --method METHOD --minutes 20 --output FOLDER \\
        [--stop 10] [--set deformation.L_state=2 ...]
    python benchmarks/learning_curve.py plot FOLDER

`run` trains on one thread and writes FOLDER/NAME.csv: a row per split whenever the training has used another half, one,
two, four, ... minutes of processor time. Drawing the held-out frames is not counted. `--stop` ends a run early without
changing its schedule, which runs over `--minutes`. `plot` draws every CSV of the folder into FOLDER/curves.svg.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import tempfile
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import matplotlib
import torch
from matplotlib.figure import Figure

from neeco.capture import read_capture
from neeco.capture.model import Frame
from neeco.evaluation.image_metrics import psnr
from neeco.evaluation.mask_folders import load_reference
from neeco.files import write_text
from neeco.raster.native import set_threads
from neeco.scene import DrawableScene
from neeco.scene.training_session import Session
from neeco.training.config import training_config
from neeco.training.run import load_run
from neeco.training.train import train

MINUTES = (0.5, 1.0, *range(2, 61, 2))  # of processor time, when a run is scored
KINDS = {"str": str, "float": float, "int": int, "int | None": lambda text: int(text) if text else None}
COLORS = ("#0b6e99", "#b3541e", "#1a7f4b", "#7a3ea1", "#8a6d00", "#b3261e")
WIDTH, HEIGHT = 520, 300  # view box units


@dataclass(frozen=True)
class Row:
    """One split's scores at one moment of a run."""

    name: str
    cpu_seconds: float
    iteration: int
    gaussians: int | None
    phase: int
    split: str
    psnr: float
    psnr_instrument: float


class Enough(Exception):
    """The run has reached `--stop`."""


class HeldOut:
    """The held-out frames of a capture with their photographs and true masks, read once."""

    def __init__(self, capture_path: Path, splits: tuple[str, ...]) -> None:
        capture = read_capture(capture_path)
        self.frames: dict[str, list[tuple[Frame, torch.Tensor, torch.Tensor | None]]] = {}
        for split in splits:
            rows = self.frames[split] = []
            for frame in capture.split(split):
                reference = load_reference(capture, frame)
                rows.append((frame, frame.load_image(), None if reference is None else reference.mask))

    @torch.no_grad()
    def score(self, scene: DrawableScene) -> dict[str, tuple[float, float]]:
        """Mean PSNR per split over whole images and inside the true masks (NaN where there are none), dB."""
        scores = {}
        for split, rows in self.frames.items():
            whole, inside = [], []
            for frame, photo, mask in rows:
                image = scene.render(frame.state, frame.camera).color.clamp(0, 1)
                whole.append(psnr(image, photo, frame.load_mask()))
                inside.append(psnr(image, photo, mask) if mask is not None else float("nan"))
            scores[split] = (sum(whole) / len(whole), sum(inside) / len(inside))
        return scores


class Recorder:
    """Scores the scene at each of MINUTES and at the end, and keeps the CSV complete at every moment."""

    def __init__(self, name: str, held_out: HeldOut, path: Path, stop: float | None) -> None:
        self.name, self.held_out, self.path = name, held_out, path
        self.stop = stop
        self.due = list(MINUTES)
        self.rows: list[Row] = []

    def watch(self, session: Session) -> None:
        """After a step: score when it is time to; raises Enough at `stop` minutes."""
        minutes = session.seconds / 60
        if minutes < self.due[0] and session.progress < 1:
            return
        while minutes >= self.due[0]:
            self.due.pop(0)
        self.add(session, self.held_out.score(session.scene))
        if self.stop is not None and minutes >= self.stop:
            raise Enough

    def add(self, session: Session, scores: dict[str, tuple[float, float]]) -> None:
        for split, (whole, inside) in scores.items():
            row = Row(
                self.name,
                round(session.seconds, 1),
                session.iteration,
                session.scene.num_gaussians,
                session.schedule.phase,
                split,
                round(whole, 3),
                round(inside, 3),
            )
            self.rows.append(row)
            print(row, flush=True)
        write_rows(self.path, self.rows)


def write_rows(path: Path, rows: list[Row]) -> None:
    names = [field.name for field in fields(Row)]
    lines = [",".join(names)] + [",".join(str(value) for value in asdict(row).values()) for row in rows]
    write_text(path, "\n".join(lines) + "\n")


def run(args: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    set_threads(1)
    values = {"seed": args.seed, "minutes": args.minutes, "iterations": args.iterations}
    config = training_config(args.method, values, args.set)
    args.output.mkdir(parents=True, exist_ok=True)
    recorder = Recorder(
        args.name, HeldOut(args.capture, tuple(args.splits)), args.output / f"{args.name}.csv", args.stop
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.run or Path(scratch) / "run"
        try:
            train(args.capture, folder, config, watch=recorder.watch, clock=time.process_time)
        except Enough:
            return
        print("finished:", recorder.held_out.score(load_run(folder).scene))


def read_rows(folder: Path) -> list[Row]:
    """Every CSV of `folder`, by name."""
    rows = []
    for path in sorted(folder.glob("*.csv")):
        with path.open(newline="", encoding="utf-8") as stream:
            for entry in csv.DictReader(stream):
                rows.append(Row(**{field.name: KINDS[str(field.type)](entry[field.name]) for field in fields(Row)}))
    return rows


def plot(args: argparse.Namespace) -> None:
    """FOLDER/curves.svg: whole-image PSNR on `test` (lines) and `unseen` (dashed) over minutes of processor time.

    Beside it curves_instrument.svg, unless no run was of a capture with true masks.
    """
    rows = read_rows(args.folder)
    write_chart(args.folder / "curves.svg", chart(rows, "psnr", "PSNR on held-out frames, dB"))
    inside = [row for row in rows if math.isfinite(row.psnr_instrument)]
    if inside:
        chart_inside = chart(inside, "psnr_instrument", "PSNR inside the instrument, dB")
        write_chart(args.folder / "curves_instrument.svg", chart_inside)
    for row in rows:
        print(row)


def chart(rows: list[Row], key: str, title: str) -> Figure:
    """A line chart of `key` over minutes: one colour per run, the split `test` solid, others dashed."""
    figure = Figure((WIDTH / 72, HEIGHT / 72), dpi=72, layout="constrained")
    axes = figure.add_subplot(title=title, xlabel="minutes of processor time")
    for index, name in enumerate(dict.fromkeys(row.name for row in rows)):
        for split in dict.fromkeys(row.split for row in rows):
            line = [row for row in rows if (row.name, row.split) == (name, split)]
            minutes, values = [row.cpu_seconds / 60 for row in line], [getattr(row, key) for row in line]
            solid = split == "test"
            style = {"color": COLORS[index % len(COLORS)], "linestyle": "-" if solid else "--", "linewidth": 1.8}
            axes.plot(minutes, values, label=name if solid else None, **style)
    axes.set_xlim(left=0)
    axes.grid(axis="y", color="#dde1e6")
    axes.legend(title="dashed: unseen states", loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    return figure


def write_chart(path: Path, figure: Figure) -> None:
    """Write the figure as SVG, the same bytes for the same numbers."""
    stream = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "neeco", "svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    write_text(path, stream.getvalue())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(required=True)
    train_parser = verbs.add_parser("run", help="train one method and record its curve")
    train_parser.add_argument("capture", type=Path)
    train_parser.add_argument("--name", required=True, help="of the curve; the CSV is called after it")
    train_parser.add_argument("--method", required=True)
    train_parser.add_argument("--output", type=Path, required=True, help="folder of the CSVs")
    train_parser.add_argument("--run", type=Path, help="keep the run folder here")
    train_parser.add_argument("--minutes", type=float, help="of processor time; the schedule runs over them")
    train_parser.add_argument("--iterations", type=int, help="at most; by default as the method has it")
    train_parser.add_argument("--stop", type=float, help="end after so many minutes, on the same schedule")
    train_parser.add_argument("--seed", type=int, default=0)
    train_parser.add_argument("--splits", nargs="+", default=["test", "unseen"])
    train_parser.add_argument("--set", nargs="*", default=[], help="fields of the training config, NAME=VALUE")
    train_parser.set_defaults(act=run)
    plot_parser = verbs.add_parser("plot", help="draw every CSV of a folder")
    plot_parser.add_argument("folder", type=Path)
    plot_parser.set_defaults(act=plot)
    args = parser.parse_args()
    args.act(args)


if __name__ == "__main__":
    main()
