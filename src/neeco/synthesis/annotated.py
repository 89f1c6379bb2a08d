"""`neeco annotate`: recorded frames labelled by the scene, with the trust in each label.

Trust is the minimum of two estimates of the label's overlap (IoU) with the instrument: from the residual of the
rendering (`neeco.evaluation.trust`), which detects occlusion of the instrument; and from the pixels that show an
instrument (`neeco.evidence.label_quality`), which detects a wrongly learned shape.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture.model import Capture, Frame, State
from neeco.capture.writer import fingerprint
from neeco.evaluation.trust import Trust, TypicalErrors, estimate_trust, typical_errors_of
from neeco.evidence.foreground import Comparison, Foreground
from neeco.evidence.label_quality import QUALITY, label_counts, learned_foreground, quality_of
from neeco.geometry.distortion import field_pinhole
from neeco.labels.annotation import OUTSIDE, Keypoint, annotate
from neeco.labels.drawing import LayeredDrawing, draw_layers
from neeco.labels.labellers import CompositedLabels, Labeller, instruments_of
from neeco.raster.resampling import of_rendered_size, resampled
from neeco.scene import GaussianScene
from neeco.states.alignment import AlignConfig, AlignedFrame, align_frame, pose_changes
from neeco.synthesis.contact import labels_of
from neeco.synthesis.dataset import DataSetFolder, check_formats, check_output, description, with_image
from neeco.synthesis.samplers import DrawnCameras
from neeco.synthesis.settings import AS_RECORDED, DEFAULT_FORMATS, MIN_TRUST, ImageSettings, Settings, parse_class_names
from neeco.synthesis.writers import Record, encoded_sample, skipped_sample
from neeco.training.run import GaussianRun

N_REFERENCE_FRAMES = 16  # training frames from which the usual errors are estimated
FROM_NEIGHBOUR = AlignConfig(levels=(0.5, 1.0), steps=(2, 1))  # the start is close: no coarse level
MAX_UNRECORDED_SHARE = 0.01  # share of a pixel outside the recorded image, above which the pixel is ignored


@dataclass(frozen=True)
class Annotated:
    """The records of all frames; frames that are not trusted have no image."""

    output: Path
    capture: Capture
    records: list[Record]  # in the order of the capture's frames

    @property
    def written(self) -> int:
        """Number of frames that were trusted."""
        return len(with_image(self.records))


def annotate_capture(
    run: GaussianRun,
    output: Path,
    *,
    capture: Capture | None = None,
    min_trust: float = MIN_TRUST,
    formats: Sequence[str] = DEFAULT_FORMATS,
    images: ImageSettings = AS_RECORDED,
    class_names: Sequence[str] = (),
    resume: bool = False,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Annotated:
    """Label every frame of `capture`, a recording of the run's instruments over its tissue (None: the run's own), and
    write the trusted ones as a data set: recorded images with labels rendered at poses fitted to them, starting from
    the recorded pose or from the one fitted in training. Both are resized and distorted by the recording's lens as
    `images` requests; parts of the lens's field that the recorded image lacks, since undistortion cropped them, are
    black and ignored.

    Frame k of the capture is image k of the data set, whichever are written. Interrupted (Ctrl-C) or failing, it keeps
    completed work for `resume`. The caller sets the number of torch threads (`open_run`). Raises NeecoError for a scene
    without labels, a capture of other instruments, an invalid share, and an `output` that is not empty (without
    `resume`) or was made otherwise.
    """
    if not 0 <= min_trust <= 1:
        raise NeecoError(f"--min-trust: {min_trust} is not a share; give 0 to 1")
    scene = run.scene
    labeller = CompositedLabels(scene)
    trained_on = run.capture()
    source = scene.recorded.completed(capture, scene.instruments) if capture else scene.recorded.as_fitted(trained_on)
    capture = trained_on if capture is None else source
    place, joints = f"{capture.root}: instruments", {item.name: set(item.joints) for item in capture.instruments}
    for name, learned in ((item.name, set(item.joints)) for item in scene.instruments):
        if name not in joints:
            raise NeecoError(f"{place}: the scene learned {name!r}, here are: {', '.join(joints) or 'none'}")
        if missing := learned - joints[name]:
            raise NeecoError(f"{place}: {name}: no joint {min(missing)!r}, which the scene learned")
    settings = {"annotates": os.path.abspath(capture.root), "frames": len(capture.frames), "min_trust": min_trust}
    settings["captures_sha256"] = [fingerprint(recorded) for recorded in (capture, trained_on)]
    check_formats(formats, images)
    cameras = DrawnCameras.of(images, scene.recorded, (frame.camera for frame in capture.frames))
    first = capture.frames[0].camera
    settings |= images.image_identity(first.width, first.height) | {"class_names": list(class_names) or None}
    output = Path(output)
    info = description(run, settings)
    begun = check_output(output, info, resume)
    folder = DataSetFolder(
        output=output,
        count=len(capture.frames),
        begun=begun,
        info=info,
        scene=scene,
        labeller=labeller,
        formats=formats,
        class_names=parse_class_names(class_names, instruments_of(labeller.names)),
    )
    with folder.being_written() as records:
        train, drawings = trained_on.split("train"), []
        for k in range(min(N_REFERENCE_FRAMES, len(train))):
            frame = train[round(k * (len(train) - 1) / (N_REFERENCE_FRAMES - 1))]
            image = frame.load_image()
            drawings.append((fitted(scene, labeller, frame, image, None)[1], image, frame.load_mask()))
        typical = typical_errors_of(drawings)
        foreground = learned_foreground(scene, train)
        info["usual_errors"] = asdict(typical)
        annotator = _Annotator(folder, typical, foreground, min_trust, images, cameras)
        start: Tensor | None = None  # each fit starts from that of the previous frame in time
        in_time = sorted(range(len(capture.frames)), key=lambda k: capture.frames[k].state.time)
        for done, index in enumerate(in_time, 1):
            if index not in records:
                records[index] = annotator.annotate(index, source.frames[index], capture.frames[index].state, start)
            start = torch.tensor(records[index]["increments"], dtype=torch.float64)
            on_progress(done, len(in_time))
        if not with_image(records.values()):
            best = max(record["trust"]["value"] for record in records.values())
            raise NeecoError(
                f"--min-trust: no frame of {capture.root} is trusted by {min_trust}; the best is by {best}"
            )
    return Annotated(output, capture, [records[index] for index in sorted(records)])


@dataclass(frozen=True)
class _Annotator:
    """Fits, renders, evaluates and writes frames."""

    folder: DataSetFolder
    typical: TypicalErrors
    foreground: Foreground | None
    min_trust: float
    images: ImageSettings
    cameras: DrawnCameras

    def annotate(self, index: int, frame: Frame, recorded: State, start: Tensor | None) -> Record:
        """Write frame `index`, or a record that it is not trusted; `recorded`: its recorded state, if that of `frame`
        was fitted to the image in training; `start`: a neighbour's increments."""
        image = frame.load_image()
        fit, drawing, trust = self._fitted(frame, image, start)
        if start is not None and trust.value < self.min_trust:  # the neighbour's start may have misled the fit
            again = self._fitted(frame, image, None)
            fit, drawing, trust = max((again, (fit, drawing, trust)), key=lambda attempt: attempt[2].value)
        facts: dict[str, Any] = {
            "frame": frame.name,
            "recorded_split": frame.split,
            "trust": trust.to_json(),
            "moved": pose_changes(replace(frame, state=recorded), fit.state, fit.camera),
            "increments": fit.increments.tolist(),
        }
        scene, names, output = self.folder.scene, self.folder.labeller.names, self.folder.output
        if trust.value < self.min_trust:
            facts["labels"] = labels_of(scene, drawing, annotate(scene, drawing, names))
            return skipped_sample(index, {"not trusted": 1}, facts).write(output)
        drawing, missing = self._as_written(drawing, image)
        labels = annotate(scene, drawing, names)
        if missing is not None:  # no keypoints in pixels without image content
            for k, label in enumerate(labels):
                points = {
                    name: Keypoint(0.0, 0.0, OUTSIDE) if p.visibility and missing[int(p.y), int(p.x)] else p
                    for name, p in label.keypoints.items()
                }
                labels[k] = replace(label, keypoints=points)
        plain, quality = labels_of(scene, drawing, labels), self.images.jpeg_quality
        return encoded_sample(index, drawing, plain, facts=facts, quality=quality).write(output)

    def _as_written(self, drawing: LayeredDrawing, image: Tensor) -> tuple[LayeredDrawing, Tensor | None]:
        """Return the recorded `image` with the labels of `drawing`, at the requested size and lens, and the pixels of
        the lens's field without image content, bool [H, W]."""
        recorded = drawing.camera
        wanted = self.cameras(recorded)
        if wanted is recorded:
            return replace(drawing, image=image), None
        scene, labeller = self.folder.scene, self.folder.labeller
        drawing = draw_layers(scene, labeller, drawing.state, wanted, Settings.min_component)
        if wanted.is_pinhole:
            method = cv2.INTER_AREA if wanted.width < recorded.width else cv2.INTER_CUBIC
            pixels = cv2.resize(image.numpy(), (wanted.width, wanted.height), interpolation=method)
            return replace(drawing, image=torch.from_numpy(pixels).clamp(0, 1)), None
        fine = of_rendered_size(drawing.camera)
        field = field_pinhole(fine)
        in_field = resampled(torch.ones(field.height, field.width, 1), field, fine, wanted)[..., 0]
        rgba = torch.cat([image, torch.ones_like(image[..., :1])], -1)
        warped = resampled(rgba, recorded, fine, wanted)
        missing = warped[..., 3] < in_field - MAX_UNRECORDED_SHARE
        drawing = replace(
            drawing,
            image=warped[..., :3],
            parts=drawing.parts.masked_fill(missing, 0),
            share=drawing.share.masked_fill(missing, 0.0),
            unobserved=drawing.unobserved.masked_fill(missing, 1.0),
        )
        return drawing, missing

    def _fitted(self, frame: Frame, image: Tensor, start: Tensor | None) -> tuple[AlignedFrame, LayeredDrawing, Trust]:
        scene = self.folder.scene
        fit, drawing = fitted(scene, self.folder.labeller, frame, image, start)
        mask = frame.load_mask()
        trust = estimate_trust(drawing, image, mask, self.typical)
        if self.foreground is not None:
            view = Comparison.of(scene, fit.state, scene.recorded.as_learned(fit.camera), image, mask)
            quality = quality_of([label_counts(view, self.foreground)], QUALITY.least_shown)
            if quality is not None:
                trust = replace(trust, value=min(trust.value, quality.iou))
        return fit, drawing, trust


def fitted(
    scene: GaussianScene, labeller: Labeller, frame: Frame, image: Tensor, start: Tensor | None
) -> tuple[AlignedFrame, LayeredDrawing]:
    """Return the state of `frame` fitted to its image [H, W, 3], and the scene's rendering there; `start`: a
    neighbour's increments, without which the search starts coarse."""
    near = start is not None and not scene.recorded.error_scale  # with larger errors, neighbours differ too much
    fit = align_frame(scene, frame, image, start, FROM_NEIGHBOUR if near else None)
    return fit, draw_layers(scene, labeller, fit.state, fit.camera, Settings.min_component, tissue_image=True)
