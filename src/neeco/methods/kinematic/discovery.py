"""Discovery of instruments and their joints: carve each from the training frames, and seed Gaussians on its links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import evenly_spaced
from neeco.evidence.carving import CARVING, Evidence, carve_along, frame_along, pad_and_stack
from neeco.geometry.projection import project_world
from neeco.methods.breathing import BreathingTissue, find_breathing
from neeco.methods.kinematic.articulation import LINK_LOGITS, ArticulatedInstruments
from neeco.methods.kinematic.hinges import STATE_LINKS, STICKS, Hinges, start_hinges
from neeco.methods.kinematic.link_search import align_to_links, correct_poses, readings_of, start_links
from neeco.methods.kinematic.wrist_search import WRISTS, search_wrist
from neeco.methods.tissue_fit import carved_shape, fit_tissue, tissue_evidence
from neeco.raster.reference import SH_C0
from neeco.scene.canonical import CanonicalGaussians, join_bodies, seed_instrument
from neeco.scene.deformation import Deformation
from neeco.scene.gaussian_scene import GaussianScene
from neeco.states.outline_states import register_states
from neeco.training.session import GaussianSession


def find_instruments(
    session: GaussianSession, articulated: ArticulatedInstruments, *, wrists: bool
) -> dict[str, KinematicTree]:
    """Add every instrument's body to the session's scene, whose canonical set holds the tissue alone, and initialise
    its joints. With `wrists`, return instead the estimated links of instruments that have several joints and no stated
    kinematics, if the images support them; then nothing is added.

    `articulated` is the scene's deformation. Raises NeecoError when an instrument leaves no evidence in its own frame.
    """
    scene, report = session.scene, session.report
    if not scene.instruments:
        return {}
    report("searching for the instruments: fitting the tissue alone")
    tissue = fit_tissue(scene, session.views, session.config)
    if isinstance(articulated, BreathingTissue) and articulated.may_breathe and session.timed:
        tissue = _learn_breathing(session, articulated, tissue)
    evidence = tissue_evidence(scene, session.views, session.config, tissue)
    if wrists and (trees := _unstated_wrists(session, articulated, evidence)):
        return trees
    alone = len(scene.instruments) == 1 and articulated.articulations[0].stated
    corrects = alone and session.config.refine.frame_poses
    if corrects and register_states(session.views, session.refinement, scene.instruments[0]):
        evidence = _corrected_evidence(session, evidence)
    scene.canonical = _with_instruments(session, articulated, evidence)
    return {}


def _unstated_wrists(
    session: GaussianSession, articulated: ArticulatedInstruments, evidence: Evidence
) -> dict[str, KinematicTree]:
    """Return the estimated links of instruments with several moving joints and no kinematics, if the images support
    them; report either outcome."""
    generator, trees = torch.Generator().manual_seed(session.config.seed), {}
    for instrument, articulation in zip(session.scene.instruments, articulated.articulations, strict=True):
        readings = [frame.state.instruments[instrument.name].joints for frame in evidence.frames]
        logged = set.intersection(*map(set, readings))
        varying = {j for j in logged if np.ptp([row[j] for row in readings]) > STICKS.min_reading_range}
        moving = [joint for joint in articulation.reading_names if joint in varying]
        if len(moving) < 2 or articulation.stated:
            continue
        tree = None
        if len(moving) <= WRISTS.max_joints:
            session.report(f"{instrument.name}: searching for its links, as nothing states them: {', '.join(moving)}")
            shape = carved_shape(session, evidence, instrument.name, generator)
            # a wrist joint may correlate with the poses by chance
            unused = [joint for joint in instrument.left_out if joint in varying and not instrument.slides(joint)]
            tree = search_wrist(evidence, instrument.name, shape, readings, moving, unused[: WRISTS.max_others])
        if tree is None:
            session.report(
                f"warning: {instrument.name}: {', '.join(moving)}: several joints, no kinematics, and images show no "
                f"wrist that they turn; each is learned as a hinge across the shaft, which fits jaws; {STATE_LINKS}"
            )
        else:
            trees[instrument.name] = tree
            words = ", ".join(f"{link.name} turned by {' and '.join(link.value)}" for link in tree.links if link.value)
            session.report(f"{instrument.name}: images show its links: {words}; if that is wrong, {STATE_LINKS}")
    return trees


def carve_again(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Replace the instruments' Gaussians by seeds on shapes carved again with the states corrected so far, and discard
    what was learned with the former states. Where carving fails, the learned ones stay. The session's views are those
    of searches."""
    before, articulations = session.scene.canonical, {key: t.clone() for key, t in articulated.state_dict().items()}
    scene, breathing = session.scene, articulated.breathing if isinstance(articulated, BreathingTissue) else None
    scene.canonical = tissue = scene.canonical.map(
        lambda tensor: tensor[scene.canonical.body(0)].detach().clone(), scene.canonical.counts[:1]
    )
    with torch.enable_grad():  # tissue learned jointly with an instrument leaves larger residuals
        fitted = fit_tissue(scene, session.views, session.config, breathing=breathing)
        evidence = tissue_evidence(scene, session.views, session.config, fitted)
    if session.silhouettes is not None:
        hits = [session.silhouettes.instrument(number) for number in _view_numbers(session, evidence)]
        evidence = replace(evidence, hits=pad_and_stack(hits, 0.0).to(evidence.hits))
    evidence = _corrected_evidence(session, evidence)
    with torch.no_grad():
        shafts = [articulation.shaft() for articulation in articulated.articulations]
        axes = [articulation.axes(shaft) for articulation, shaft in zip(articulated.articulations, shafts, strict=True)]
        for articulation in articulated.articulations:
            articulation.shaft_tilt.zero_()
            articulation.shaft_shift.zero_()
        try:
            scene.canonical = _with_instruments(session, articulated, evidence, list(zip(shafts, axes, strict=True)))
        except NeecoError:  # no shape: too few frames, whose states are still wrong
            scene.canonical = before
            articulated.load_state_dict(articulations)
            session.report("carving the instruments anew finds no shape: they go on as learned")
            return
    rows = torch.arange(len(scene.canonical), device=scene.center.device)
    fresh = rows >= len(tissue)
    session.adam.select_rows(list(scene.canonical.tensors()), torch.where(fresh, 0, rows), fresh)
    session.begin_statistics()


