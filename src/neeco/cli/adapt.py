"""`neeco adapt`: label frames of another operation with a learned scene."""

from __future__ import annotations

from neeco.studies.adaptation import AdaptRequest


def run(arguments: AdaptRequest) -> int:
    """Adapt with progress bars; print the verdict and where the data set is."""
    from neeco.api import adapt
    from neeco.cli._progress import Bars, resumable
    from neeco.studies.adaptation.adapt import INFO

    with Bars() as bars, resumable(arguments.output):
        adapted = adapt(**vars(arguments), progress=bars.stage)
    written = f"{adapted.accepted} of {len(adapted.records)} frames in {adapted.output}"
    print(f"{written}; all of them: {adapted.output / INFO}")
    print(f"verdict: {adapted.verdict}")
    return 0
