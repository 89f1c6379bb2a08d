"""One image of a data set, from its index to its files: draw, judge, photograph, annotate, write."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.random import Generator

from neeco.errors import NeecoError
from neeco.labels.annotation import annotate
from neeco.labels.composited import CompositedLabels
from neeco.labels.drawing import Labeller, LayeredDrawing, draw_layers
from neeco.labels.threshold import DeltaThresholds, ThresholdLabels
from neeco.synthesis.acceptance import Acceptance, find_tolerance
from neeco.synthesis.effects import CameraEffects, read_effects
from neeco.synthesis.indexes import counted
from neeco.synthesis.mixing import MixedSampler, Mixture
from neeco.synthesis.motion import MixedMotion, RecordedMotion, exposure
from neeco.synthesis.optics import image_circle, mean_light, through_camera
from neeco.synthesis.samplers import Sampler, make_sampler
from neeco.synthesis.settings import Settings
from neeco.synthesis.writers.folder import Record, write_sample, write_skipped

if TYPE_CHECKING:
    from neeco.scene import Scene

EFFECTS_STREAM = 1  # of the random numbers of an image: what is drawn does not depend on how it is photographed


@dataclass(frozen=True)
class Maker:
    """Makes the images of one data set. Image `index` depends on scene, settings and index alone."""

    scene: Scene
    labeller: Labeller
    sampler: Sampler | MixedSampler
    acceptance: Acceptance
    settings: Settings
    effects: CameraEffects | None = None
    motion: RecordedMotion | MixedMotion | None = None  # where effects open a shutter
    gains: tuple[tuple[float, float, float], ...] = ()  # by which the colours of each cast were multiplied

    @classmethod
    def of(cls, scene: Scene, settings: Settings, casts: Sequence[Scene] = ()) -> Maker:
        """What `settings` ask for: images of `scene`, or of its tissue under the instruments of `casts`. Raises
        NeecoError where the scenes cannot give it."""
        sampler: Sampler | MixedSampler
        together: tuple[frozenset[str], ...] = ()
        mixture = Mixture.of(scene, casts) if casts else None
        if mixture is None:
            sampler = make_sampler(scene, settings.states, settings.margin, settings.views, settings.count)
        else:
            scene, sampler = mixture.scene, mixture.sampler(settings)
            together = tuple(frozenset(instrument.name for instrument in cast.instruments) for cast in casts)
        labeller = make_labeller(scene, settings)
        effects, motion = None, None
        if settings.camera_effects is not None:
            effects = read_effects(Path(settings.camera_effects))
            motion = _motion(scene if mixture is None else mixture.tissue, casts, settings) if effects.moves else None
        acceptance = replace(make_acceptance(scene, labeller, settings), casts=together)
        gains = () if mixture is None else mixture.gains
        return cls(scene, labeller, sampler, acceptance, settings, effects, motion, gains)

    def make(self, output: Path, index: int) -> Record:
        """Draw, judge and write image `index`; returns its record.

        A random state is drawn again until one is acceptable, `settings.tries` times at most, then NeecoError. A
        prescribed state is only tried from other views, and skipped when none is acceptable.
        """
        settings = self.settings
        rng = np.random.default_rng(np.random.SeedSequence([settings.seed, index, EFFECTS_STREAM]))
        values = {} if self.effects is None else self.effects.draw(rng)
        drawing, refused = self._first_acceptable(index, values)
        if drawing is not None:
            labels = annotate(self.scene, drawing, self.labeller.names)
            facts: dict[str, Any] = {} if self.effects is None else {"camera_effects": values}
            return write_sample(output, index, self._photographed(drawing, values, rng), labels, refused, facts)
        if self.sampler.prescribed:
            return write_skipped(output, index, refused)
        raise NeecoError(
            f"{output}: image {index}: no acceptable state in {settings.tries} tries ({counted(refused)}); "
            "use --states inside, a smaller --margin, --no-tissue-check or --resume with more --tries"
        )

    def _first_acceptable(self, index: int, values: dict[str, float]) -> tuple[LayeredDrawing | None, Counter[str]]:
        rng = np.random.default_rng(np.random.SeedSequence([self.settings.seed, index]))
        refused: Counter[str] = Counter()
        for _ in range(1 if self.sampler.fixed(index) else self.settings.tries):
            state, camera = self.sampler(index, rng)
            drawing = draw_layers(self.scene, self.labeller, state, camera, self.settings.speckle)
            if "field_of_view" in values:
                drawing = _within_circle(drawing, values["field_of_view"])
            reason = self.acceptance.why_refused(self.scene, drawing)
            if reason is None:
                return drawing, refused
            refused[reason] += 1
        return None, refused

    def _photographed(self, drawing: LayeredDrawing, values: dict[str, float], rng: Generator) -> LayeredDrawing:
        """The drawing as a camera with these effects sees it; labels stay those of the middle of the exposure."""
        if self.effects is None or not values:
            return drawing
        drawing = self._exposed(drawing, values.get("shutter_s", 0.0), rng)
        if "field_of_view" in values:
            drawing = _within_circle(drawing, values["field_of_view"])
        image = through_camera(drawing.image.numpy(), drawing.depth, values, rng)
        return replace(drawing, image=torch.from_numpy(np.ascontiguousarray(image)))

    @torch.no_grad()
    def _exposed(self, drawing: LayeredDrawing, shutter_s: float, rng: Generator) -> LayeredDrawing:
        if self.motion is None or shutter_s <= 0:
            return drawing
        assert self.effects is not None
        going = self.motion(drawing.state, rng)
        images, shares = [], []
        for state, camera in exposure(self.scene, drawing, going, shutter_s):
            gaussians = self.scene.at(state)
            rendering, _, share = self.labeller.draw(gaussians, camera, self.labeller.owners(state, gaussians))
            images.append(rendering.color.clamp(0, 1).cpu().numpy())
            shares.append(share.clamp(0, 1).cpu())
        drawing = replace(drawing, image=torch.from_numpy(mean_light(images)))
        return drawing if self.effects.soft_masks == "mid" else replace(drawing, share=torch.stack(shares).mean(0))


def make_labeller(scene: Scene, settings: Settings) -> Labeller:
    """The way of labelling that the settings ask for."""
    if settings.labels == "composited":
        return CompositedLabels(scene, settings.label_threshold)
    given = settings.delta_thresholds
    return ThresholdLabels(scene, None if given is None else DeltaThresholds(*given))


def make_acceptance(scene: Scene, labeller: Labeller, settings: Settings) -> Acceptance:
    """What the settings ask of a drawn state; the tolerance is found from the recording where it is not given."""
    tolerance = settings.tissue_tolerance_mm
    if tolerance is None and settings.tissue_check:
        tolerance = find_tolerance(scene, labeller)
    return Acceptance(settings.min_share, tolerance if settings.tissue_check else None, settings.max_unseen)


def _motion(scene: Scene, casts: Sequence[Scene], settings: Settings) -> RecordedMotion | MixedMotion:
    """How things go on while a shutter is open. Raises NeecoError where the recordings do not tell."""
    recorded = scene.recorded
    motion = MixedMotion(recorded, [cast.recorded for cast in casts]) if casts else RecordedMotion(recorded)
    if not motion.known:
        raise NeecoError(
            f"{settings.camera_effects}: shutter_s: no two recorded frames are close enough in time to tell how "
            "anything moved; leave it out"
        )
    return motion


def _within_circle(drawing: LayeredDrawing, radius: float) -> LayeredDrawing:
    """Labelled only where the camera's image circle shows anything."""
    height, width = drawing.depth.shape
    shown = torch.from_numpy(image_circle(height, width, radius) > 0.5)
    return replace(
        drawing, parts=torch.where(shown, drawing.parts, 0).to(drawing.parts.dtype), share=drawing.share * shown
    )
