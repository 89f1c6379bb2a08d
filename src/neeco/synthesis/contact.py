"""Contact of instruments with the tissue: depth of a working end below the rendered surface of the undeformed tissue.

Distances are those to planes through the nearest surface points (Hoppe et al., "Surface reconstruction", 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.special import ndtr
from torch import Tensor

from neeco.capture.model import evenly_spaced
from neeco.geometry.projection import project_world
from neeco.geometry.rotations import quat_to_matrix
from neeco.labels.annotation import InstrumentLabel
from neeco.labels.drawing import LayeredDrawing, keypoint_arrays, surface_depth, to_numpy
from neeco.labels.settings import LABELS
from neeco.raster import rasterize
from neeco.scene import GaussianScene
from neeco.synthesis.samplers import surface_points
from neeco.synthesis.tissue_replacement import tissue_gaussians
from neeco.synthesis.writers import CONTACT as FIELDS

NONE, TOUCHING, GRASPING = "none", "touching", "grasping"


class RestingTissue:
    """Surface of a scene's undeformed tissue (world, mm), and the parts of its instruments that may touch it; and the
    thresholds of contact labels, chosen on rendered worlds with contact between instruments and tissue."""

    n_views: ClassVar[int] = 12  # recorded cameras that observe the surface
    spacing_mm: ClassVar[float] = 1.0  # of surface points
    n_nearest: ClassVar[int] = 8  # surface points per plane
    reach_mm: ClassVar[float] = 10.0  # radius of the tissue around a contact; also the maximum distance measured
    end_mm: ClassVar[float] = 15.0  # radius of the working end around the tips
    n_measured: ClassVar[int] = 100  # Gaussians sampled per working end
    quantile: ClassVar[float] = 0.97  # quantile of their depths, robust to single outliers
    touching_mm: ClassVar[float] = -1.5  # where contact has probability 1/2; tissue learned in contact is indented
    depth_sd_mm: ClassVar[float] = 6.0  # standard deviation of a depth, calibrated for correct confidences
    joint_quantiles: ClassVar[tuple[float, float]] = (0.05, 0.95)  # a range of recorded values without outliers
    closed_share: ClassVar[float] = 0.25  # share of the range of the jaws' opening, below which they are closed
    of: ClassVar[WeakKeyDictionary[GaussianScene, RestingTissue]] = WeakKeyDictionary()  # cache

    def __init__(self, scene: GaussianScene) -> None:
        recorded, tissue = scene.recorded, tissue_gaussians(scene)
        chosen = evenly_spaced(len(recorded.cameras), RestingTissue.n_views, floor=True)
        cameras = [recorded.cameras[k].scaled(recorded.scale) for k in chosen]
        seen = np.concatenate([surface_points(surface_depth(rasterize(tissue, view)), view, 1) for view in cameras])
        self.points = seen[np.unique(np.floor(seen / RestingTissue.spacing_mm), axis=0, return_index=True)[1]]  # [P, 3]
        self.tree = cKDTree(self.points)
        self.eye = np.mean([to_numpy(view.world_from_camera)[:3, 3] for view in cameras], axis=0)
        posed, keypoints = scene.at(recorded.states[0]), keypoint_arrays(scene, recorded.states[0])
        self.rows: dict[str, Tensor] = {}  # of the opaque Gaussians of each instrument's working end
        bodies = [item.name for item in scene.instruments]
        for name, points in keypoints.items():
            of_instrument = scene.canonical.bodies == 1 + bodies.index(name)
            solid = (of_instrument & (posed.opacities > LABELS.surface_alpha)).nonzero()[:, 0]
            tips = [point for key, point in points.items() if key.startswith("tip")] or list(points.values())[-1:]
            near = cdist(to_numpy(posed.means[solid]), tips).min(1) < RestingTissue.end_mm
            if near.any():
                rows = solid[torch.from_numpy(near).to(solid.device)]
                self.rows[name] = rows[evenly_spaced(len(rows), RestingTissue.n_measured)]
        self.closed: dict[str, tuple[str, float, float]] = {}  # joint, its values at closed and at open jaws
        for item in scene.instruments:
            jaws = [joint for joint in item.joints if "jaw" in joint or "grip" in joint] or list(item.joints)
            if len(jaws) == 1:  # the end of its range nearer to 0 is closed
                values = [float(state.instruments[item.name].joints[jaws[0]]) for state in recorded.states]
                low, high = np.quantile(values, RestingTissue.joint_quantiles).tolist()
                self.closed[item.name] = (jaws[0], *sorted((low, high), key=abs))


def labels_of(scene: GaussianScene, drawing: LayeredDrawing, labels: Sequence[InstrumentLabel]) -> list[dict[str, Any]]:
    """Return the labels of a rendering with their contacts, as plain values for files."""
    return [label.to_json() | contact_of(scene, drawing, label.name) for label in labels]


@torch.no_grad()
def contact_of(scene: GaussianScene, drawing: LayeredDrawing, name: str) -> dict[str, Any]:
    """Return the contact of an instrument with the resting tissue in a rendered state; {} if its working end is
    unknown.

    contact: "none", "touching", or "grasping", which is touching with closed jaws. contact_confidence in [0.5, 1]: the
    probability of the stated contact or absence of it. penetration_mm: depth below the surface along its normal, a
    quantile over the working end's opaque Gaussians (one standard deviation thick); negative: distance above it, at
    most `reach_mm`. contact_box: x, y, width, height (px) of the tissue within `reach_mm`; None: no contact.
    """
    keypoints = drawing.keypoints.get(name)
    tissue = keypoints and (RestingTissue.of.get(scene) or RestingTissue.of.setdefault(scene, RestingTissue(scene)))
    if not tissue or name not in tissue.rows:
        return {}
    state, posed, rows = drawing.state.instruments[name], drawing.posed, tissue.rows[name]
    points = to_numpy(posed.means[rows])
    axes = to_numpy(quat_to_matrix(posed.quats[rows]) * posed.scales[rows, None])  # columns, one standard deviation
    distances, nearest = tissue.tree.query(points, RestingTissue.n_nearest, distance_upper_bound=RestingTissue.reach_mm)
    measured = np.isfinite(distances).all(1)
    planes = tissue.points[nearest[measured]]  # [M, n_nearest, 3]
    offsets = planes - (middles := planes.mean(1))[:, None]
    normals, depths = np.zeros_like(points), np.full(len(points), -RestingTissue.reach_mm)
    across = np.linalg.eigh(np.einsum("mki,mkj->mij", offsets, offsets))[1][..., 0]
    normals[measured] = across * np.sign(((middles - tissue.eye) * across).sum(1, keepdims=True))
    depths[measured] = ((points[measured] - middles) * normals[measured]).sum(1)
    depths += np.linalg.norm(np.einsum("mij,mi->mj", axes, normals), axis=1)
    deepest = np.argsort(depths)[round(RestingTissue.quantile * (len(depths) - 1))]
    depth, point, normal, deviations = depths[deepest], points[deepest], normals[deepest], [RestingTissue.depth_sd_mm]
    if state.uncertainty is not None:  # translations in the camera's axes, rotations about the instrument's
        pose, along = to_numpy(state.pose), drawing.camera.camera_from_world[:3, :3] @ normal
        turned = np.cross(point - pose[:3, 3], normal) @ pose[:3, :3]  # mm/rad
        shifts, turns = state.uncertainty.translation_mm, np.radians(state.uncertainty.rotation_deg)
        deviations += [*(along * shifts), *(turned * turns)]
    touches = float(ndtr((depth - RestingTissue.touching_mm) / np.linalg.norm(deviations)))
    contact, box = NONE, None
    if touches > 0.5:
        joint, closed, opened = tissue.closed.get(name, ("", 0.0, 0.0))
        opening = (float(state.joints[joint]) - closed) / (opened - closed) if opened != closed else np.inf
        contact = GRASPING if opening <= RestingTissue.closed_share else TOUCHING
        reached = tissue.points[tissue.tree.query_ball_point(point, RestingTissue.reach_mm)]
        pixels = project_world(reached, drawing.camera, nearest=drawing.camera.near)[0]
        ends = np.floor(pixels.min(0)), np.ceil(pixels.max(0))
        low, high = np.clip(ends, 0, (drawing.camera.width, drawing.camera.height))
        box = [int(value) for value in (*low, *(high - low))]
    return dict(zip(FIELDS, (contact, round(max(touches, 1 - touches), 4), round(float(depth), 2), box), strict=True))
