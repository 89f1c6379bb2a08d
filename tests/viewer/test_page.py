"""The exported page in a real browser: the pictures are those of `rasterize`, and every control does what it says."""

from __future__ import annotations

import base64
import html
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scene_worlds import GRASPER, grasper_state, make_scene, pose_of
from wristed_world import make_driver

from neeco.capture.model import State
from neeco.evaluation.image_metrics import psnr
from neeco.geometry.camera import Camera
from neeco.labels.labellers import composited_labels, threshold_of
from neeco.scene.canonical import CanonicalGaussians, join_bodies, seed_gaussians
from neeco.scene.drawable import Recorded
from neeco.scene.gaussian_scene import GaussianScene
from neeco.synthesis.samplers import shafts_of
from neeco.viewer.export import pack, page_of
from neeco.viewer.views import Controls, InstrumentControls, controlled_state

pytestmark = pytest.mark.browser

FRAMES = 6
READY_S = 20.0
ALL = 2  # the view that labels are told in
DRAWN = """async ([frame, view]) => {
  const page = window.neeco;
  if (frame !== null) { page.follow(true); page.toFrame(frame); }
  const { width, height, pixels, ids, depths } = await page.whole(view);
  const text = (array) => btoa(Array.from(new Uint8Array(array.buffer), (byte) => String.fromCharCode(byte)).join(""));
  return [width, height, text(pixels), text(ids), text(depths)];
}"""


def wall(generator: torch.Generator) -> CanonicalGaussians:
    """Tissue of many colours 95 mm before the camera, a little beyond its image."""
    x, y = torch.meshgrid(torch.arange(-70.0, 71.0, 5.0), torch.arange(-50.0, 51.0, 5.0), indexing="ij")
    positions = torch.stack([x.flatten(), y.flatten(), torch.full((x.numel(),), 95.0)], 1)
    colors = torch.rand(len(positions), 3, generator=generator)
    return seed_gaussians(positions, colors, torch.full((len(positions),), 3.5), opacity=0.95)


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    """A grasper of random Gaussians over a wall, under two lamps beside the lens."""
    generator = torch.Generator().manual_seed(1)
    scene = make_scene("kinematic")
    grasper = scene.canonical.map(lambda tensor: tensor[scene.canonical.body(1)], (scene.canonical.counts[1],))
    tissue = wall(generator).with_extras(part_logits=torch.zeros(609, 3))
    scene.canonical = join_bodies([tissue, grasper])
    camera = Camera(torch.eye(4, dtype=torch.float64), fx=110.0, fy=112.0, cx=63.0, cy=47.0, width=128, height=96)
    cameras = tuple(
        replace(camera, world_from_camera=pose_of(0.02 * k, -0.03 * k, 0.05 * k, 3 * k, -k, k)) for k in range(FRAMES)
    )
    poses = [pose_of(0.3 * k - 1, 0.2 * k, 0.1, 2 * k - 6, 3 - k, 70 - k) for k in range(FRAMES)]
    states = tuple(grasper_state(pose, 0.1 * k, 0.04 * k) for k, pose in enumerate(poses))
    names = tuple(f"{k:06d}" for k in range(FRAMES))
    scene.recorded = Recorded(names, ("train",) * FRAMES, states, cameras)
    scene.background = 0.3
    with torch.no_grad():
        scene.falloff.copy_(torch.tensor([0.8, 1.2]))
        scene.vignette.copy_(torch.tensor([-0.3, 0.1]))
        scene.shadow_offsets[0] = torch.tensor([9.0, -5.0, 0.0])
        scene.shadow_offsets[2] = torch.tensor([-6.0, 8.0, 1.0])
        scene.shadow_strengths.copy_(torch.tensor([0.5, 0.0, 0.3]))
    return scene.requires_grad_(False)