def _with_instruments(
    session: GaussianSession,
    articulated: ArticulatedInstruments,
    recorded: Evidence,
    learned: Sequence[tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]] | None = None,
) -> CanonicalGaussians:
    """Return the Gaussians of the session's tissue and of every instrument on its carved shape, and initialise the
    joints. learned: shaft and axes of each instrument (see `Articulation`), which hinges keep; None: hinges are
    searched, and poses of stated links corrected."""
    scene, evidence = session.scene, recorded
    generator = torch.Generator().manual_seed(session.config.seed)
    bodies = [scene.canonical]
    for index, instrument in enumerate(scene.instruments):
        shape = carved_shape(session, evidence, instrument.name, generator)
        articulation = articulated.articulations[index]
        if articulation.stated:
            shape = align_to_links(session, articulation, evidence, instrument.name, shape, generator)
            articulation.radius.fill_(shape.radius)
            readings = readings_of(session, evidence, instrument.name)
            if learned is None and correct_poses(session, articulation, evidence, instrument, shape, readings):
                corrected = (replace(frame, state=scene.registered(frame.state)) for frame in recorded.frames)
                evidence = replace(recorded, frames=tuple(corrected))
                shape = carved_shape(session, evidence, instrument.name, generator)
                shape = align_to_links(session, articulation, evidence, instrument.name, shape, generator)
        elif learned is not None:  # carving few frames may mistake the rear end for the jaws
            base, settings = frame_along(*learned[index][0]), session.config.deformation.carving
            shape = carve_along(evidence, instrument.name, base, shape.level, generator, settings) or shape
        articulation.base.copy_(shape.instrument_from_shaft)
        articulation.extent.copy_(torch.tensor([shape.near, shape.tip]))
        articulation.radius.fill_(shape.radius)
        columns = articulated.logit_count
        if articulation.stated:
            seeds, logits = start_links(
                session, articulation, evidence, instrument.name, shape, columns=columns, generator=generator
            )
        else:
            assert isinstance(articulation, Hinges)
            axes = None if learned is None else learned[index][1]
            seeds, logits = start_hinges(
                session, articulation, evidence, instrument.name, shape, axes, columns=columns, generator=generator
            )
        chosen = evenly_spaced(len(seeds), session.limits[1])
        bodies.append(seed_instrument(seeds[chosen], shape.radius).with_extras(**{LINK_LOGITS: logits[chosen]}))
    _color_seeds(joined := join_bodies(bodies), session, articulated, evidence)
    return joined


