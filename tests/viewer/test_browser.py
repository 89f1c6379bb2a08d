"""`neeco view` in a real Chromium: every control, driven as a user drives it, shows what the rasteriser draws."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch
from scene_worlds import make_nerf, make_scene
from viewer_page import ViewerPage
from viewer_world import brighter, grasper_scene, write_recorded_images, write_run

from neeco.capture.readers import read_states
from neeco.evaluation.image_metrics import psnr
from neeco.geometry.camera import Camera
from neeco.labels.drawing import to_numpy
from neeco.scene.io import save_scene
from neeco.synthesis.samplers import shafts_of
from neeco.viewer.runs import ViewedRun
from neeco.viewer.server import ViewerServer
from neeco.viewer.views import (
    DEPTH,
    DIFFERENCE,
    IMAGE,
    OVERLAY,
    PARTS,
    UNOBSERVED,
    Controls,
    InstrumentControls,
    controlled_state,
    fitting_view,
    picture,
    views_of,
)

pytestmark = pytest.mark.browser
pytest.importorskip("viser")

Serve = Callable[..., ViewerServer]
ALIKE_DB = 33.0  # JPEG of quality 92 leaves about that of a small, colourful picture
UNLIKE_DB = 28.0
JAW = "jaw_angle (°)"
HARMLESS = "Evaluating a string as JavaScript"  # viser's sorter of Gaussians, which is not used, may not do so


def window(recorded: Camera, shape: tuple[int, ...]) -> Camera:
    """A recorded camera as a window of that many pixels shows it."""
    height, width = shape[:2]
    focal = height / 2 / math.tan(fitting_view(recorded, width / height) / 2)
    return replace(recorded, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height)


def alike(shown: np.ndarray, scene: Any, frame: float = 0.0, seen_by: int = 0, view: str = IMAGE, **steered) -> float:
    """PSNR in dB of a browser's picture against what the rasteriser draws of a steered state."""
    name = scene.instruments[0].name
    controls = Controls(frame, {name: InstrumentControls(**steered)})
    state = controlled_state(scene.recorded.states, shafts_of(scene), controls)
    drawn = picture(scene, state, window(scene.recorded.cameras[seen_by], shown.shape), view).pixels
    return psnr(torch.from_numpy(shown / 255), torch.from_numpy(drawn / 255))


@pytest.fixture(scope="module")
def scene():
    return grasper_scene()


@pytest.fixture
def page(made_run: Path, serve: Serve, context: Any) -> ViewerPage:
    server = serve(made_run, port=18200)
    page = ViewerPage(context, server.address)
    page.server = server
    return page


def test_it_opens_with_the_first_frame_and_its_numbers(page: ViewerPage, scene) -> None:
    assert alike(page.settled(), scene) > ALIKE_DB
    page.wait_for("PSNR")
    assert "IoU 1.000" in page.text()
    assert f"{scene.num_gaussians:,} Gaussians" in page.text()


def test_every_slider_shows_what_the_rasteriser_draws(page: ViewerPage, scene) -> None:
    page.settled()
    page.tick("camera of the frame")  # so that the camera stays
    controls: dict[str, Any] = {}
    for label, value, wish, number in (
        (JAW, 60.0, "joints", {"jaw_angle": math.radians(60)}),
        ("along shaft (mm)", 8.0, "slide", 8.0),
        ("roll (°)", 70.0, "roll", math.radians(70)),
        ("yaw (°)", 20.0, "yaw", math.radians(20)),
        ("pitch (°)", -15.0, "pitch", math.radians(-15)),
    ):
        before = dict(controls)
        controls[wish] = number
        shown = page.set(label, value)
        assert alike(shown, scene, **controls) > ALIKE_DB, label
        if wish != "roll":  # a round shaft rolled looks nearly the same
            assert alike(shown, scene, **before) < alike(shown, scene, **controls) - 1.0, label
    shown = page.set("frame", 4.5)
    assert alike(shown, scene, 4.5, **controls) > ALIKE_DB
    shown = page.after(lambda: page.press("back to the recording"))
    assert alike(shown, scene, 4.5) > ALIKE_DB
    assert [page.value(label) for label in ("roll (°)", "yaw (°)", "pitch (°)")] == [0.0, 0.0, 0.0]


