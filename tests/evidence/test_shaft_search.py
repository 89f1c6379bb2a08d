"""A shaft that turns about a trocar: where its rear is, and which line it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from neeco.capture.model import Camera, Frame, InstrumentState, State
from neeco.evidence.carving import CarvingSettings, Evidence, carve
from neeco.geometry.rotations import rigid

TROCAR = np.array([110.0, 20.0, 130.0])  # mm, camera frame
SEEN_MM = 45.0  # of the shaft, before a camera that sees both ends


def rod(frames: int = 24) -> tuple[Evidence, float]:
    """Silhouettes of a rod that goes through a trocar and points towards the camera, with both ends in view, along z
    of its tracked frame, which is in its middle; and the mean cosine between its direction and the view."""
    rng = np.random.default_rng(0)
    camera = Camera(torch.eye(4), 200.0, 200.0, 80.0, 64.0, 160, 128)
    local = np.concatenate([rng.normal(0, 1.5, (6000, 2)), rng.uniform(-SEEN_MM / 2, SEEN_MM / 2, (6000, 1))], 1)
    hits, taken, cosines = [], [], []
    for number in range(frames):
        middle = np.array([rng.uniform(-18, 12), rng.uniform(-16, 16), rng.uniform(75, 95)])
        ahead = (middle - TROCAR) / np.linalg.norm(middle - TROCAR)
        aside = np.cross(ahead, [0.0, 1.0, 0.0])
        aside /= np.linalg.norm(aside)
        pose = rigid(np.stack([aside, np.cross(ahead, aside), ahead], 1), middle)
        points = local @ pose[:3, :3].T + pose[:3, 3]
        u = (points[:, 0] / points[:, 2] * camera.fx + camera.cx).astype(int)
        v = (points[:, 1] / points[:, 2] * camera.fy + camera.cy).astype(int)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        mask = torch.zeros(camera.height, camera.width)
        mask[v[inside], u[inside]] = 1
        hits.append(torch.nn.functional.max_pool2d(mask[None], 3, 1, 1)[0])
        state = State({"tool": InstrumentState(torch.from_numpy(np.asarray(pose)), {})})
        taken.append(Frame(Path(f"{number}.png"), camera, state, "train"))
        cosines.append(ahead[2])
    evidence = Evidence(
        torch.stack(hits),
        torch.full((frames, camera.height, camera.width), 150.0),
        torch.eye(4).repeat(frames, 1, 1),
        torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy]]).repeat(frames, 1),
        tuple(taken),
    )
    return evidence, float(np.mean(cosines))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_tip_is_away_from_the_trocar_even_where_it_points_towards_the_camera(seed: int) -> None:
    evidence, cosine = rod()
    assert cosine < -0.2
    shape = carve(evidence, "tool", torch.Generator().manual_seed(seed), CarvingSettings())
    assert shape is not None
    assert float(shape.instrument_from_shaft[2, 2]) > 0.96  # 16 degrees