def _color_seeds(
    canonical: CanonicalGaussians, session: GaussianSession, articulated: ArticulatedInstruments, evidence: Evidence
) -> None:
    """Give all seeds in a slice of a shaft one colour, from the images with most evidence: seeds much brighter than the
    images turn transparent before they darken, and individual colours let seeds next to the shaft persist."""
    assert isinstance(articulated, Deformation)
    pose, numbers = articulated.poser(canonical), _view_numbers(session, evidence)
    total = canonical.means.new_zeros(len(canonical), 4)  # of colours, and of weights
    for place in evenly_spaced(len(evidence.frames), CARVING.color_frames):
        frame = evidence.frames[place]
        points, depths = project_world(pose(frame.state).means, frame.camera)
        column, row = points.nan_to_num().floor().long().unbind(-1)
        seen = (depths > 0) & (column >= 0) & (column < frame.camera.width) & (row >= 0) & (row < frame.camera.height)
        pixels = row[seen], column[seen]
        weights, image = evidence.hits[place][pixels][:, None], session.views.target(numbers[place])
        total[seen] += torch.cat([weights * image[pixels], weights], 1)
    for index, articulation in enumerate(articulated.articulations):
        rows, base = canonical.body(index + 1), articulation.base
        along = (canonical.means[rows] - base[:3, 3]) @ base[:3, 2]
        slices = ((along - along.min()) / (CARVING.color_slice * articulation.radius)).floor().long()
        weighted = total[rows, 3:].square() * total[rows]
        unseen = CARVING.unseen_share * weighted.sum(0)
        sums = unseen.repeat(int(slices.max()) + 1, 1).index_add(0, slices, weighted)[slices]
        canonical.sh_dc[rows, 0] = (sums[:, :3] / sums[:, 3:].clamp_min(1e-9) - 0.5) / SH_C0


def _corrected_evidence(session: GaussianSession, evidence: Evidence) -> Evidence:
    """Return the evidence with the states corrected so far, without excluded frames."""
    scene, refinement, numbers = session.scene, session.refinement, _view_numbers(session, evidence)
    states = [scene.registered(refinement.state(k, f.state)) for k, f in zip(numbers, evidence.frames, strict=True)]
    frames = tuple(replace(frame, state=state) for frame, state in zip(evidence.frames, states, strict=True))
    remaining = [row for row, number in enumerate(numbers) if refinement.counts(number)]
    return replace(evidence, frames=frames).subset(torch.tensor(remaining))


def _view_numbers(session: GaussianSession, evidence: Evidence) -> list[int]:
    """Return the index, among the session's views, of each frame of the evidence."""
    numbers = {frame.name: number for number, frame in enumerate(session.views.frames)}
    return [numbers[frame.name] for frame in evidence.frames]


def _learn_breathing(session: GaussianSession, breathes: BreathingTissue, tissue: GaussianScene) -> GaussianScene:
    """Return `tissue`, a static fit; or, where the tissue breathes, a new fit with the estimated breathing, from which
    `breathes` then starts."""
    scene, views, config = session.scene, session.views, session.config
    begun = find_breathing(tissue, views)
    if begun is None:
        return tissue
    breathing, motion = begun
    session.report(f"the tissue breathes with a period of {motion.period:.2f} s: fitting it again")
    tissue = fit_tissue(scene, views, config, breathing=breathing)
    deformation = tissue.deformation
    assert isinstance(deformation, BreathingTissue)
    assert deformation.breathing is not None
    breathes.start_breathing(deformation.breathing)
    scene.diagnostics["breathing"] = deformation.breathing.describe(scene.recorded.cameras) | {
        "explained": round(motion.explained, 3)
    }
    return tissue