def test_joints_follow_the_recording_until_one_is_moved(page: ViewerPage) -> None:
    page.settled()
    page.set("frame", 5.0)
    assert page.value(JAW) == pytest.approx(math.degrees(0.5), abs=0.5)
    page.set(JAW, 10.0)
    page.set("frame", 7.0)
    assert page.value(JAW) == 10.0
    page.after(lambda: page.press("back to the recording"))
    assert page.value(JAW) == pytest.approx(math.degrees(0.7), abs=0.5)


def test_arrows_on_a_focused_slider_turn_no_camera(page: ViewerPage, scene) -> None:
    page.settled()
    page._row("frame").get_by_role("slider").first.focus()
    shown = page.after(lambda: page.page.keyboard.press("ArrowRight", delay=400))
    frame = page.value("frame")
    assert frame > 0
    assert alike(shown, scene, frame, seen_by=round(frame)) > ALIKE_DB


def test_the_camera_goes_along_with_the_frames_and_jumps_back_exactly(page: ViewerPage, scene) -> None:
    page.settled()
    shown = page.set("frame", 6.0)
    assert alike(shown, scene, 6.0, seen_by=6) > ALIKE_DB
    turned = page.after(lambda: page.drag(200, 200, 260, 230))
    assert alike(turned, scene, 6.0, seen_by=6) < UNLIKE_DB
    shown = page.after(lambda: page.press("go to this frame's camera"))
    assert alike(shown, scene, 6.0, seen_by=6) > ALIKE_DB
    page.wait_for("PSNR")


@pytest.mark.parametrize("view", [OVERLAY, PARTS, DEPTH, UNOBSERVED])
def test_every_view_is_the_one_that_is_named(page: ViewerPage, scene, view: str) -> None:
    page.settled()
    shown = page.after(lambda: page.choose("show", view))
    assert alike(shown, scene, view=view) > UNLIKE_DB
    assert alike(shown, scene, view=IMAGE) < UNLIKE_DB


def test_the_difference_is_shown_only_where_there_is_a_recorded_image(page: ViewerPage) -> None:
    page.settled()
    shown = page.after(lambda: page.choose("show", DIFFERENCE))
    assert shown.mean() < 4  # the scene drew that image
    shown = page.set("roll (°)", 30.0)
    assert shown.mean() > 10
    page.wait_for("only of a recorded state")


def test_play_goes_on_by_itself_and_stops(page: ViewerPage) -> None:
    page.settled()
    page.tick("play")
    seen = set()
    for _ in range(100):
        seen.add(page.value("frame"))
        if len(seen) > 2:
            break
        page.page.wait_for_timeout(50)
    assert len(seen) > 2  # it begins again at the end, so one look could find the first frame
    page.tick("play")
    page.settled()
    stopped = page.value("frame")
    page.page.wait_for_timeout(400)
    assert page.value("frame") == stopped


def test_the_gizmo_takes_the_instrument_along(page: ViewerPage, scene) -> None:
    page.settled()
    page.set("along shaft (mm)", 5.0)
    page.tick("drag it in the scene")
    held = page.settled()
    assert alike(held, scene, slide=5.0) > ALIKE_DB
    assert page.comes_to("along shaft (mm)", 0.0)
    page.set("frame", 6.0)  # held where it is
    page.press("go to this frame's camera")
    pose = to_numpy(
        controlled_state(
            scene.recorded.states, shafts_of(scene), Controls(0.0, {"grasper": InstrumentControls(slide=5.0)})
        )
        .instruments["grasper"]
        .pose
    )
    assert alike(page.settled(), scene, 6.0, seen_by=6, pose=pose) > ALIKE_DB
    page.press("back to the recording")
    page.set("frame", 0.0)
    assert alike(page.settled(), scene) > ALIKE_DB


def test_cameras_and_points_are_drawn_over_the_picture(page: ViewerPage) -> None:
    page.settled()
    page.drag(200, 200, 300, 200)
    page.zoom(3000)
    page.settled()
    plain = page.screenshot()
    page.after(lambda: page.tick("recorded cameras"))
    page.page.wait_for_timeout(500)
    with_cameras = page.screenshot()
    yellow = (np.array([255, 200, 0]) - with_cameras.astype(int)).__abs__().sum(-1) < 120
    assert yellow.sum() > 20
    page.tick("recorded cameras")
    page.after(lambda: page.tick("sparse points"))
    page.page.wait_for_timeout(500)
    assert np.abs(page.screenshot().astype(int) - plain).max() > 60


