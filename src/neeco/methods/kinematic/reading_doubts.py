"""Whether the readings of stated links drive what their names say: swapped logs and reversed signs pass every check of
numbers, but not the images."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import combinations

import torch
from torch import Tensor

from neeco.capture.model import Instrument
from neeco.methods.carving.evidence import POSSIBLE, Evidence, camera_from_instrument, score_points
from neeco.methods.kinematic.articulation.stated import StatedLinks
from neeco.methods.kinematic.link_seeds import link_motions
from neeco.training.session import GaussianSession

POINTS = 1500  # about each link
REACH_RADII, BESIDE_RADII = 4.0, 2.0  # how far about the pivots they lie
FRAMES = 80  # of the evidence
DOUBT = 1.15  # times the volume on evidence, from which other readings are believed
MIN_SEEN = 0.1  # share of the frames that must see a point

Readings = dict[str, float]


@torch.no_grad()
def doubt_readings(
    session: GaussianSession, links: StatedLinks, evidence: Evidence, instrument: Instrument, readings: list[Readings]
) -> None:
    """Warn, and note in `scene.diagnostics["doubted_readings"]`, where the links keep more of their volume on evidence
    with two readings exchanged or one's sign reversed. `readings`: those of every frame of the evidence."""
    volumes = _Volumes(links, evidence, instrument.name, readings, session.config.seed)
    named = volumes.with_readings(dict)
    recorded = [name for name in links.reading_names if name not in instrument.unrecorded]
    better: dict[float, tuple[tuple[str, ...], str]] = {}
    for one, other in combinations(recorded, 2):
        if instrument.slides(one) == instrument.slides(other):
            better[volumes.with_readings(partial(_exchanged, one, other))] = (
                (one, other),
                f"with the readings of {one} and {other} exchanged: which log is which?",
            )
    for name in recorded:
        better[volumes.with_readings(partial(_reversed, name))] = (
            (name,),
            f"with the sign of {name} reversed: is its axis, or its gain, the wrong way round?",
        )
    most = max(better, default=0.0)
    if most <= DOUBT * named:
        return
    names, words = better[most]
    session.report(
        f"warning: {instrument.name}: its links fit the images {most / max(named, 1):.1f} times as well {words}"
    )
    doubts = session.scene.diagnostics.setdefault("doubted_readings", {})
    doubts |= {f"{instrument.name}.{name}": f"the links fit the images better {words}" for name in names}


def _exchanged(one: str, other: str, given: Readings) -> Readings:
    return {**given, one: given[other], other: given[one]}


def _reversed(name: str, given: Readings) -> Readings:
    return {**given, name: -given[name]}


class _Volumes:
    """Of what stays on evidence, points of all links together."""

    def __init__(self, links: StatedLinks, evidence: Evidence, name: str, readings: list[Readings], seed: int) -> None:
        step = max(1, len(readings) // FRAMES)
        self.links, self.readings = links, readings[::step]
        self.evidence = evidence.subset(torch.arange(0, len(readings), step))
        self.camera_from_instrument = camera_from_instrument(self.evidence, name)  # [F, 4, 4]
        generator = torch.Generator().manual_seed(seed)
        self.points = [self._about(link, generator) for link in range(1, links.link_count)]

    def _about(self, link: int, generator: torch.Generator) -> Tensor:
        """[POINTS, 3] mm at rest."""
        radius = float(self.links.radius)
        centers, half = (part.cpu() for part in self.links.where(link, REACH_RADII * radius, BESIDE_RADII * radius))
        which = torch.randint(len(centers), (POINTS,), generator=generator)
        away = 2 * torch.rand(POINTS, 3, generator=generator) - 1
        return (centers[which] + away * half[which, None]).to(self.evidence.device)

    def with_readings(self, change: Callable[[Readings], Readings]) -> float:
        """In points."""
        moved = link_motions(self.links, [change(given) for given in self.readings])  # [F, L, 4, 4]
        total = 0.0
        for link, points in enumerate(self.points, 1):
            score, seen = score_points(self.evidence, self.camera_from_instrument @ moved[:, link], points)
            total += float((((score - POSSIBLE) / (1 - POSSIBLE)).clamp(0, 1) * (seen > MIN_SEEN)).sum())
        return total
