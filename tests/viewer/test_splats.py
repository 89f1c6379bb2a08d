"""A scene in one state as other programs read it: drawn again from the file, it looks the same."""

from __future__ import annotations

import gzip
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard
from ball_world import ball_scene
from scene_worlds import CAMERA, grasper_state, make_scene, pose_of
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.cli import main
from neeco.evaluation.image_metrics import psnr
from neeco.raster import rasterize
from neeco.raster.types import Gaussians
from neeco.viewer.scene_files import exported_state, ply_bytes, splats_of, spz_bytes

TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=CAMERA.world_from_camera.dtype))
TURNED = replace(CAMERA, world_from_camera=TURN @ CAMERA.world_from_camera)  # in axes right, up, back
STATE = grasper_state(pose_of(0.7, -0.4, 1.1, 2.0, 1.0, 60.0), 0.5)


def lit_scene():
    """All that is baked: turned harmonics, a headlight, a lamp's shadow."""
    scene = make_scene("kinematic")
    scene.canonical.means[: scene.canonical.counts[0], 2] += 90
    with torch.no_grad():
        scene.falloff.copy_(torch.tensor([0.8, 1.2]))
        scene.vignette.copy_(torch.tensor([-0.5, 0.1]))
        scene.shadow_offsets[0] = torch.tensor([9.0, -5.0, 0.0])
        scene.shadow_strengths[0] = 0.5
    return scene.requires_grad_(False)


def read_ply(data: bytes) -> dict[str, np.ndarray]:
    header, body = data.split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property")]
    table = np.frombuffer(body, "<f4").reshape(-1, len(names))
    assert f"element vertex {len(table)}".encode() in header
    return {name: table[:, k] for k, name in enumerate(names)}


def gaussians_of_ply(data: bytes) -> Gaussians:
    found = read_ply(data)

    def columns(*names: str) -> Tensor:
        return torch.from_numpy(np.stack([found[name] for name in names], 1).copy())

    rest = len([name for name in found if name.startswith("f_rest_")])
    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        sh = torch.cat([sh, columns(*(f"f_rest_{k}" for k in range(rest))).reshape(len(sh), 3, -1).transpose(1, 2)], 1)
    quats = columns("rot_0", "rot_1", "rot_2", "rot_3")
    scales, opacities = columns("scale_0", "scale_1", "scale_2").exp(), torch.sigmoid(columns("opacity")[:, 0])
    return Gaussians(columns("x", "y", "z"), quats, scales, opacities, sh.contiguous())


def gaussians_of_spz(data: bytes) -> Gaussians:
    if data[:4] == b"NGSP":
        magic, version, count, degree, bits, flags, streams, begin = struct.unpack("<IIIBBBBI12x", data[:32])
        sizes = [struct.unpack_from("<QQ", data, begin + 16 * k) for k in range(streams)]
        raw, start = b"", begin + 16 * streams
        for size, full in sizes:
            raw += zstandard.decompress(data[start : start + size], max_output_size=full)
            start += size
        assert (version, start) == (4, len(data))
    else:
        raw = gzip.decompress(data)
        magic, version, count, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", raw[:16])
        assert (version, reserved) == (3, 0)
        raw = raw[16:]
    assert (magic.to_bytes(4, "little"), flags) == (b"NGSP", 0)
    at = 0

    def columns(width: int) -> np.ndarray:
        nonlocal at
        values = np.frombuffer(raw, np.uint8, count * width, at).reshape(count, width).astype(np.int64)
        at += count * width
        return values

    thirds = columns(9).reshape(count, 3, 3)
    whole = thirds[..., 0] | thirds[..., 1] << 8 | thirds[..., 2] << 16
    means = np.where(whole >= 2**23, whole - 2**24, whole) / 2**bits
    opacities, dc = columns(1)[:, 0] / 255, (columns(3) / 255 - 0.5) / 0.15
    scales = np.exp(columns(3) / 16 - 10)
    packed = columns(4) @ (1 << np.array([0, 8, 16, 24]))
    largest, others, xyzw = packed >> 30, packed & (1 << 30) - 1, np.zeros((count, 4))
    for place in (3, 2, 1, 0):
        given = place != largest
        size = (others & 511) / 511 / np.sqrt(2)
        xyzw[given, place] = np.where(others >> 9 & 1, -size, size)[given]
        others = np.where(given, others >> 10, others)
    xyzw[np.arange(count), largest] = np.sqrt(np.clip(1 - (xyzw**2).sum(1), 0, None))
    rest = (columns(3 * ((degree + 1) ** 2 - 1)) - 128) / 128
    assert at == len(raw)
    sh = np.concatenate([dc[:, None], rest.reshape(count, -1, 3)], 1)
    arrays = (means, np.roll(xyzw, 1, axis=1), scales, opacities, sh)
    return Gaussians(*(torch.from_numpy(array).float() for array in arrays))