def test_a_click_on_a_recorded_camera_leads_exactly_there(page: ViewerPage, scene) -> None:
    page.settled()
    page.drag(200, 200, 300, 200)
    page.zoom(3000)
    page.settled()
    page.after(lambda: page.tick("recorded cameras"))
    page.page.wait_for_timeout(500)
    x, y = page.pixel_like(231, 205, 71)  # as the page tones it
    shown = page.after(lambda: page.page.mouse.click(x, y))
    assert max(alike(shown, scene, seen_by=frame) for frame in range(len(scene.recorded.cameras))) > ALIKE_DB


def test_an_arrow_of_the_gizmo_drags_the_instrument_and_turns_nothing(page: ViewerPage, scene, made_run: Path) -> None:
    page.settled()
    page.tick("drag it in the scene")
    assert alike(page.settled(), scene) > ALIKE_DB
    page.page.wait_for_timeout(500)
    x, y = page.pixel_like(60, 140, 240, 90)
    after = page.after(lambda: page.drag(x, y, x + 40, y + 25))
    assert alike(after, scene) < ALIKE_DB  # the instrument is small in the picture
    (session,) = page.server.render_thread.sessions
    start = to_numpy(scene.recorded.states[0].instruments["grasper"].pose)
    end = session.overlays.gizmo_pose("grasper")
    assert end[:3, :3] == pytest.approx(start[:3, :3], abs=1e-3)
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) > 1.0
    assert alike(after, scene, pose=end) > ALIKE_DB


def test_the_worst_frame_is_one_choice_away(serve: Serve, context: Any, tmp_path: Path) -> None:
    scene = grasper_scene()
    capture = write_recorded_images(scene, tmp_path / "capture")
    spoiled = capture / "images" / "000005.png"
    shutil.copy(capture / "images" / "000000.png", spoiled)
    page = ViewerPage(context, serve(write_run(scene, tmp_path / "run", capture)).address, 900, 900)
    page.settled()
    page.page.wait_for_timeout(1500)
    page.set("roll (°)", 40.0)
    shown = page.after(lambda: page.choose("worst", "5: "))
    assert page.value("frame") == 5.0
    assert page.value("roll (°)") == 0.0
    assert alike(shown, scene, 5.0, seen_by=5) > ALIKE_DB


