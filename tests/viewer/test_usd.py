"""A scene that moves as OpenUSD reads it: posed by its time samples, it is the scene in that state."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scene_worlds import CAMERA, STATES, TISSUE, rigid_scene

from neeco.base.errors import NeecoError
from neeco.evaluation.image_metrics import psnr
from neeco.geometry.rotations import matrix_to_quat, quat_multiply
from neeco.raster import rasterize
from neeco.raster.types import Gaussians
from neeco.viewer.scene_files import moving_scene, write_usd

TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # about x, to y up


@pytest.fixture
def opened(tmp_path: Path) -> Any:
    pxr = pytest.importorskip("pxr", reason="the extra usd")
    scene = rigid_scene()
    scene.canonical.means[:TISSUE, 2] += 90
    write_usd(moving_scene(scene, STATES, CAMERA), tmp_path / "scene.usdc")
    return pxr, pxr.Usd.Stage.Open(str(tmp_path / "scene.usdc")), scene


def fields_of(pxr: Any, stage: Any) -> list[Any]:
    return [
        pxr.UsdVol.ParticleField3DGaussianSplat(prim)
        for prim in stage.Traverse()
        if prim.IsA("ParticleField3DGaussianSplat")
    ]


def gaussians_of(pxr: Any, stage: Any, code: float) -> Gaussians:
    """All Gaussians in the stage's world at a time code."""
    rows = []
    for field in fields_of(pxr, stage):
        place = pxr.UsdGeom.Xformable(field.GetPrim()).ComputeLocalToWorldTransform(code)
        world = torch.from_numpy(np.array(place)).T  # USD multiplies rows
        quat = matrix_to_quat(world[:3, :3])
        means = torch.from_numpy(np.array(field.GetPositionsAttr().Get())).double() @ world[:3, :3].T + world[:3, 3]
        own = torch.tensor([[q.GetReal(), *q.GetImaginary()] for q in field.GetOrientationsAttr().Get()]).double()
        degree = field.GetRadianceSphericalHarmonicsDegreeAttr().Get()
        sh = torch.from_numpy(np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()))
        scales, opacities = (
            torch.from_numpy(np.array(attribute.Get()))
            for attribute in (field.GetScalesAttr(), field.GetOpacitiesAttr())
        )
        quats = quat_multiply(quat.expand(len(means), 4), own)
        shapes = sh.reshape(len(means), (degree + 1) ** 2, 3)
        rows.append((means, quats, scales, opacities, shapes, quat.expand(len(means), 4)))
    tensors = [torch.cat(column).float() for column in zip(*rows, strict=True)]
    return Gaussians(*tensors[:5], sh_frames=tensors[5])


@torch.no_grad()
@pytest.mark.parametrize("number", [0, 2, 4])
def test_posed_by_its_time_samples_it_is_the_scene_in_that_state(opened: Any, number: int) -> None:
    pxr, stage, scene = opened
    code = stage.GetTimeCodesPerSecond() * 0.5 * number**2
    assert stage.GetStartTimeCode() <= code <= stage.GetEndTimeCode()
    read = gaussians_of(pxr, stage, code)
    means = scene.at(STATES[number]).means @ TURN[:3, :3].float()
    own, other = means[:, 0].argsort(), read.means[:, 0].argsort()
    assert (means[own] - read.means[other]).abs().max() < 1e-3
    camera = replace(CAMERA, world_from_camera=TURN @ CAMERA.world_from_camera)
    drawn, truth = (
        image.color.clamp(0, 1) for image in (rasterize(read, camera), scene.render(STATES[number], CAMERA))
    )
    assert float(truth.std()) > 0.05
    assert psnr(drawn, truth) > 50


def test_prims_have_names_labels_extents_and_the_stage_its_axes(opened: Any) -> None:
    pxr, stage, _ = opened
    assert pxr.UsdGeom.GetStageMetersPerUnit(stage) == 0.001
    assert pxr.UsdGeom.GetStageUpAxis(stage) == "Y"
    placed = pxr.UsdGeom.Xformable(stage.GetDefaultPrim()).ComputeLocalToWorldTransform(0)
    assert np.allclose(np.array(placed), TURN)
    assert stage.GetPrimAtPath("/Scene/grasper").IsA("Xform")
    fields = fields_of(pxr, stage)
    paths = {str(field.GetPath()) for field in fields}
    assert {"/Scene/tissue", "/Scene/grasper/wrist", "/Scene/grasper/jaw_left"} <= paths
    for field in fields:
        (label,) = pxr.UsdSemantics.LabelsAPI(field.GetPrim(), "class").GetLabelsAttr().Get()
        assert field.GetPrim().GetName().startswith(label)
        lowest, highest = np.array(field.GetExtentAttr().Get())
        means = np.array(field.GetPositionsAttr().Get())
        assert (lowest < means).all()
        assert (means < highest).all()


def test_a_missing_or_old_openusd_is_refused_with_what_to_install(tmp_path, monkeypatch):
    moving = moving_scene(rigid_scene(), STATES, CAMERA)
    old = SimpleNamespace(Usd=SimpleNamespace(GetVersion=lambda: (0, 25, 5)), UsdVol=SimpleNamespace())
    for module, why in ((None, "usdc needs usd-core"), (old, "26.03 or newer, this is 25.5")):
        monkeypatch.setitem(sys.modules, "pxr", module)
        with pytest.raises(NeecoError, match=rf"{why}; pip install '.\[usd\]'"):
            write_usd(moving, tmp_path / "a.usdc")
    assert not list(tmp_path.iterdir())