def decibels(image: Tensor, truth: Tensor) -> float:
    return psnr(image.clamp(0, 1), truth.clamp(0, 1))


@torch.no_grad()
def test_drawn_again_from_the_file_it_looks_as_the_scene_does_from_that_camera() -> None:
    scene = lit_scene()
    truth = scene.render(STATE, CAMERA).color
    splats = splats_of(scene, STATE, CAMERA)
    assert float(truth.std()) > 0.05
    assert decibels(rasterize(gaussians_of_ply(ply_bytes(splats)), CAMERA).color, truth) > 60
    versions = [gaussians_of_spz(spz_bytes(splats, version)) for version in (3, 4)]
    assert all(
        torch.equal(*both)
        for both in zip(*(vars(gaussians).values() for gaussians in versions), strict=True)
        if isinstance(both[0], Tensor)
    )
    assert decibels(rasterize(versions[1], TURNED).color, truth) > 25


@torch.no_grad()
def test_what_is_baked_matters() -> None:
    scene = lit_scene()
    drawn = rasterize(gaussians_of_ply(ply_bytes(splats_of(scene, STATE, CAMERA))), CAMERA).color
    scene.sh_degree = 0
    assert decibels(scene.render(STATE, CAMERA).color, drawn) < 40  # the harmonics
    scene.sh_degree = 2
    scene.falloff.zero_()
    assert decibels(scene.render(STATE, CAMERA).color, drawn) < 40
    other = grasper_state(pose_of(0.7, -0.4, 1.1, 2.0, 1.0, 60.0), -0.3)
    assert decibels(lit_scene().render(other, CAMERA).color, drawn) < 40


def test_a_ball_survives_in_both_formats_and_the_same_bytes_come_twice() -> None:
    scene = ball_scene("ball", [(0.0, 0.0, 60.0)])
    state, camera = exported_state(scene, 0, None)
    splats = splats_of(scene, state, camera)
    truth = scene.render(state, camera).color
    small, large = spz_bytes(splats), ply_bytes(splats)
    assert (small, large) == (spz_bytes(splats), ply_bytes(splats))
    assert len(small) < len(large) / 5
    turned = replace(camera, world_from_camera=TURN.to(camera.world_from_camera) @ camera.world_from_camera)
    assert decibels(rasterize(gaussians_of_spz(small), turned).color, truth) > 38


def test_spz_turns_rotations_by_less_than_a_fifth_of_a_degree() -> None:
    scene = lit_scene()
    splats = splats_of(scene, STATE, CAMERA)
    turn = torch.tensor([1.0, 1, -1, -1])  # of the axes, about x
    for version in (3, 4):
        found = gaussians_of_spz(spz_bytes(splats, version)).quats
        cosines = (found * turn * torch.from_numpy(splats.quats)).sum(1).abs().clamp_max(1)
        assert float(torch.rad2deg(2 * cosines.acos()).max()) < 0.2


def test_positions_that_spz_cannot_hold_are_refused() -> None:
    scene = ball_scene("ball", [(0.0, 0.0, 3000.0)])
    with pytest.raises(NeecoError, match=r"--format: spz .* use ply"):
        spz_bytes(splats_of(scene, *exported_state(scene, 0, None)))