def test_kept_states_and_images_are_what_was_shown(serve: Serve, context: Any, made_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(made_run, run)
    page = ViewerPage(context, serve(run).address, 640, 900)
    page.settled()
    page.set("roll (°)", 40.0)
    page.press("keep this state")
    page.wait_for("kept: 1 in")
    page.set("frame", 3.0)
    page.press("keep this state")
    page.wait_for("kept: 2 in")
    loaded = ViewedRun(run).loaded
    first, second = read_states(run / "kept" / "states.jsonl", loaded.scene.instruments)
    controls = [Controls(frame, {"grasper": InstrumentControls(roll=math.radians(40))}) for frame in (0.0, 3.0)]
    for kept, asked_for in zip((first, second), controls, strict=True):
        state = controlled_state(loaded.recorded.states, loaded.shafts, asked_for)
        assert torch.allclose(kept.state.instruments["grasper"].pose, state.instruments["grasper"].pose)
        taken_by = loaded.recorded.cameras[int(asked_for.frame)]
        assert kept.world_from_camera == pytest.approx(to_numpy(taken_by.world_from_camera), abs=1e-4)
    page.press("save labelled image")
    page.wait_for("written:")
    record = json.loads((run / "kept" / "samples" / ".records" / "000000.json").read_text())
    assert (record["width"], record["height"]) == (64, 48)


def test_two_browsers_each_have_their_own_state(page: ViewerPage, context: Any, scene) -> None:
    other = ViewerPage(context, page.address)
    before = other.settled()
    page.settled()
    shown = page.set("frame", 7.0)
    assert alike(shown, scene, 7.0, seen_by=7) > ALIKE_DB
    assert other.value("frame") == 0.0
    assert (other.settled() == before).all()


def test_a_run_that_changes_is_shown_anew(serve: Serve, context: Any, made_run: Path, tmp_path: Path) -> None:
    run, lighter = tmp_path / "run", brighter(grasper_scene())
    shutil.copytree(made_run, run)
    page = ViewerPage(context, serve(run).address)
    before = page.set("frame", 2.0)
    after = page.after(lambda: save_scene(lighter, run / "scene.safetensors"))
    assert after.mean() > before.mean() + 20
    assert page.value("frame") == 2.0
    assert alike(after, lighter, 2.0, seen_by=2) > ALIKE_DB


@pytest.mark.parametrize("method", ["nps", "3dgs", "deformable-3dgs", "4dgs", "nerfies"])
def test_every_method_is_shown_in_all_its_views(method: str, serve: Serve, context: Any, tmp_path: Path) -> None:
    scene = make_nerf(chunk=4096) if method == "nerfies" else make_scene(method)  # 7 rays at a time take half a minute
    with torch.no_grad():
        run = write_run(scene, tmp_path / "run", write_recorded_images(scene, tmp_path / "capture"))
    page = ViewerPage(context, serve(run).address)
    shown = [page.settled()]
    for view in views_of(scene, True)[1:]:
        shown.append(page.after(lambda view=view: page.choose("show", view)))
    page.set("frame", 1.0)
    assert all(item.std() > 0 for item in shown[:1])
    assert page.wait_for(f"{method} ·") is None
    assert "error" not in page.text().lower()


def test_nothing_is_asked_of_another_host(page: ViewerPage) -> None:
    page.settled()
    for view in (PARTS, DEPTH, IMAGE):
        page.after(lambda view=view: page.choose("show", view))
    page.tick("recorded cameras")
    page.tick("sparse points")
    page.settled()
    own = urlsplit(page.address).netloc
    asked = {urlsplit(url.removeprefix("blob:")).netloc for url in page.requests if not url.startswith("data:")}
    assert asked == {own}
    assert any(url.startswith("ws:") for url in page.requests)
    assert [error for error in page.errors if HARMLESS not in error] == []


def test_a_page_that_is_told_to_go_elsewhere_may_not(page: ViewerPage) -> None:
    page.settled()
    for attempt in (
        "fetch('http://192.0.2.1/')",
        "new Promise((y, n) => { const s = new WebSocket('ws://192.0.2.1/'); s.onerror = n; s.onopen = y; })",
    ):
        blocked = page.page.evaluate(
            f"async () => {{ try {{ await {attempt}; return 'went'; }} catch (e) {{ return 'blocked'; }} }}"
        )
        assert blocked == "blocked"
    told = page.response.headers["content-security-policy"]
    assert "connect-src 'self'" in told


HOSTILE = '<img src=x onerror="window.hacked=1"><script>window.hacked=2</script>{window.hacked=3}'


def test_names_of_a_hostile_run_inject_nothing(serve: Serve, context: Any, tmp_path: Path) -> None:
    scene = grasper_scene(HOSTILE, HOSTILE + "joint", "<img src=x onerror=alert(1)>{:06d}")
    capture = write_recorded_images(scene, tmp_path / "capture", masks=False)
    run = write_run(scene, tmp_path / "<img src=x onerror=alert(2)>", capture)
    dialogs: list[str] = []
    page = ViewerPage(context, serve(run).address, 900, 900)
    page.page.on("dialog", lambda dialog: (dialogs.append(dialog.message), dialog.dismiss()))
    page.settled()
    page.set("frame", 3.0)
    page.page.wait_for_timeout(1500)  # the timeline lists its names, too
    page.press("keep this state")
    page.wait_for("kept: 1 in")
    assert page.page.evaluate("window.hacked === undefined")
    assert page.page.evaluate("document.querySelectorAll('img[src=x]').length") == 0
    assert dialogs == []
    assert "<img src=x onerror=" in page.text()


@pytest.mark.parametrize(("width", "height"), [(390, 780), (1280, 800)])
def test_panel_and_picture_both_show_at_any_width(page: ViewerPage, width: int, height: int) -> None:
    page.page.set_viewport_size({"width": width, "height": height})
    page.settled()
    page.page.wait_for_timeout(500)
    panel = page.page.get_by_text("go to this frame's camera").bounding_box()
    assert panel["x"] >= 0
    assert panel["x"] + panel["width"] <= width
    assert page.screenshot()[: height // 3, : width // 4].std() > 5