class Page:
    """The exported page, opened from a file."""

    def __init__(self, browser: Any, path: Path, width: int = 900, height: int = 600) -> None:
        self.page = browser.new_page(viewport={"width": width, "height": height})
        self.requests: list[str] = []
        self.errors: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda message: self.errors.append(message.text))
        self.page.goto(path.as_uri())
        until = time.monotonic() + READY_S
        while not self.page.evaluate("Boolean(window.neeco && window.neeco.drawn)"):
            assert time.monotonic() < until, self.page.inner_text("#failed") or self.errors
            time.sleep(0.05)

    def drawn(self, frame: float | None = None, view: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Image [H, W, 3] in [0, 1], label ids [H, W] and depth [H, W] mm; None: of what the page is at."""
        width, height, *parts = self.page.evaluate(DRAWN, [frame, view])
        pixels, ids, depths = (base64.b64decode(part) for part in parts)
        image = np.frombuffer(pixels, np.uint8).reshape(height, width, 4)[..., :3] / 255
        return (
            image,
            np.frombuffer(ids, np.uint8).reshape(height, width),
            np.frombuffer(depths, "<f4").reshape(height, width),
        )

    def slide(self, name: str, value: float) -> None:
        """Move a slider as a user does; its step may round the value."""
        self.page.evaluate(
            "([name, value]) => { const input = document.querySelector(`input[name=${name}]`); input.value = value; "
            "input.dispatchEvent(new Event('input')); }",
            [name, value],
        )

    def value(self, name: str) -> float:
        return float(self.page.evaluate("name => Number(document.querySelector(`input[name=${name}]`).value)", name))


@pytest.fixture(scope="module")
def exported(scene: GaussianScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "grasper.html"
    path.write_text(page_of(*pack(scene, 3), "grasper", [("method", "kinematic")]))
    return path


@pytest.fixture
def page(chromium: Any, exported: Path) -> Iterator[Page]:
    opened = Page(chromium, exported)
    yield opened
    opened.page.close()


def decibels(image: np.ndarray, truth: np.ndarray, where: np.ndarray | None = None) -> float:
    counted = None if where is None else torch.from_numpy(where)
    return psnr(torch.from_numpy(image), torch.from_numpy(truth), counted)


@torch.no_grad()
def agree(page: Page, scene: GaussianScene, state: State, camera: Camera, frame: float | None) -> None:
    """What the page shows is what the scene draws: 50 dB, label ids in 99.9 % of pixels, depth within quantisation."""
    truth = scene.render(state, camera, labels=True)
    parts = composited_labels(truth, threshold_of(scene))[0].numpy()
    shown = truth.color.clamp(0, 1).numpy()
    assert (parts > 0).sum() > 50
    image, _, depths = page.drawn(frame)
    assert decibels(image, shown) > 50
    assert decibels(image, shown, parts > 0) > 50
    _, ids, _ = page.drawn(frame, ALL)
    assert (ids == parts).mean() >= 0.999
    solid = truth.alpha.numpy() > 0.5
    assert np.quantile(np.abs(depths - truth.depth.numpy())[solid], 0.99) < 0.5


def test_recorded_frames_look_as_the_scene_draws_them(page: Page, scene: GaussianScene) -> None:
    for k in (0, 3, FRAMES - 1):
        agree(page, scene, scene.recorded.states[k], scene.recorded.cameras[k], k)
    assert page.errors == []


def test_without_its_shadows_it_would_not(page: Page, scene: GaussianScene) -> None:
    strengths = scene.shadow_strengths.clone()
    scene.shadow_strengths.zero_()
    try:
        with torch.no_grad():
            bare = scene.render(scene.recorded.states[3], scene.recorded.cameras[3]).color.clamp(0, 1).numpy()
    finally:
        scene.shadow_strengths.copy_(strengths)
    assert decibels(page.drawn(3)[0], bare) < 40


@pytest.mark.parametrize(
    ("name", "value"), [("jaw_angle", 0.31), ("slide", 6.0), ("roll", 0.8), ("yaw", 0.25), ("pitch", -0.3)]
)
def test_every_slider_moves_the_instrument_as_the_server_does(page, scene, name, value):
    page.page.evaluate("window.neeco.toFrame(2)")
    before = page.drawn()[0]
    page.slide(name, value)
    set_to = page.value(name)
    assert set_to == pytest.approx(value, abs=0.3)
    steered = InstrumentControls(joints={name: set_to}) if name == "jaw_angle" else InstrumentControls(**{name: set_to})
    controls = Controls(2.0, {GRASPER.name: steered})
    state = controlled_state(scene.recorded.states, shafts_of(scene), controls)
    agree(page, scene, state, scene.recorded.cameras[2], None)
    assert decibels(page.drawn()[0], before) < 40
    page.page.get_by_role("button", name="as recorded").click()
    assert np.array_equal(page.drawn()[0], before)


@pytest.fixture(scope="module")
def driver(scene: GaussianScene) -> GaussianScene:
    """A driver with a wrist and a blade that slides, over the same wall."""
    driver = make_driver(FRAMES)
    own = driver.canonical.map(lambda tensor: tensor[driver.canonical.body(1)], (driver.canonical.counts[1],))
    tissue = scene.canonical.map(lambda tensor: tensor[scene.canonical.body(0)], (scene.canonical.counts[0],))
    logits = own.extras["part_logits"]
    driver.canonical = join_bodies(
        [tissue.with_extras(part_logits=logits.new_zeros(len(tissue), logits.shape[1])), own]
    )
    driver.recorded = replace(driver.recorded, cameras=scene.recorded.cameras)
    return driver.requires_grad_(False)


@pytest.mark.parametrize(
    ("name", "value"), [("pitch", -0.5), ("yaw", 0.6), ("jaw", 1.1), ("blade_mm", 0.8), (None, None)]
)
def test_sliders_move_every_joint_of_a_wrist_as_the_server_does(chromium, driver, tmp_path, name, value):
    path = tmp_path / "driver.html"
    path.write_text(page_of(*pack(driver, 3), "driver", [("method", "kinematic")]))
    opened = Page(chromium, path)
    opened.page.evaluate("window.neeco.toFrame(2)")
    joints = {}
    if name is not None:
        opened.slide(name, value)
        joints = {name: opened.value(name)}
    controls = Controls(2.0, {"driver": InstrumentControls(joints=joints)} if joints else {})
    state = controlled_state(driver.recorded.states, shafts_of(driver), controls)
    agree(opened, driver, state, driver.recorded.cameras[2], None)
    opened.page.close()


def test_between_frames_it_interpolates_as_the_server_does(page: Page, scene: GaussianScene) -> None:
    page.slide("frame", 2.5)
    state = controlled_state(scene.recorded.states, {}, Controls(2.5))
    matrix = page.page.evaluate("window.neeco.eye.matrix")
    pose = torch.cat([torch.tensor(matrix, dtype=torch.float64).reshape(3, 4), torch.tensor([[0.0, 0, 0, 1]])])
    agree(page, scene, state, replace(scene.recorded.cameras[2], world_from_camera=pose), None)


def test_dragging_turns_the_camera_and_the_button_brings_it_back(page: Page) -> None:
    before = page.drawn()[0]
    box = page.page.locator("canvas").bounding_box()
    page.page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 160, box["y"] + 120, steps=4)
    page.page.mouse.up()
    turned = page.drawn()[0]
    assert decibels(turned, before) < 30
    page.page.mouse.wheel(0, -200)
    assert decibels(page.drawn()[0], turned) < 35
    page.page.get_by_role("button", name="recorded camera").click()
    assert np.array_equal(page.drawn()[0], before)


@torch.no_grad()
def test_a_camera_moved_by_hand_keeps_the_light_where_it_was_recorded(page: Page, scene: GaussianScene) -> None:
    """Nearer by a third, the scene is as bright as before; a headlight that moves along would make it brighter."""
    page.page.evaluate("window.neeco.toFrame(2)")
    page.page.evaluate("window.neeco.eye.nearer(0.4)")
    matrix = torch.tensor(page.page.evaluate("window.neeco.eye.matrix"), dtype=torch.float64).reshape(3, 4)
    recorded = scene.recorded.cameras[2]
    camera = replace(recorded, world_from_camera=torch.cat([matrix, torch.tensor([[0.0, 0, 0, 1]])]))
    state, strengths = scene.recorded.states[2], scene.shadow_strengths.clone()
    apart = float((camera.world_from_camera[:3, 3] - recorded.world_from_camera[:3, 3]).norm())
    assert apart > 20
    shown, truth = page.drawn()[0], scene.render(state, camera).color.clamp(0, 1).numpy()
    falloff = scene.falloff.clone()
    try:
        scene.falloff.zero_()
        scene.shadow_strengths.zero_()
        unlit = [scene.render(state, view).color.clamp(0, 1).numpy() for view in (recorded, camera)]
    finally:
        scene.falloff.copy_(falloff)
        scene.shadow_strengths.copy_(strengths)
    # brightness by the light alone, at the image's middle
    middle = np.s_[38:58, 50:76]
    before = page_at(page, 2)[middle].mean() / unlit[0][middle].mean()
    assert shown[middle].mean() / unlit[1][middle].mean() == pytest.approx(before, rel=0.15)
    assert truth[middle].mean() > 1.2 * shown[middle].mean()


def page_at(page: Page, frame: int) -> np.ndarray:
    return page.drawn(frame)[0]


def badge(page: Page) -> bool:
    page.drawn()
    page.page.wait_for_timeout(400)
    return bool(page.page.locator("#unobserved").is_visible())


def test_a_hand_leads_not_far_from_what_was_recorded_and_the_page_says_what_no_frame_observed(page: Page) -> None:
    assert not badge(page)
    page.page.locator("canvas").hover()
    page.page.mouse.wheel(0, -30)
    assert not badge(page)
    strayed = "window.neeco.eye.strayed(window.neeco.eye.matrix)"
    for act in ("orbit(25, 3)", "shift(-25, 10)", "nearer(0.2)", "nearer(-0.2)"):
        for _ in range(60):
            page.page.evaluate(f"window.neeco.eye.{act}")
        assert 0.5 < page.page.evaluate(strayed) <= 1
        assert badge(page)
        page.page.evaluate("window.neeco.follow(true)")
        assert not badge(page)


@pytest.mark.parametrize("how", ["key", "double click"])
def test_the_recorded_view_comes_back(page: Page, how: str) -> None:
    before = page.drawn()[0]
    page.slide("roll", 0.8)
    for _ in range(30):
        page.page.evaluate("window.neeco.eye.orbit(25, 3)")
    if how == "key":
        page.page.keyboard.press("r")
        assert page.value("roll") == pytest.approx(0)
    else:
        page.page.locator("canvas").dblclick()
        page.slide("roll", 0.0)
    assert np.array_equal(page.drawn()[0], before)


WIDTHS = """window.widths = [];
addEventListener("DOMContentLoaded", () => {
  const canvas = document.querySelector("canvas"), watch = { attributes: true, attributeFilter: ["width"] };
  new MutationObserver(() => widths.push(canvas.width)).observe(canvas, watch);
});"""


@pytest.mark.parametrize("size", [(900, 600), (390, 844)])
def test_the_first_picture_is_a_sharp_one(chromium: Any, exported: Path, size: tuple[int, int]) -> None:
    page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
    page.add_init_script(WIDTHS)
    page.goto(exported.as_uri())
    page.get_by_text("000000 ·").wait_for(timeout=1e3 * READY_S)
    page.wait_for_timeout(800)
    assert page.evaluate("widths") == [256]  # twice the recorded width
    page.close()


def test_sliders_have_names_and_values_with_units_and_keep_their_arrows(page: Page) -> None:
    jaw = page.page.get_by_role("slider", name="grasper: jaw angle", exact=True)
    before = float(jaw.input_value())
    jaw.focus()
    page.page.keyboard.press("ArrowRight")
    assert float(jaw.input_value()) > before
    assert jaw.evaluate("input => input.ariaValueText").endswith("°")
    assert page.value("frame") == 0.0
    assert page.page.get_by_role("slider", name="Recording: frame", exact=True).count() == 1


def test_views_keys_and_play(page: Page) -> None:
    pictures = [page.drawn(0, view)[0] for view in range(4)]
    for k in range(3):
        assert decibels(pictures[k], pictures[k + 1]) < 35
    page.page.locator("canvas").focus()
    page.page.keyboard.press("v")
    assert page.page.input_value("#view") == "1"
    page.page.keyboard.press("ArrowRight")
    assert page.value("frame") == 1.0
    page.page.keyboard.press("Space")
    for _ in range(40):  # a busy machine draws late
        page.page.wait_for_timeout(250)
        if (played := page.value("frame")) != 1.0:
            break
    page.page.keyboard.press("Space")
    assert played != 1.0


def test_saved_image_and_mask_are_of_the_recorded_size(page: Page, scene: GaussianScene, tmp_path: Path) -> None:
    from PIL import Image

    for name in ("image", "mask"):
        with page.page.expect_download() as waiting:
            page.page.get_by_role("button", name=f"save {name}").click()
        waiting.value.save_as(tmp_path / f"{name}.png")
    truth = scene.render(scene.recorded.states[0], scene.recorded.cameras[0], labels=True)
    parts = composited_labels(truth, threshold_of(scene))[0].numpy()
    image = np.asarray(Image.open(tmp_path / "image.png").convert("RGB")) / 255
    assert decibels(image, truth.color.clamp(0, 1).numpy()) > 50
    mask = np.asarray(Image.open(tmp_path / "mask.png").convert("L"))
    assert set(np.unique(mask)) == {0, 255}
    assert ((mask > 0) == (parts > 0)).mean() >= 0.999


def test_it_asks_for_nothing_but_itself_and_runs_under_its_policy(chromium: Any, exported: Path) -> None:
    opened = Page(chromium, exported)
    opened.drawn(1)
    assert [url for url in opened.requests if not url.startswith(("data:", "blob:"))] == [exported.as_uri()]
    refused = opened.page.evaluate("fetch('https://example.org/').then(() => 'fetched', () => 'refused')")
    assert refused == "refused"
    opened.page.close()


def test_it_draws_in_a_sandboxed_frame_of_a_report(chromium: Any, exported: Path, tmp_path: Path) -> None:
    report = tmp_path / "report.html"
    frame = f'<iframe sandbox="allow-scripts" width="900" height="600" srcdoc="{html.escape(exported.read_text())}">'
    report.write_text(f"<!doctype html><title>report</title>{frame}</iframe>")
    page = chromium.new_page()
    page.goto(report.as_uri())
    page.frame_locator("iframe").get_by_text("000000 ·").wait_for(timeout=1e3 * READY_S)
    assert not page.frame_locator("iframe").locator("#failed").is_visible()
    page.close()


def test_on_a_phone_the_picture_is_as_wide_as_the_page_and_nothing_overflows(chromium: Any, exported: Path) -> None:
    opened = Page(chromium, exported, 390, 844)
    assert opened.page.locator("canvas").bounding_box()["width"] > 350
    assert opened.page.evaluate("document.documentElement.scrollWidth") <= 390
    opened.page.close()


def said(chromium: Any, path: Path) -> str:
    page = chromium.new_page()
    page.goto(path.as_uri())
    page.locator("#failed").wait_for(state="visible", timeout=10_000)
    text = str(page.inner_text("#failed"))
    page.close()
    return text


def test_a_damaged_file_says_so(chromium: Any, exported: Path, tmp_path: Path) -> None:
    text = exported.read_text()
    at = text.index('id="scene">') + 2000
    broken = tmp_path / "broken.html"
    broken.write_text(text[:at] + "AAAA" + text[at + 4 :])
    assert "could not be rendered" in said(chromium, broken)


@pytest.mark.parametrize(
    "change",
    [
        {"counts": [10**12, 40]},
        {"counts": [-5, 40]},
        {"degree": 900},
        {"labels": [["a", "b"]] * 400},
        {"schema": "neeco-page/9"},
        {"fields": [["mean", 10**9, "uint24"]]},
    ],
)
def test_a_hostile_file_neither_hangs_nor_shows_anything(chromium, scene, tmp_path, change):
    header, planes = pack(scene, 1)
    path = tmp_path / "hostile.html"
    path.write_text(page_of(header | change, planes, "hostile", []))
    assert "could not be rendered" in said(chromium, path)
