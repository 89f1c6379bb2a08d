"""A scene on disk is the scene."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from scene_worlds import make_scene

from neeco.base.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.scene import GaussianScene
from neeco.scene.io import load_scene, pack_scene, save_scene, save_tensors

Packed = tuple[dict[str, torch.Tensor], dict[str, Any]]
Damage = Callable[[dict[str, torch.Tensor], dict[str, Any]], object]


def test_a_scene_comes_back_exactly(any_scene: GaussianScene, tmp_path: Path) -> None:
    any_scene.background = 0.75
    any_scene.diagnostics = {"joints": {"grasper.jaw_angle": {"found": True}}}
    with torch.no_grad():
        any_scene.falloff.copy_(torch.tensor([1.9, 2.1]))
        save_scene(any_scene, tmp_path / "scene.safetensors")
        loaded = load_scene(tmp_path / "scene.safetensors")
        assert loaded.canonical.counts == any_scene.canonical.counts
        for name, tensor in any_scene.canonical.tensors().items():
            assert torch.equal(loaded.canonical.tensors()[name], tensor), name
        assert loaded.instruments == any_scene.instruments
        assert loaded.recorded.names == any_scene.recorded.names
        assert loaded.diagnostics == any_scene.diagnostics
        assert loaded.label_names == any_scene.label_names
        assert torch.equal(loaded.label_channels(), any_scene.label_channels())
        for before, after in zip(any_scene.recorded.states, loaded.recorded.states, strict=True):
            assert before.time == after.time
            a, b = any_scene.at(before), loaded.at(after)
            assert torch.equal(a.means, b.means)
            assert torch.equal(a.quats, b.quats)
            assert torch.equal(a.sh, b.sh)
            assert b.background.tolist() == [0.75] * 3
            assert torch.equal(a.headlight.falloff, b.headlight.falloff)


def test_a_scene_knows_the_lens_of_its_recording(kinematic: GaussianScene, tmp_path: Path) -> None:
    lens = Lens(60.0, 61.0, 32.0, 24.0, (-0.3, 0.1, 0.0, 0.0, 0.01), (64, 48), border=(31.0, 25.0, 28.0))
    assert load_scene(_saved(kinematic, tmp_path)).recorded.lens is None
    kinematic.recorded = dataclasses.replace(kinematic.recorded, lens=lens)
    path = _saved(kinematic, tmp_path)
    assert load_scene(path).recorded.lens == lens
    kinematic.recorded = dataclasses.replace(kinematic.recorded, lens=dataclasses.replace(lens, fl_x=-1.0))
    with pytest.raises(NeecoError, match=r"lens\.fl_x.*train again"):
        load_scene(_saved(kinematic, tmp_path))


def _saved(scene: GaussianScene, folder: Path) -> Path:
    save_scene(scene, folder / "scene.safetensors")
    return folder / "scene.safetensors"


@pytest.fixture
def packed(kinematic: GaussianScene) -> Packed:
    """Tensors and header of a scene, to be damaged."""
    return pack_scene(kinematic)


def written(packed: Packed, folder: Path) -> Path:
    tensors, header = packed
    path = folder / "scene.safetensors"
    save_tensors({name: tensor.contiguous() for name, tensor in tensors.items()}, {"neeco": json.dumps(header)}, path)
    return path


def test_saving_again_gives_the_same_bytes(any_scene: GaussianScene, tmp_path: Path) -> None:
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    save_scene(any_scene, first)
    save_scene(load_scene(first), second)
    assert first.read_bytes() == second.read_bytes()


def test_a_loaded_scene_wants_no_gradients(kinematic: GaussianScene, tmp_path: Path) -> None:
    loaded = load_scene(_saved(kinematic, tmp_path))
    assert not loaded.at(loaded.recorded.states[0]).means.requires_grad


def test_the_file_is_tensors_and_json_alone(kinematic: GaussianScene, tmp_path: Path) -> None:
    content = _saved(kinematic, tmp_path).read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    assert json.loads(header["__metadata__"]["neeco"])["schema"] == "neeco-scene/2"
    assert b"pickle" not in content
    assert [p.name for p in tmp_path.iterdir()] == ["scene.safetensors"]


@pytest.mark.parametrize("kept", [0, 5, 200, -10])
def test_a_cut_file_is_refused(kinematic: GaussianScene, tmp_path: Path, kept: int) -> None:
    path = _saved(kinematic, tmp_path)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(NeecoError, match=r"scene\.safetensors: .*; train again"):
        load_scene(path)


def test_a_scene_of_a_single_named_tissue_loads(packed: Packed, kinematic: GaussianScene, tmp_path: Path) -> None:
    packed[1]["tissues"] = ["bowel"]
    assert torch.equal(load_scene(written(packed, tmp_path)).canonical.means, kinematic.canonical.means)


def test_what_was_added_later_has_its_default(packed: Packed, tmp_path: Path) -> None:
    tensors, header = packed
    del header["deformation"]["hinge_start"]
    del tensors["module.base_corrections"]
    scene = load_scene(written(packed, tmp_path))
    assert scene.settings.hinge_start == 600
    assert not scene.base_corrections.any()


def drop(name: str) -> Damage:
    return lambda tensors, header: tensors.pop(name)


def change(name: str, edit: Callable[[torch.Tensor], torch.Tensor]) -> Damage:
    return lambda tensors, header: tensors.update({name: edit(tensors[name])})


def head(**fields: object) -> Damage:
    return lambda tensors, header: header.update(fields)


def filled(value: float) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda tensor: torch.full_like(tensor, value)


NOT_RIGID = "the recorded pose of {} in frame 0 is not a rigid transform"


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        *(
            (drop(name), "damaged scene")
            for name in ("canonical.means", "module.falloff", "module.shadow_width", "recorded.poses")
        ),
        (change("canonical.quats", lambda tensor: tensor[:-1]), r"quats has shape \[\d+, 4\], not \[\d+, 4\]"),
        (change("canonical.sh_dc", lambda tensor: tensor[..., :2]), "sh_dc has shape"),
        (change("canonical.extras.part_logits", lambda tensor: tensor[:-1]), "extras.part_logits has shape"),
        (change("canonical.means", filled(torch.nan)), "means contains NaN"),
        (change("module.vignette", filled(torch.inf)), "vignette contains NaN"),
        (change("module.falloff", filled(1e30)), r"falloff contains NaN, infinity or a number beyond 1e\+10"),
        (change("module.state_corrections.weights", filled(torch.inf)), "weights contains NaN, infinity"),
        (change("module.state_corrections.lengths", filled(torch.nan)), "lengths contains NaN"),
        (change("recorded.poses", lambda tensor: tensor[:1]), "out of bounds"),
        (change("recorded.cameras", filled(0.0)), NOT_RIGID.format("camera")),
        (change("recorded.cameras", filled(torch.nan)), NOT_RIGID.format("camera")),
        (change("recorded.poses", filled(7.0)), NOT_RIGID.format("grasper")),
        (head(schema="neeco-scene/1"), "schema 'neeco-scene/1', this version reads 'neeco-scene/2'"),
        (head(tissues=["bowel", "stomach"]), "tissues: a scene has one tissue, and this 2; make one"),
        *((head(background=grey), "its background is .*, not a grey") for grey in (1e300, -0.5, math.nan)),
        *((head(**wrong), "header: .*; it is damaged") for wrong in ({"recorded": 3}, {"instruments": [{"name": 1}]})),
        (head(deformation=[]), "header: .*; it is damaged"),
        (head(diagnostics={"note": "\ud800"}), "damaged scene .*unpaired surrogate"),
    ],
)
def test_a_damaged_scene_is_refused_in_a_line_that_says_what_is_wrong(damage, told, packed, tmp_path):
    damage(*packed)
    with pytest.raises(NeecoError, match=rf"scene\.safetensors: .*{told}"):
        load_scene(written(packed, tmp_path))


def test_a_foreign_safetensors_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    save_file({"a": torch.zeros(2)}, path)
    with pytest.raises(NeecoError, match="not a readable neeco scene"):
        load_scene(path)


def test_no_file_is_no_scene(tmp_path: Path) -> None:
    with pytest.raises(NeecoError, match="no such scene"):
        load_scene(tmp_path / "scene.safetensors")


def test_a_scene_stored_under_a_methods_former_name_is_read(tmp_path: Path) -> None:
    tensors, header = pack_scene(make_scene("nps"))
    path = tmp_path / "scene.safetensors"
    save_tensors(tensors, {"neeco": json.dumps(header | {"method": "neeco"})}, path)
    with pytest.warns(FutureWarning, match="method neeco is now called nps"):
        assert load_scene(path).method == "nps"


def test_both_cameras_of_a_still_scope_have_the_lamps_of_the_first(kinematic: GaussianScene, tmp_path: Path) -> None:
    recorded, right = kinematic.recorded, torch.eye(4)
    right[0, 3] = 5.0
    poses = [torch.eye(4) if index % 2 == 0 else right for index in range(len(recorded.cameras))]
    cameras = tuple(
        dataclasses.replace(camera, world_from_camera=pose)
        for camera, pose in zip(recorded.cameras, poses, strict=True)
    )
    kinematic.recorded = dataclasses.replace(recorded, cameras=cameras, still=True)
    first, second, *_ = load_scene(_saved(kinematic, tmp_path)).recorded.cameras
    assert first.world_from_lamps is None
    assert second.world_from_lamps is not None
    assert torch.equal(second.world_from_lamps, torch.eye(4))


def test_infinite_numbers_are_no_json(kinematic: GaussianScene, tmp_path: Path) -> None:
    (item, *others) = kinematic.instruments
    open_ended = {**item.joints, next(iter(item.joints)): (-math.inf, 1.5)}
    kinematic.instruments = (dataclasses.replace(item, joints=open_ended), *others)
    kinematic.diagnostics["found"] = {"depth_mm": [math.inf, 2.0], "share": math.nan}
    path = _saved(kinematic, tmp_path)
    with safe_open(path, framework="pt") as stream:
        json.loads(stream.metadata()["neeco"], parse_constant=pytest.fail)
    again = load_scene(path)
    assert again.instruments[0].joints == open_ended
    assert again.diagnostics["found"] == {"depth_mm": [None, 2.0], "share": None}


def test_a_scene_remembers_that_its_scope_stood_still_and_how_large_the_errors_were(packed, kinematic, tmp_path):
    kinematic.recorded = dataclasses.replace(kinematic.recorded, still=True, error_scale=0.4)
    recorded = load_scene(_saved(kinematic, tmp_path)).recorded
    assert (recorded.still, recorded.error_scale) == (True, 0.4)
    assert load_scene(written(packed, tmp_path)).recorded.error_scale == 0.0
    packed[1]["diagnostics"]["scale_of_state_errors"] = 0.3  # as version 0.3 has it
    assert load_scene(written(packed, tmp_path)).recorded.error_scale == 0.3
