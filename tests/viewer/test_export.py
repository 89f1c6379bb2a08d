"""What a page carries of a scene, read back as docs/viewer.md says it is written."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scene_worlds import make_nerf, make_scene
from viewer_world import write_recorded_images, write_run

import neeco
from neeco.base.errors import NeecoError
from neeco.scene.canonical import SH_C0
from neeco.scene.gaussian_scene import GaussianScene
from neeco.viewer.export import export_page, pack, page_of

CPU = torch.device("cpu")
SIZES = {"uint8": 1, "int8": 1, "uint16": 2, "uint24": 3}


def unpacked(header: dict, planes: bytes) -> dict[str, np.ndarray]:
    """The whole numbers [N, K] of every field."""
    count, at, found = sum(header["counts"]), 0, {}
    for name, width, kind in header["fields"]:
        values = np.zeros((width, count), np.int64)
        for byte in range(SIZES[kind]):
            for column in range(width):
                values[column] |= np.frombuffer(planes, np.uint8, count, at).astype(np.int64) << 8 * byte
                at += count
        found[name] = (values.astype(np.int8) if kind == "int8" else values).T
    assert at == len(planes)
    return found


def between(values: np.ndarray, steps: int, ends: list[float]) -> np.ndarray:
    return ends[0] + values / steps * (ends[1] - ends[0])


def test_numbers_come_back_within_their_steps() -> None:
    scene = make_scene("kinematic")
    header, planes = pack(scene, 3)
    found, canonical, ranges = unpacked(header, planes), scene.canonical, header["ranges"]
    start = 0
    for rows, (low, high) in zip(header["counts"], ranges["mean"], strict=True):
        body = slice(start, start + rows)
        means = np.array(low) + found["mean"][body] / (2**20 - 1) * (np.array(high) - np.array(low))
        assert np.abs(means - canonical.means[body].numpy()).max() < 1e-4
        start += rows
    base = between(found["base"], 65535, ranges["base"])
    assert np.abs((base - 0.5) / SH_C0 - canonical.sh_dc[:, 0].numpy()).max() < 1e-3
    opacity = torch.sigmoid(canonical.opacity_logits).numpy()
    assert np.abs(found["opacity"][:, 0] / 255 - opacity).max() < 0.003
    quats = torch.nn.functional.normalize(canonical.quats, dim=1).numpy()
    assert np.abs(found["quat"] / 127 - quats).max() < 0.005
    assert np.abs(found["label"] / 255 - scene.label_channels().numpy()).max() < 0.003
    degree_2 = found["sh"].reshape(-1, 8, 3)  # what the scene draws, no more: its own degree is 2
    assert header["degree"] == 2
    for degree, columns in ((1, slice(0, 3)), (2, slice(3, 8))):
        unit = ranges["sh"][degree - 1] / 127
        assert np.abs(degree_2[:, columns] * unit - canonical.sh_rest[:, columns].numpy()).max() <= unit


@torch.no_grad()
def test_turns_and_sizes_are_those_that_are_drawn() -> None:
    scene = make_scene("kinematic")
    header, planes = pack(scene, 0)
    found, (hinge,) = unpacked(header, planes), header["instruments"][0]["axes"]
    rows = scene.canonical.body(1)
    state = scene.recorded.states[3]
    reading = state.instruments["grasper"].joints["jaw_angle"]
    posed = scene.at(state)
    turns = np.stack([between(found["turn"][rows, k], 65535, header["ranges"]["turn"][k]) for k in (0, 1)], 1)
    hinges, weights = scene.deformation.articulations[0], scene.deformation.link_weights(scene.canonical, 0)
    expected = weights[:, 1:3] @ hinges.values({"jaw_angle": reading})[0]
    assert np.abs(turns[:, 0] + turns[:, 1] * reading - expected.numpy()).max() < 1e-3
    pivot, axis = hinges.hinge(0)
    assert np.allclose(hinge["pivot"], pivot, atol=1e-5)
    assert np.allclose(hinge["axis"], axis, atol=1e-5)
    scales = np.exp(between(found["scale"], 255, header["ranges"]["scale"]))
    step = (header["ranges"]["scale"][1] - header["ranges"]["scale"][0]) / 255
    assert np.abs(np.log(scales / posed.scales.numpy())).max() < step


def test_lower_harmonics_make_a_smaller_page_and_still_scenes_have_no_instruments() -> None:
    scene = make_scene("kinematic")
    sizes = [len(pack(scene, degree)[1]) for degree in (0, 1, 2, 3)]
    assert sizes[0] < sizes[1] < sizes[2] == sizes[3]
    still = make_scene("3dgs")
    # what its capture told it, and it ignores
    still.instruments, still.recorded, still.base_corrections = (
        scene.instruments,
        scene.recorded,
        scene.base_corrections,
    )
    header, planes = pack(still, 1)
    assert header["instruments"] == []
    assert header["recorded"]["poses"] == [[]] * 8
    assert unpacked(header, planes)["turn"].shape[1] == 0


def test_lamps_that_were_found_are_packed_and_no_others() -> None:
    scene = make_scene("kinematic")
    assert pack(scene, 0)[0]["light"]["lamps"] == []
    with torch.no_grad():
        scene.shadow_offsets[1] = torch.tensor([7.0, -5.0, 1.0])
        scene.shadow_strengths[1] = 0.25
    assert pack(scene, 0)[0]["light"]["lamps"] == [[7.0, -5.0, 1.0, 0.25]]


@pytest.mark.parametrize("method", ["nps", "deformable-3dgs", "4dgs", "nerfies"])
def test_a_network_for_every_state_is_refused_in_one_line(method: str, tmp_path: Path) -> None:
    scene = make_nerf() if method == "nerfies" else make_scene(method)
    with torch.no_grad():
        run = write_run(scene, tmp_path / "run", write_recorded_images(scene, tmp_path / "capture"))
    with pytest.raises(NeecoError, match=rf"--export: method {method} .*neeco view RUN") as refusal:
        export_page(run, tmp_path / "page.html", 3, CPU)
    assert "\n" not in str(refusal.value)


def renamed(scene: GaussianScene, name: str) -> GaussianScene:
    (instrument,) = scene.instruments
    recorded = scene.recorded
    states = tuple(replace(state, instruments={name: state.instruments["grasper"]}) for state in recorded.states)
    scene.instruments = scene.deformation.instruments = (replace(instrument, name=name),)
    scene.recorded = replace(recorded, states=states, names=(name,) * len(states))
    scene.deformation.label_names = tuple((name, part) for _, part in scene.deformation.label_names)
    return scene


def test_names_with_markup_stay_names() -> None:
    hostile = '</script><script>alert(1)</script><img src=x onerror="alert(2)">'
    header, planes = pack(renamed(make_scene("kinematic"), hostile), 0)
    page = page_of(header, planes, hostile, [(hostile, hostile)])
    assert "alert(1)</script>" not in page
    assert "<img" not in page
    assert page.count("<script") == 5
    head = re.search(r'id="head">([^<]*)<', page).group(1)
    assert json.loads(zlib.decompress(base64.b64decode(head)))["instruments"][0]["name"] == hostile


def test_the_policy_allows_the_pages_own_script_and_style_and_nothing_else() -> None:
    page = page_of(*pack(make_scene("kinematic"), 0), "run", [])
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page).group(1)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert "unsafe-inline" not in policy
    assert "http" not in policy

    def hash_of(tag: str) -> str:
        text = re.findall(rf"<{tag}>(.*?)</{tag.split()[0]}>", page, re.DOTALL)[-1]
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    assert rules["script-src"].split() == [hash_of('script type="module"'), "'wasm-unsafe-eval'", "blob:"]
    assert rules["style-src"] == hash_of("style")
    assert not re.search(r"https?://", page)


@pytest.mark.parametrize("degree", [-1, 4])
def test_degrees_that_are_none_are_refused(tmp_path: Path, degree: int) -> None:
    with pytest.raises(NeecoError, match=r"--sh must be 0 to 3"):
        export_page(tmp_path, tmp_path / "page.html", degree, CPU)
    assert not (tmp_path / "page.html").exists()


def test_the_documentations_page_is_of_this_code_and_version() -> None:
    """Else: python tools/sample_page.py."""
    page = (Path(__file__).parents[2] / "docs" / "liver-mini.html").read_text(encoding="utf-8")
    assert f"<dd>neeco {neeco.__version__}</dd>" in page
    folder = Path(neeco.__file__).parent / "viewer"
    for script in sorted((folder / "page").glob("*.js")):
        assert script.read_text(encoding="utf-8") in page, script.name
    wasm = re.search(r'id="wasm">(.*?)</script>', page)
    assert wasm is not None
    assert zlib.decompress(base64.b64decode(wasm[1])) == (folder / "viewer.wasm").read_bytes()


def test_numbers_that_are_not_finite_are_in_no_page() -> None:
    scene = make_scene("kinematic")
    header, planes = pack(scene, 3)
    header["light"]["falloff"][0] = float("inf")
    with pytest.raises(NeecoError, match="--export: the scene holds numbers that are not finite"):
        page_of(header, planes, "title", [])
    scene.canonical.means[0] = torch.nan
    with pytest.raises(NeecoError, match="--export: the scene holds numbers that are not finite"):
        pack(scene, 3)
