"""`neeco demo`: the complete workflow on the bundled sample, with the other verbs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from neeco.base.errors import NeecoError
from neeco.base.settings import Device

SAMPLE = "liver-mini"
IMAGES = 24


@dataclass(frozen=True)
class Arguments:
    """The complete workflow on the bundled sample capture: check, train, evaluate, synthesize, report."""

    output: Path = Path("neeco-demo")
    """Folder to write to; must be empty or absent."""
    minutes: float = 2.0
    """Training time, minutes."""
    device: Device = "auto"


def run(args: Arguments) -> int:
    """Run all steps and print the paths of the results."""
    from neeco.cli import check, evaluate, synthesize, train
    from neeco.raster.devices import device_of
    from neeco.synthesis.settings import Settings

    if not args.minutes > 0:
        raise NeecoError(f"--minutes must be above 0 (got {args.minutes})")
    if args.output.exists() and (not args.output.is_dir() or any(args.output.iterdir())):
        raise NeecoError(f"{args.output}: already exists; give another --output, or remove it")
    device_of(args.device)
    start = time.monotonic()
    capture, trained, dataset = sample_capture(), args.output / "run", args.output / "dataset"
    try:
        print(f"1/4 check {capture}")
        if check.run(check.Arguments(capture)):
            raise NeecoError(f"{capture}: the sample capture has errors; install neeco again")
        print(f"2/4 train for {args.minutes:g} minutes")
        train.run(train.Arguments(capture=capture, output=trained, minutes=args.minutes, device=args.device))
        print(f"3/4 synthesize {IMAGES} labelled images of states that were not recorded")
        settings = Settings(count=IMAGES)
        synthesize.run(
            synthesize.Arguments(run=trained, output=dataset, settings=settings, force=True, device=args.device)
        )
        print("4/4 evaluate on frames kept from training")
        evaluate.run(evaluate.Evaluate(run=trained, device=args.device))
    except KeyboardInterrupt:
        before = f"remove {args.output} and " if args.output.exists() else ""
        raise KeyboardInterrupt(f"{before}run the same command again") from None
    print(f"\nDone in {time.monotonic() - start:.0f} s.")
    for title, path in (
        ("capture", capture),
        ("learned scene", trained),
        ("labelled data set", dataset),
        ("its preview", dataset / "preview.png"),
        ("report, open it in a browser", trained / "report.html"),
    ):
        print(f"  {title}: {path.resolve()}")
    return 0


def sample_capture() -> Path:
    """Return the bundled sample's folder, in the installed package or in the source checkout.

    Raises NeecoError if neither exists.
    """
    package = Path(__file__).resolve().parents[1]
    places = (package / "samples" / SAMPLE, package.parents[1] / "samples" / SAMPLE)
    for place in places:
        if (place / "transforms.json").is_file():
            return place
    raise NeecoError(f"{places[0]}: the sample capture is missing; install neeco again")
