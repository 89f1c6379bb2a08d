"""Kinematic trees of instruments whose joints are named and logged, but whose axes nobody stated, from images alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from neeco.capture.kinematics import PRISMATIC, REVOLUTE, KinematicTree, Link
from neeco.capture.model import Instrument
from neeco.training.instruments.chain_search import ChainFound, find_chain
from neeco.training.instruments.chain_volume import ChainEvidence
from neeco.training.instruments.color_evidence import clear_by_color
from neeco.training.instruments.discovery import DENSITY_START, fit_tissue, tissue_evidence
from neeco.training.instruments.evidence import (
    POSSIBLE,
    CarvedShape,
    Evidence,
    camera_from_instrument,
    carve,
    carve_along,
    frame_along,
    gather_evidence,
)
from neeco.training.instruments.trocar import trocar_line
from neeco.training.session import GaussianSession

ROOT = "shaft"
UNITS = ("_rad", "_deg", "_mm", "_angle")  # endings of readings that links' names do without
MAX_OFF = 0.1  # of the distance to the tissue: the trocar's line may pass the carved shape at most so far
MASKED, MARGIN = 0.3, 3  # evidence from which a pixel, and those so many px about it, are no tissue
WELL_SEEN = 0.4  # of the shaft's length, before which no joint is looked for: it is seen too rarely


def find_trees(session: GaussianSession) -> tuple[Instrument, ...] | None:
    """The instruments of the session's scene, those of which several readings move and no kinematics are stated with
    the trees that were found, or of one joint with that reading alone; None where there are none such.

    An instrument of which nothing was found stays as it is.
    """
    instruments = session.scene.instruments
    if not any(_is_unknown(instrument) for instrument in instruments):
        return None
    names = ", ".join(instrument.name for instrument in instruments if _is_unknown(instrument))
    session.report(f"{names}: several joints and no kinematics: looking for the joints' axes in the images")
    with session.searching():
        evidence = tissue_evidence(session.scene, session.views, session.config)
        evidence = clear_by_color(evidence, session.views)
        evidence = clear_by_color(_fitted_again(session, evidence), session.views)
        return tuple(_with_tree(session, evidence, item) if _is_unknown(item) else item for item in instruments)


def _fitted_again(session: GaussianSession, evidence: Evidence) -> Evidence:
    """Evidence after a longer fit of the tissue in the same frames that leaves out where it was before, lest the fit
    take parts of instruments in."""
    views, masks = session.views, []
    places = {frame.name: index for index, frame in enumerate(views.frames)}
    chosen = [places[frame.name] for frame in evidence.frames]
    for index, hits in zip(chosen, evidence.hits, strict=True):
        height, width = views.images[index].shape[:2]
        near = max_pool2d(hits[None, :height, :width], 2 * MARGIN + 1, 1, MARGIN)[0]
        mask = views.mask(index)
        masks.append(near < MASKED if mask is None else (near < MASKED) & mask)
    images = tuple(views.images[index] for index in chosen)
    fitted = replace(views, frames=evidence.frames, images=images, masks=tuple(masks))
    steps = session.config.search.long_tissue_steps
    tissue = fit_tissue(session.scene, fitted, session.config, steps, DENSITY_START)
    given = replace(fitted, masks=tuple(views.masks[index] for index in chosen))
    return gather_evidence(tissue, given, replace(session.config.search, evidence_frames=len(chosen)))


def _is_unknown(instrument: Instrument) -> bool:
    return instrument.kinematics is None and len(instrument.joints) > 1


def _with_tree(session: GaussianSession, evidence: Evidence, instrument: Instrument) -> Instrument:
    name, report = instrument.name, session.report
    shape = _shaft(session, evidence, name)
    if shape is None:
        report(f"warning: {name}: no shaft was found in the images; its joints are learned as hinges across one")
        return instrument
    base = shape.instrument_from_shaft
    recorded = [frame.state.instruments[name].joints for frame in evidence.frames]
    given = {joint: torch.tensor([joints[joint] for joints in recorded]).float() for joint in instrument.joints}
    middles = {joint: float(readings.double().mean()) for joint, readings in given.items()}
    known = ChainEvidence(
        evidence,
        camera_from_instrument(evidence, name) @ base,
        {joint: (readings - middles[joint]).to(evidence.device) for joint, readings in given.items()},
        shape.radius,
        session.config.seed,
    )
    slides = [joint for joint in instrument.joints if instrument.slides(joint)]
    near = shape.near + WELL_SEEN * (shape.tip - shape.near)
    found = find_chain(known, slides, near, shape.tip, lambda text: report(f"{name}: {text}"))
    verdicts = session.scene.diagnostics.setdefault("kinematics", {})
    for reading, verdict in _verdicts(found, base).items():
        verdicts[f"{name}.{reading}"] = {"verdict": f"{reading} {verdict}"}
        report(f"{'warning: ' if reading in found.left_out else ''}{name}: joint {reading} {verdict}")
    if not found.findings:
        report(f"warning: {name}: no joint was found; its joints are learned as hinges across the shaft")
        return instrument
    moving = {joint: limits for joint, limits in instrument.joints.items() if joint not in found.left_out}
    if len(moving) == 1 and not found.chain[0].slides:
        return replace(instrument, joints=moving)  # a hinge, which has a search of its own
    return replace(instrument, joints=moving, kinematics=tree_of(found, base, middles))


def _shaft(session: GaussianSession, evidence: Evidence, name: str) -> CarvedShape | None:
    """The shaft along the line through a trocar, where the poses show one that runs through what is carved; else as
    carved. None where nothing is."""
    search = session.config.search
    generator = torch.Generator().manual_seed(session.config.seed)
    shape = carve(evidence, name, generator, search)
    if shape is None:
        return None
    most, _ = Counter(frame.state.tissue for frame in session.views.frames).most_common(1)[0]  # a trocar of one world
    frames = [frame for frame in session.views.frames if frame.state.tissue == most]
    poses = [frame.state.instruments[name].pose.double().cpu() for frame in frames]
    line = trocar_line(torch.stack(poses).numpy())
    base = shape.instrument_from_shaft
    if line is not None and line.clear:
        center = base[:3, 3]
        point, along = (torch.from_numpy(part).to(center) for part in (line.point, line.direction))
        arm = center - point
        along = along * torch.sign(arm @ along)
        on_line = point + (arm @ along) * along
        if float((center - on_line).norm()) < MAX_OFF * evidence.distance:
            session.report(
                f"{name}: the shaft's line is where its poses pass one point, the trocar: {line.off:.2f} mm off it, "
                f"sliding by {line.slide:.0f} mm"
            )
            return carve_along(evidence, name, frame_along(on_line, along), POSSIBLE, generator, search)
    session.report(f"{name}: its poses show no trocar; the shaft's line is as it is carved from the images")
    return carve_along(evidence, name, base, POSSIBLE, generator, search)


def tree_of(found: ChainFound, instrument_from_shaft: Tensor, middles: Mapping[str, float]) -> KinematicTree:
    """The tree of a chain, at rest where all readings are at their `middles`."""
    base = instrument_from_shaft.double().cpu().numpy()
    links = [Link(ROOT)]
    parent, last = ROOT, np.zeros(3)
    for joint in found.chain:
        pivot = base[:3, :3] @ joint.pivot.double().cpu().numpy() + base[:3, 3]
        axis = base[:3, :3] @ joint.axis.double().cpu().numpy()
        origin = np.eye(4)
        origin[:3, 3] = pivot - last
        names = _link_names(joint.parts[0][-1][0], len(joint.parts), [link.name for link in links])
        for name, part in zip(names, joint.parts, strict=True):
            offset = -sum(gain * middles[reading] for reading, gain in part)
            kind = PRISMATIC if joint.slides else REVOLUTE
            links.append(Link(name, parent, kind, origin, axis / np.linalg.norm(axis), dict(part), offset))
        parent, last = names[0], pivot
    return KinematicTree(tuple(links))


def _link_names(reading: str, count: int, taken: Sequence[str]) -> list[str]:
    """Of the one link, or the left and right jaw, that a reading moves: as the reading is called, without its unit."""
    stem = reading
    for unit in UNITS:
        stem = stem.removesuffix(unit) or stem
    sides = ("_left", "_right") if count > 1 else ("",)
    names = [stem + side for side in sides]
    return [reading + side for side in sides] if set(names) & set(taken) else names


def _verdicts(found: ChainFound, base: Tensor) -> dict[str, str]:
    """By reading what was found of it, or that nothing was."""
    verdicts = {}
    for finding in found.findings:
        joint = next(joint for joint in found.chain if any(finding.reading in dict(part) for part in joint.parts))
        pivot = [round(float(v), 1) for v in base[:3, :3] @ joint.pivot + base[:3, 3]]
        axis = [round(float(v), 2) for v in base[:3, :3] @ joint.axis]
        if finding.opens is not None:
            does = f"opens two jaws about the axis of {finding.opens}"
        elif joint.slides:
            does = f"slides along {axis} from {pivot} mm on"
        else:
            does = f"{'opens two jaws' if finding.opens_jaws else 'turns'} about {axis} at {pivot} mm"
        sure = f"explains {finding.explained:.1f} mm^3 of the images' evidence, {finding.by_chance:.1f} if exchanged"
        verdicts[finding.reading] = f"found: {does}; {sure}"
    nothing = "was NOT found: its readings explain nothing in the images, so it moves no part"
    return verdicts | dict.fromkeys(found.left_out, nothing)