def test_a_joint_far_from_the_recorded_ones_is_refused_though_no_limits_are_stated(tmp_path: Path) -> None:
    scene = make_scene("kinematic")
    scene.instruments = (replace(scene.instruments[0], joints={"jaw_angle": None}),)
    line = {"name": "grasper", "pose": np.eye(4).tolist(), "joints": {"jaw_angle": 3.0}}
    (tmp_path / "states.jsonl").write_text(json.dumps({"instruments": [line]}))
    with pytest.raises(NeecoError, match=r"line 1: .*jaw_angle"):
        exported_state(scene, 0, tmp_path / "states.jsonl")


def run_folder(path: Path, scene) -> Path:
    from neeco.scene.io import save_scene

    path.mkdir()
    save_scene(scene, path / "scene.safetensors")
    (path / "config.yaml").write_text(
        "schema: neeco-run/1\nversion: 0.1.0\ncapture: /gone\ntransforms: transforms.json\nmethod: kinematic\nseed: 0\n"
    )
    return path


def test_the_verb_writes_and_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_folder(tmp_path / "run", ball_scene("ball", [(0.0, 0.0, 60.0), (5.0, 0.0, 55.0)]))
    assert main(["export", str(run), "--format", "spz", "--frame", "1"]) == 0
    assert "3,165 Gaussians" in capsys.readouterr().out
    assert gaussians_of_spz((run / "scene.spz").read_bytes()).means.shape == (3165, 3)
    assert main(["export", str(run), "--frame", "2"]) == 1
    assert "--frame: must be from 0 to 1, the training frames (got 2)" in capsys.readouterr().err
    states = tmp_path / "states.jsonl"
    states.write_text('{"instruments": [{"name": "other", "pose": 1, "joints": {}}]}\n')
    assert main(["export", str(run), "--states", str(states), "--output", str(tmp_path / "a.ply")]) == 1
    assert "states.jsonl: line 1" in capsys.readouterr().err
    assert not (tmp_path / "a.ply").exists()
    assert main(["export", str(run), "--states", "interpolate", "--output", str(tmp_path / "a.ply")]) == 1
    assert "interpolate: no such file; give a file of states" in capsys.readouterr().err


def test_the_format_is_that_of_the_ending(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_folder(tmp_path / "run", ball_scene("ball", [(0.0, 0.0, 60.0)]))
    for name, begin in (("a.spz", b"NGSP"), ("a.usdc", b"PXR-USDC"), ("a.PLY", b"ply"), ("a", b"ply")):
        assert main(["export", str(run), "--output", str(tmp_path / name)]) == 0
        assert (tmp_path / name).read_bytes().startswith(begin)
    for words, ends in ((["b.splat"], ".ply or .spz or .usdc or .glb"), (["b.ply", "--format", "spz"], ".spz")):
        assert main(["export", str(run), "--output", *words]) == 1
        assert f"--output: {words[0]}: wrong file name extension; use {ends}\n" in capsys.readouterr().err
    for words in (["--unit", "mm", "--format", "usdc"], ["--spz-version", "3"]):
        assert main(["export", str(run), *words]) == 1
        assert f"{words[0]}: applies to " in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ["view", "RUN", "--export", "page.pdf"],
        ["evaluate", "RUN", "--json", "scores.csv"],
        ["score-masks", "RUN", "RUN", "--json", "scores.txt"],
    ],
)
def test_no_file_is_written_under_another_formats_name(words, tmp_path, capsys):
    run = run_folder(tmp_path / "run", ball_scene("ball", [(0.0, 0.0, 60.0)]))
    assert main([str(run) if word == "RUN" else word for word in words]) == 1
    assert f"{words[-2]}: {words[-1]}: wrong file name extension" in capsys.readouterr().err


def test_numbers_that_are_not_finite_are_in_no_file() -> None:
    scene = lit_scene()
    with torch.no_grad():
        scene.falloff.fill_(1e30)
    with pytest.raises(NeecoError, match="not finite in this state"):
        splats_of(scene, STATE, CAMERA)
    with torch.no_grad():
        scene.falloff.zero_()
        scene.canonical.log_scales[:] = -1e3  # whose scales are 0 in float32
    assert np.isfinite(splats_of(scene, STATE, CAMERA).log_scales).all()
