"""A scene on disk is the scene."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from scene_worlds import make_scene

from neeco.base.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.scene import GaussianScene
from neeco.scene.io import load_scene, pack_scene, save_scene, save_tensors


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


def test_saving_again_gives_the_same_bytes(any_scene: GaussianScene, tmp_path: Path) -> None:
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    save_scene(any_scene, first)
    save_scene(load_scene(first), second)
    assert first.read_bytes() == second.read_bytes()


def test_a_loaded_scene_wants_no_gradients(kinematic: GaussianScene, tmp_path: Path) -> None:
    save_scene(kinematic, tmp_path / "scene.safetensors")
    loaded = load_scene(tmp_path / "scene.safetensors")
    assert not loaded.at(loaded.recorded.states[0]).means.requires_grad


def test_the_file_is_tensors_and_json_alone(kinematic: GaussianScene, tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    save_scene(kinematic, path)
    content = path.read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    assert json.loads(header["__metadata__"]["neeco"])["schema"] == "neeco-scene/2"
    assert b"pickle" not in content
    assert [p.name for p in tmp_path.iterdir()] == ["scene.safetensors"]


@pytest.mark.parametrize("kept", [0, 5, 200, -10])
def test_a_cut_file_is_refused(kinematic: GaussianScene, tmp_path: Path, kept: int) -> None:
    path = tmp_path / "scene.safetensors"
    save_scene(kinematic, path)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(NeecoError, match=r"scene\.safetensors: .*; train again"):
        load_scene(path)


def rewrite(path: Path, header_change, *drop: str) -> None:
    """Save the scene at `path` again with another header, perhaps without some tensors."""
    with safe_open(path, framework="pt") as stream:
        header = json.loads(stream.metadata()["neeco"])
        tensors = {name: stream.get_tensor(name) for name in stream.keys() if name not in drop}  # noqa: SIM118
    header_change(header)
    save_file(tensors, path, {"neeco": json.dumps(header)})


def test_another_schema_is_refused_by_name(kinematic: GaussianScene, tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    save_scene(kinematic, path)
    rewrite(path, lambda header: header.update(schema="neeco-scene/9"))
    with pytest.raises(NeecoError, match="schema 'neeco-scene/9', this version reads 'neeco-scene/2'"):
        load_scene(path)


def test_a_run_over_several_tissues_is_refused_and_one_of_a_single_named_tissue_loads(kinematic, tmp_path):
    path = tmp_path / "scene.safetensors"

    def name_tissues(*names: str) -> None:
        save_scene(kinematic, path)
        rewrite(path, lambda header: header.update(tissues=names))

    name_tissues("bowel", "stomach")
    with pytest.raises(NeecoError, match=r"scene\.safetensors: tissues: a scene has one tissue, and this 2; make one"):
        load_scene(path)
    name_tissues("bowel")
    assert torch.equal(load_scene(path).canonical.means, kinematic.canonical.means)


@pytest.mark.parametrize("grey", [1e300, -0.5, float("nan")])
def test_a_background_that_is_not_grey_is_refused(kinematic: GaussianScene, tmp_path: Path, grey: float) -> None:
    path = tmp_path / "scene.safetensors"
    save_scene(kinematic, path)
    rewrite(path, lambda header: header.update(background=grey))
    with pytest.raises(NeecoError, match=r"scene.safetensors: .*its background is .*, not a grey"):
        load_scene(path)


def test_a_setting_that_was_added_later_has_its_default(kinematic: GaussianScene, tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    save_scene(kinematic, path)
    rewrite(path, lambda header: header["deformation"].pop("hinge_start"))
    assert load_scene(path).settings.hinge_start == 600


def test_a_scene_from_before_bases_were_corrected_has_none(kinematic: GaussianScene, tmp_path: Path) -> None:
    tensors, header = pack_scene(kinematic)
    del tensors["module.base_corrections"]
    save_tensors(tensors, {"neeco": json.dumps(header)}, tmp_path / "scene.safetensors")
    assert not load_scene(tmp_path / "scene.safetensors").base_corrections.any()


def test_a_scene_from_before_shadows_casts_none(kinematic: GaussianScene, tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    save_scene(kinematic, path)
    shadow = [f"module.shadow_{part}" for part in ("offsets", "strengths", "width")]
    rewrite(path, lambda header: header.update(schema="neeco-scene/1"), *shadow)
    assert not load_scene(path).casts_shadow
    rewrite(path, lambda header: header.update(schema="neeco-scene/2"), *shadow)
    with pytest.raises(NeecoError, match="damaged scene"):
        load_scene(path)


@pytest.mark.parametrize("drop", ["canonical.means", "module.falloff", "recorded.poses"])
def test_a_missing_tensor_is_refused(kinematic: GaussianScene, tmp_path: Path, drop: str) -> None:
    path = tmp_path / "scene.safetensors"
    save_scene(kinematic, path)
    rewrite(path, lambda header: None, drop)
    with pytest.raises(NeecoError, match="damaged scene"):
        load_scene(path)


@pytest.mark.parametrize(
    ("name", "change", "told"),
    [
        ("canonical.quats", lambda tensor: tensor[:-1], r"quats has shape \[\d+, 4\], not \[\d+, 4\]"),
        ("canonical.sh_dc", lambda tensor: tensor[..., :2], "sh_dc has shape"),
        ("canonical.extras.part_logits", lambda tensor: tensor[:-1], "extras.part_logits has shape"),
        ("canonical.means", lambda tensor: tensor * torch.nan, "means contains NaN"),
        ("module.vignette", lambda tensor: tensor / 0, "vignette contains NaN"),
        ("module.falloff", lambda tensor: tensor + 1e30, r"falloff contains NaN, infinity or a number beyond 1e\+10"),
        ("module.state_corrections.weights", lambda tensor: tensor + torch.inf, "weights contains NaN, infinity"),
        ("module.state_corrections.lengths", lambda tensor: tensor * torch.nan, "lengths contains NaN"),
        ("module.center", lambda tensor: tensor - torch.inf, "center contains NaN"),
        ("recorded.poses", lambda tensor: tensor[:1], "out of bounds"),
    ],
)
def test_a_tensor_that_does_not_fit_is_refused(kinematic, tmp_path, name, change, told):
    tensors, header = pack_scene(kinematic)
    path = tmp_path / "scene.safetensors"
    save_tensors(tensors | {name: change(tensors[name]).contiguous()}, {"neeco": json.dumps(header)}, path)
    with pytest.raises(NeecoError, match=f"scene.safetensors: damaged scene.*{told}"):
        load_scene(path)


def test_a_foreign_safetensors_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    save_file({"a": torch.zeros(2)}, path)
    with pytest.raises(NeecoError, match="not a readable neeco scene"):
        load_scene(path)


def test_no_file_is_no_scene(tmp_path: Path) -> None:
    with pytest.raises(NeecoError, match="no such scene"):
        load_scene(tmp_path / "scene.safetensors")


@pytest.mark.parametrize(
    ("tensor", "value", "told"),
    [
        ("recorded.cameras", 0.0, "the recorded pose of camera in frame 0 is not a rigid transform"),
        ("recorded.cameras", float("nan"), "the recorded pose of camera in frame 0 is not a rigid transform"),
        ("recorded.poses", 7.0, "the recorded pose of grasper in frame 0 is not a rigid transform"),
    ],
)
def test_recorded_poses_that_are_none_are_refused(tensor, value, told, any_scene, tmp_path):
    tensors, header = pack_scene(any_scene)
    if tensor not in tensors:
        pytest.skip("it has no instrument")
    tensors[tensor] = torch.full_like(tensors[tensor], value)
    save_tensors(tensors, {"neeco": json.dumps(header)}, tmp_path / "scene.safetensors")
    with pytest.raises(NeecoError, match=rf"scene.safetensors: damaged scene \({told}\)"):
        load_scene(tmp_path / "scene.safetensors")


def test_a_scene_stored_under_a_methods_former_name_is_read(tmp_path: Path) -> None:
    tensors, header = pack_scene(make_scene("nps"))
    path = tmp_path / "scene.safetensors"
    save_tensors(tensors, {"neeco": json.dumps(header | {"method": "neeco"})}, path)
    with pytest.warns(FutureWarning, match="method neeco is now called nps"):
        assert load_scene(path).method == "nps"


@pytest.mark.parametrize("change", [{"recorded": 3}, {"instruments": [{"name": 1}]}, {"deformation": []}])
def test_a_header_built_otherwise_is_refused(change, any_scene, tmp_path):
    tensors, header = pack_scene(any_scene)
    save_tensors(tensors, {"neeco": json.dumps(header | change)}, tmp_path / "scene.safetensors")
    with pytest.raises(NeecoError, match=r"scene.safetensors: header: .*; it is damaged; train again"):
        load_scene(tmp_path / "scene.safetensors")


def test_an_unpaired_surrogate_is_refused(kinematic: GaussianScene, tmp_path: Path) -> None:
    tensors, header = pack_scene(kinematic)
    header["diagnostics"] = {"note": "\ud800"}
    save_tensors(tensors, {"neeco": json.dumps(header)}, tmp_path / "scene.safetensors")
    with pytest.raises(NeecoError, match=r"damaged scene .*unpaired surrogate"):
        load_scene(tmp_path / "scene.safetensors")


def test_both_cameras_of_a_still_scope_have_the_lamps_of_the_first(any_scene: GaussianScene, tmp_path: Path) -> None:
    recorded, right = any_scene.recorded, torch.eye(4)
    right[0, 3] = 5.0
    poses = [torch.eye(4) if index % 2 == 0 else right for index in range(len(recorded.cameras))]
    cameras = tuple(
        dataclasses.replace(camera, world_from_camera=pose)
        for camera, pose in zip(recorded.cameras, poses, strict=True)
    )
    any_scene.recorded = dataclasses.replace(recorded, cameras=cameras, still=True)
    save_scene(any_scene, tmp_path / "scene.safetensors")
    first, second, *_ = load_scene(tmp_path / "scene.safetensors").recorded.cameras
    assert first.world_from_lamps is None
    assert second.world_from_lamps is not None
    assert torch.equal(second.world_from_lamps, torch.eye(4))


def test_infinite_numbers_are_no_json(kinematic: GaussianScene, tmp_path: Path) -> None:
    (item, *others) = kinematic.instruments
    open_ended = {**item.joints, next(iter(item.joints)): (-math.inf, 1.5)}
    kinematic.instruments = (dataclasses.replace(item, joints=open_ended), *others)
    kinematic.diagnostics["found"] = {"depth_mm": [math.inf, 2.0], "share": math.nan}
    path = tmp_path / "scene.safetensors"
    save_scene(kinematic, path)
    with safe_open(path, framework="pt") as stream:
        json.loads(stream.metadata()["neeco"], parse_constant=pytest.fail)
    again = load_scene(path)
    assert again.instruments[0].joints == open_ended
    assert again.diagnostics["found"] == {"depth_mm": [None, 2.0], "share": None}


def test_a_scene_remembers_that_its_scope_stood_still(any_scene: GaussianScene, tmp_path: Path) -> None:
    any_scene.recorded = dataclasses.replace(any_scene.recorded, still=True)
    save_scene(any_scene, tmp_path / "scene.safetensors")
    assert load_scene(tmp_path / "scene.safetensors").recorded.still


def test_a_scene_remembers_how_large_the_errors_of_its_states_were(any_scene: GaussianScene, tmp_path: Path) -> None:
    path = tmp_path / "scene.safetensors"
    any_scene.recorded = dataclasses.replace(any_scene.recorded, error_scale=0.4)
    save_scene(any_scene, path)
    assert load_scene(path).recorded.error_scale == 0.4
    any_scene.recorded = dataclasses.replace(any_scene.recorded, error_scale=0.0)
    save_scene(any_scene, path)
    assert load_scene(path).recorded.error_scale == 0.0
    rewrite(path, lambda header: header["diagnostics"].update(scale_of_state_errors=0.3))  # as version 0.3 has it
    assert load_scene(path).recorded.error_scale == 0.3
