"""A scene that moves as glTF: posed by its animation, it is the scene in that state."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scene_worlds import CAMERA, STATES, TISSUE, make_scene, rigid_scene
from scipy.spatial.transform import Rotation

from neeco.evaluation.image_metrics import psnr
from neeco.geometry.rotations import quat_to_matrix
from neeco.raster import rasterize
from neeco.raster.types import Gaussians
from neeco.viewer.scene_files import exported_states, moving_scene, write_glb

PREFIX = "KHR_gaussian_splatting:"
AXES = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))  # glTF's from the capture's


@dataclass
class Glb:
    """A file, read by the format's definition."""

    content: dict[str, Any]
    binary: bytes

    @classmethod
    def read(cls, path: Path) -> Glb:
        data = path.read_bytes()
        magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
        assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
        following, kind = struct.unpack_from("<I4s", data, 20 + length)
        assert (28 + length + following, kind, length % 4) == (len(data), b"BIN\0", 0)
        return cls(json.loads(data[20 : 20 + length]), data[28 + length :])

    def values(self, number: int) -> np.ndarray:
        accessor = self.content["accessors"][number]
        view = self.content["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind, whole = {5126: ("<f4", 1), 5121: ("u1", 255), 5122: ("<i2", 32767)}[accessor["componentType"]]
        assert view["byteOffset"] % 4 == 0
        read = np.frombuffer(self.binary, kind, accessor["count"] * width, view["byteOffset"])
        assert accessor.get("normalized", False) == (whole > 1)
        return read.reshape(-1, width).astype(np.float64) / whole

    def locals(self, time: float) -> list[np.ndarray]:
        """parent_from_node [4, 4] of every node, as the animation has it."""
        nodes = [dict(node) for node in self.content["nodes"]]
        for animation in self.content.get("animations", []):
            for channel in animation["channels"]:
                sampler = animation["samplers"][channel["sampler"]]
                times, values = self.values(sampler["input"])[:, 0], self.values(sampler["output"])
                after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
                share = (time - times[after - 1]) / (times[after] - times[after - 1])
                blend = (1 - share) * values[after - 1] + share * values[after]
                nodes[channel["target"]["node"]][channel["target"]["path"]] = blend
        matrices = []
        for node in nodes:
            matrix = np.eye(4)
            matrix[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
            matrix[:3, 3] = node.get("translation", [0, 0, 0])
            assert "scale" not in node
            matrices.append(matrix)
        return matrices

    def worlds(self, time: float) -> list[np.ndarray]:
        """world_from_node [4, 4] of every node."""
        worlds = self.locals(time)
        for number, node in enumerate(self.content["nodes"]):  # parents come before their children
            for child in node.get("children", []):
                assert child > number
                worlds[child] = worlds[number] @ worlds[child]
        return worlds

    def gaussians(self, time: float, nodes: list[int] | None = None) -> Gaussians:
        """All Gaussians in glTF's world, mm, in the order of the nodes."""
        worlds, rows = self.worlds(time), []
        for number, node in enumerate(self.content["nodes"]):
            if "mesh" not in node or (nodes is not None and number not in nodes):
                continue
            (primitive,) = self.content["meshes"][node["mesh"]]["primitives"]
            assert primitive["mode"] == 0
            found = {name.removeprefix(PREFIX): self.values(at) for name, at in primitive["attributes"].items()}
            turn = Rotation.from_matrix(worlds[number][:3, :3])
            count = len(found["POSITION"])
            harmonics = [name for name in found if name.startswith("SH_")]
            degree = max(int(name.split("_")[2]) for name in harmonics)
            names = [f"SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]
            assert set(names) == set(harmonics)
            rows.append(
                (
                    1000 * (turn.apply(found["POSITION"]) + worlds[number][:3, 3]),
                    (turn * Rotation.from_quat(found["ROTATION"])).as_quat()[:, [3, 0, 1, 2]],
                    1000 * found["SCALE"],
                    found["OPACITY"][:, 0],
                    np.stack([found[name] for name in names], 1),
                    np.tile(turn.as_quat()[[3, 0, 1, 2]], (count, 1)),
                )
            )
        tensors = [torch.from_numpy(np.concatenate(column)).float() for column in zip(*rows, strict=True)]
        return Gaussians(*tensors[:5], sh_frames=tensors[5])


def in_gltf(posed: Gaussians) -> tuple[torch.Tensor, torch.Tensor]:
    """Means and covariances [N, 3, 3] of posed Gaussians in glTF's axes, mm."""
    turn = AXES[:3, :3].float()
    factor = turn @ quat_to_matrix(torch.nn.functional.normalize(posed.quats, dim=1)) * posed.scales[:, None]
    return posed.means @ turn.T, factor @ factor.transpose(1, 2)


def in_order(means: torch.Tensor) -> torch.Tensor:
    return means[:, 0].argsort()


def test_in_another_unit_all_lengths_are_so_many_times_larger(tmp_path: Path) -> None:
    moving = moving_scene(rigid_scene(), STATES, CAMERA)
    write_glb(moving, CAMERA, tmp_path / "m.glb")
    write_glb(moving, CAMERA, tmp_path / "mm.glb", "mm")
    metres, larger = (Glb.read(tmp_path / name) for name in ("m.glb", "mm.glb"))
    for time in (0.0, 2.0):
        one, other = metres.gaussians(time), larger.gaussians(time)
        assert torch.allclose(1000 * one.means, other.means, atol=1e-2)
        assert torch.allclose(1000 * one.scales, other.scales, rtol=1e-4)
        for ours, theirs in zip(metres.worlds(time), larger.worlds(time), strict=True):
            assert np.allclose(ours[:3, :3], theirs[:3, :3])
            assert np.allclose(1000 * ours[:3, 3], theirs[:3, 3], atol=1e-4)
    (lens,), (larger_lens,) = (each.content["cameras"] for each in (metres, larger))
    assert larger_lens["perspective"]["znear"] == pytest.approx(1000 * lens["perspective"]["znear"])


@pytest.mark.parametrize("number", [0, 2, 4])
def test_posed_by_its_animation_it_is_the_scene_in_that_state(tmp_path: Path, number: int) -> None:
    scene = rigid_scene()
    weights = scene.deformation.link_weights(scene.canonical, 0)
    assert weights.max(1).values.min() > 0.999
    assert len(weights.argmax(1).unique()) == 3
    write_glb(moving_scene(scene, STATES, CAMERA), CAMERA, tmp_path / "a.glb")
    read = Glb.read(tmp_path / "a.glb").gaussians(0.5 * number**2)
    means, covariances = in_gltf(scene.at(STATES[number]))
    own, other = in_order(means), in_order(read.means)
    assert (means[own] - read.means[other]).abs().max() < 1e-3
    factor = quat_to_matrix(read.quats) * read.scales[:, None]
    assert (covariances[own] - (factor @ factor.transpose(1, 2))[other]).abs().max() < 1e-3


@torch.no_grad()
@pytest.mark.parametrize("number", [0, 3])
def test_drawn_from_the_file_by_the_recorded_camera_it_looks_as_the_scene_does(tmp_path: Path, number: int) -> None:
    scene = rigid_scene()
    scene.canonical.means[:TISSUE, 2] += 90
    if number == 0:  # light is baked as the camera has it in the first state
        scene.falloff.copy_(torch.tensor([0.8, 1.2]))
        scene.vignette.copy_(torch.tensor([-0.5, 0.1]))
    truth = scene.render(STATES[number], CAMERA).color.clamp(0, 1)
    write_glb(moving_scene(scene, STATES, CAMERA), CAMERA, tmp_path / "a.glb")
    read = Glb.read(tmp_path / "a.glb")
    turned = replace(CAMERA, world_from_camera=AXES @ CAMERA.world_from_camera)
    drawn = rasterize(read.gaussians(0.5 * number**2), turned).color.clamp(0, 1)
    assert float(truth.std()) > 0.05
    assert psnr(drawn, truth) > 50


def test_nodes_name_parts_and_joints_and_the_camera_looks_where_it_did(tmp_path: Path) -> None:
    scene = rigid_scene()
    write_glb(moving_scene(scene, STATES, CAMERA), CAMERA, tmp_path / "a.glb")
    read = Glb.read(tmp_path / "a.glb")
    nodes = {node["name"]: node for node in read.content["nodes"]}
    assert {"tissue", "grasper", "wrist", "jaw_left", "jaw_right"} <= nodes.keys()
    facts = nodes["grasper"]["extras"]
    assert facts["joints"] == {"jaw_angle": {"limits": [0.0, 1.5]}}
    assert {axis["joint"] for axis in facts["axes"]} == {"jaw_angle"}
    assert nodes["jaw_left"]["extras"]["part"] == "jaw_left"
    (at,) = [number for number, node in enumerate(read.content["nodes"]) if "camera" in node]
    looks = read.worlds(0.0)[at][:3, :3] @ [0, 0, -1]  # a camera of glTF looks along -z
    assert np.allclose(looks, AXES[:3, :3] @ CAMERA.world_from_camera[:3, 2])
    lens = read.content["cameras"][0]["perspective"]
    assert lens["yfov"] == pytest.approx(2 * np.arctan(24 / 61))
    assert lens["aspectRatio"] == pytest.approx(64 / 60 / (48 / 61))


def test_the_tissue_stays_and_instruments_move_between_states_as_well(tmp_path: Path) -> None:
    scene = rigid_scene()
    write_glb(moving_scene(scene, STATES, CAMERA), CAMERA, tmp_path / "a.glb")
    read = Glb.read(tmp_path / "a.glb")
    moved = [read.gaussians(time).means for time in (0.0, 0.25, 0.5)]
    assert (moved[0][:TISSUE] == moved[2][:TISSUE]).all()
    half = (moved[1] - moved[0])[TISSUE:].norm(dim=1)
    assert (half > 0.1 * (moved[2] - moved[0])[TISSUE:].norm(dim=1)).all()


def test_what_blends_links_is_counted_and_methods_without_joints_stand_in_one_state(tmp_path: Path) -> None:
    assert moving_scene(make_scene("kinematic").requires_grad_(False), STATES, CAMERA).blended > 0.1
    assert moving_scene(rigid_scene(), STATES, CAMERA).blended == 0
    scene = make_scene("4dgs").requires_grad_(False)
    states = exported_states(scene, STATES[1], None)
    assert states == [STATES[1]]
    for name, moving in (
        ("a", moving_scene(rigid_scene(), STATES[:1], CAMERA)),
        ("b", moving_scene(scene, states, CAMERA)),
    ):
        write_glb(moving, CAMERA, tmp_path / name)
        assert "animations" not in Glb.read(tmp_path / name).content
    read, (means, _) = Glb.read(tmp_path / "b").gaussians(0.0), in_gltf(scene.at(STATES[1]))
    assert (means - read.means).abs().max() < 1e-3


def test_states_without_times_are_shown_fifteen_a_second_and_recorded_ones_in_order(tmp_path: Path) -> None:
    scene = rigid_scene()
    timeless = [replace(state, time=0.0) for state in STATES]
    write_glb(moving_scene(scene, timeless, CAMERA), CAMERA, tmp_path / "a.glb")
    read = Glb.read(tmp_path / "a.glb")
    clock = read.values(read.content["animations"][0]["samplers"][0]["input"])[:, 0]
    assert np.allclose(clock, np.arange(5) / 15)
    times = [state.time for state in exported_states(scene, STATES[0], None)]
    assert times == sorted(times)
    assert len(times) == 8
    scene.recorded = replace(scene.recorded, states=scene.recorded.states * 2)  # two cameras
    assert [state.time for state in exported_states(scene, STATES[0], None)] == times
    scene.recorded = replace(scene.recorded, states=tuple(timeless))
    assert len(exported_states(scene, STATES[0], None)) == 5
