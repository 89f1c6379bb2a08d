"""`neeco demo`: the whole main job on the bundled sample, with the same functions as the other verbs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from neeco.base.errors import NeecoError
from neeco.base.settings import Device

if TYPE_CHECKING:
    import torch

    from neeco.evaluation.image_metrics import Lpips
    from neeco.training.run import TrainedRun

SAMPLE = "liver-mini"
IMAGES = 24


@dataclass(frozen=True)
class Arguments:
    """The whole main job on the bundled sample capture: check, train, evaluate, synthesize, report."""

    output: Path = Path("neeco-demo")
    """Folder to write to; must be empty or absent."""
    minutes: float = 2.0
    """How long to train."""
    device: Device = "auto"


def run(args: Arguments) -> int:
    """Do it all and say where everything lies."""
    from neeco.evaluation.image_metrics import find_lpips
    from neeco.raster.devices import device_of
    from neeco.training.run import open_run

    if not args.minutes > 0:
        raise NeecoError(f"--minutes must be above 0 (got {args.minutes})")
    if args.output.exists() and (not args.output.is_dir() or any(args.output.iterdir())):
        raise NeecoError(f"{args.output}: exists already; give another --output, or remove it")
    device = device_of(args.device)
    start = time.monotonic()
    capture, dataset = sample_capture(), args.output / "dataset"
    try:
        _check(capture)
        run_path = _train(capture, args.output / "run", args.minutes, device)
        networks = find_lpips()
        with open_run(run_path, device) as trained:
            _synthesize(trained, dataset)
            report = _evaluate(trained, networks)
    except KeyboardInterrupt:
        before = f"remove {args.output} and " if args.output.exists() else ""
        raise KeyboardInterrupt(f"{before}run the same command again") from None
    print(f"\nDone in {time.monotonic() - start:.0f} s.")
    for what, path in (
        ("capture", capture),
        ("learned scene", run_path),
        ("labelled data set", dataset),
        ("its preview", dataset / "preview.png"),
        ("report, open it in a browser", report),
    ):
        print(f"  {what}: {path.resolve()}")
    return 0


def sample_capture() -> Path:
    """The bundled sample's folder: inside the installed package, or in the checkout it is run from.

    Raises NeecoError when neither is there.
    """
    package = Path(__file__).resolve().parents[1]
    places = (package / "samples" / SAMPLE, package.parents[1] / "samples" / SAMPLE)
    for place in places:
        if (place / "transforms.json").is_file():
            return place
    raise NeecoError(f"{places[0]}: the sample capture is missing; install neeco again")


def _check(path: Path) -> None:
    from neeco.capture import check_capture, errors_only

    print(f"1/4 check {path}")
    problems = check_capture(path)
    for problem in problems:
        print(f"  {problem.severity}: {problem}")
    if errors := errors_only(problems):
        raise NeecoError(f"{path}: {len(errors)} problems in the sample capture; install neeco again")


def _train(capture: Path, output: Path, minutes: float, device: torch.device) -> Path:
    from dataclasses import replace

    from neeco.cli._progress import train_with_progress
    from neeco.training.config import method_defaults

    print(f"2/4 train for {minutes:g} minutes")
    config = replace(method_defaults("kinematic"), minutes=minutes)
    return train_with_progress(capture, output, config, device)


def _synthesize(trained: TrainedRun, output: Path) -> None:
    from neeco.cli._progress import counting
    from neeco.synthesis.dataset import synthesize
    from neeco.synthesis.settings import Settings

    print(f"3/4 synthesize {IMAGES} labelled images of states that were not recorded")
    with counting("synthesize", IMAGES) as advance:
        synthesize(trained.gaussians("synthesize"), output, Settings(count=IMAGES), ("coco", "yolo"), False, advance)


def _evaluate(trained: TrainedRun, networks: dict[str, Lpips]) -> Path:
    from neeco.evaluation.evaluate import evaluate_run
    from neeco.report.run_page import write_report
    from neeco.viewer.export import embedded_page

    print("4/4 evaluate on frames kept from training")
    capture = trained.capture()
    evaluation = evaluate_run(trained, capture, networks=networks)
    for split, numbers in evaluation["given"].items():
        iou = "" if numbers["mask_iou"] is None else f", mask IoU {numbers['mask_iou']:.3f}"
        print(f"  {split}: PSNR {numbers['psnr']:.2f} dB{iou}")
    return write_report(trained.path, evaluation, capture, trained.scene, playable=embedded_page(trained))
