"""Prediction of the errors of new states from those of the training states.

A robot's calibration error depends on its joints; a tracker drifts with time. Learned corrections are interpolated
between states (a Gaussian process), but only if they predict held-out intervals of the recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neeco.capture.model import Frame, evenly_spaced
from neeco.scene.state_corrections import CORRECTIONS, StateCorrections, kernel
from neeco.states.refinement import Refinement


@dataclass(frozen=True, kw_only=True)
class PredictionSettings:
    """Settings of the prediction."""

    n_blocks: int = 6  # contiguous intervals of the recording for cross-validation
    min_instants: int = 12  # with fewer, nothing is predicted
    min_explained: float = 0.1  # minimum share of the corrections' variance; independent errors reach 0.06 by chance
    lengths: tuple[float, float, float, float] = (0.5, 1.0, 2.0, 4.0)  # of the kernel, in units of features
    # ratio of a single instant's noise variance to the kernel's
    noises: tuple[float, float, float, float] = (0.1, 0.3, 1.0, 3.0)
    jitter: float = 1e-6  # added to the kernel's diagonal
    # median absolute deviations of the corrections, without wrong states
    max_deviations: float = 8.0


PREDICTION = PredictionSettings()


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Verdict on the prediction of an instrument's pose corrections, or of those of a reading."""

    explained: float  # share of variance explained on held-out instants
    applied: bool  # whether new states are corrected


@torch.no_grad()
def predict_corrections(
    corrections: StateCorrections, refinement: Refinement, frames: Sequence[Frame]
) -> dict[str, Prediction]:
    """Fit `corrections` to the learned corrections of training frames, if states predict them, and subtract them from
    the training frames' own.

    Returns the verdict on each instrument's pose, under its name, and on its readings, under NAME.READING.
    """
    frame_of_instant: dict[int, int] = {}  # a frame of every instant
    for frame in (refinement.frame_steps > 0).nonzero()[:, 0].tolist():
        frame_of_instant.setdefault(refinement.instants[frame], frame)
    order = sorted(frame_of_instant, key=lambda instant: frames[frame_of_instant[instant]].state.time)
    predictions: dict[str, Prediction] = {}
    if len(order) < PREDICTION.min_instants:
        return predictions
    for index, name in enumerate(corrections.names):
        states = [frames[frame_of_instant[instant]].state.instruments[name] for instant in order]
        features = torch.stack([corrections.features(index, state) for state in states]).double().cpu()
        readings = corrections.readings[index]
        columns = [refinement.readings.index((name, reading)) for reading in readings]
        rows = torch.cat([refinement.poses[order, index], refinement.joints[order][:, columns]], 1).double().cpu()
        sigma = torch.cat([refinement.pose_sd[:, index].mean(0), refinement.joint_sd[:, columns].mean(0)])
        usual_rows = torch.ones(len(rows), dtype=torch.bool)
        if bool(refinement.fitted.any()):  # excluding wrong states
            off = (rows - rows.median(0).values).abs()
            usual_rows = (off <= PREDICTION.max_deviations * off.median(0).values.clamp_min(1e-9)).all(1)
        parts = {name: slice(0, 6)} | {f"{name}.{reading}": slice(6 + k, 7 + k) for k, reading in enumerate(readings)}
        residuals, usual, length, noise = _best(features[usual_rows], rows[usual_rows] / sigma.double().cpu())
        applied = torch.zeros(rows.shape[1], dtype=rows.dtype)
        for part, places in parts.items():
            total = float(usual[places].sum())
            explained = 1 - float(residuals[places].sum()) / total if total else 0.0
            predictions[part] = Prediction(explained=explained, applied=explained >= PREDICTION.min_explained)
            applied[places] = float(predictions[part].applied)
        learned, anchors = features[usual_rows], features[usual_rows]
        anchors = anchors[evenly_spaced(len(anchors), CORRECTIONS.max_anchors)]
        weights = _weights(learned, rows[usual_rows], anchors, length, noise) * applied
        corrections.anchors[index, : len(anchors)] = anchors.to(corrections.anchors)
        corrections.weights[index, : len(anchors), : weights.shape[1]] = weights.to(corrections.weights)
        corrections.lengths[index] = length
        for instant, state in zip(order, states, strict=True):
            increments = corrections.increments(index, state)
            refinement.poses[instant, index] -= increments[:6]
            refinement.joints[instant, columns] -= increments[6 : 6 + len(columns)]
    return predictions


def _best(features: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, float, float]:
    """Return the cross-validation of `rows` [n, K]: sums [K] of squared residuals of the prediction and of the mean,
    and the kernel's length and noise of the best prediction."""
    block = torch.arange(len(rows)) * PREDICTION.n_blocks // len(rows)
    folds = [(block == number, block != number) for number in range(PREDICTION.n_blocks)]
    usual = torch.stack([(rows[out] - rows[rest].mean(0)).square().sum(0) for out, rest in folds]).sum(0)
    tried = []
    for length in PREDICTION.lengths:
        for noise in PREDICTION.noises:
            error = torch.zeros_like(usual)
            for out, rest in folds:
                mean = rows[rest].mean(0)
                anchors = features[rest][evenly_spaced(int(rest.sum()), CORRECTIONS.max_anchors)]
                weights = _weights(features[rest], rows[rest] - mean, anchors, length, noise)
                error += (rows[out] - mean - kernel(features[out], anchors, length) @ weights).square().sum(0)
            tried.append((float(error.sum()), length, noise, error))
    _, length, noise, error = min(tried, key=lambda item: item[:3])
    return error, usual, length, noise


def _weights(features: Tensor, rows: Tensor, anchors: Tensor, length: float, noise: float) -> Tensor:
    """Return the weights [A, K] of kernels at `anchors` [A, F] fitted to `rows` [n, K] (subset of regressors)."""
    gram, across = kernel(anchors, anchors, length), kernel(anchors, features, length)
    return torch.linalg.solve(
        across @ across.T + noise * gram + PREDICTION.jitter * torch.eye(len(gram)).to(gram), across @ rows
    )
