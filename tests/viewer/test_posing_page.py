"""`neeco view CAPTURE --annotate` in a real Chromium: a person poses frames, looks again and takes an answer back."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image
from posing_world import JOINT, NAME, PosingWorld, measured_world

from neeco.ingest.posing.posed_capture import read_answers
from neeco.viewer.posing import PosingServer

pytestmark = pytest.mark.browser
BLUE, ORANGE = (53, 182, 255), (255, 154, 31)  # lines of the pin and the jaws


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> PosingWorld:
    return measured_world(tmp_path_factory.mktemp("posing") / "capture")


@pytest.fixture
def server(made: PosingWorld, tmp_path: Path) -> Iterator[PosingServer]:
    with PosingServer(Path(shutil.copytree(made.root, tmp_path / "capture")), port=18350) as started:
        yield started


@pytest.fixture
def page(server: PosingServer, context: Any) -> Any:
    opened = context.new_page()
    opened.set_viewport_size({"width": 1200, "height": 760})
    opened.errors = []
    opened.on("pageerror", lambda error: opened.errors.append(str(error)))
    opened.on("request", lambda request: opened.errors.append(request.url) if not ours(request.url, server) else None)
    opened.goto(server.address)
    opened.locator("#strip figure").first.wait_for()
    yield opened
    assert opened.errors == []


def ours(url: str, server: PosingServer) -> bool:
    return url.startswith((server.address, "data:"))


def slide(page: Any, row: int, value: float) -> None:
    """Move the roll's (0) or a joint's (1) slider."""
    page.locator("#sliders input").nth(row).fill(str(round(value)))


def colored(page: Any, color: tuple[int, int, int]) -> np.ndarray:
    """Places [N, 2] of the canvas's pixels of a colour, in shares of its width and height."""
    shot = np.asarray(Image.open(io.BytesIO(page.locator("#canvas").screenshot())).convert("RGB")).astype(int)
    v, u = np.nonzero(np.abs(shot - color).sum(-1) < 60)
    return np.stack([u / shot.shape[1], v / shot.shape[0]], -1)


def pose(page: Any, made: PosingWorld, frame: int) -> None:
    slide(page, 0, np.degrees(made.rolls[frame]))
    slide(page, 1, np.degrees(made.jaws[frame]))


def saved(page: Any, count: int) -> None:
    page.get_by_text(f"{count} of 10 suggested").wait_for(timeout=30_000)


def test_lines_follow_the_sliders(page: Any) -> None:
    slide(page, 0, 0)
    slide(page, 1, 60)
    opened = colored(page, ORANGE)
    slide(page, 1, 10)
    closed = colored(page, ORANGE)
    assert np.ptp(opened[:, 1]) > 2 * np.ptp(closed[:, 1])
    slide(page, 1, 60)
    slide(page, 0, 90)  # seen edge on, jaws open away from the camera
    assert np.ptp(colored(page, ORANGE)[:, 1]) < np.ptp(opened[:, 1]) / 2
    assert np.ptp(colored(page, BLUE)[:, 1]) > 0.15
    page.keyboard.press("h")
    assert len(colored(page, ORANGE)) == len(colored(page, BLUE)) == 0


def test_true_angles_lay_the_lines_over_the_jaws(page: Any, server: PosingServer, made: PosingWorld) -> None:
    """Where the page draws jaws, the picture shows them."""
    frame = server.overview(NAME)["suggested"][0]["frame"]
    page.keyboard.press("h")
    plain = np.asarray(Image.open(io.BytesIO(page.locator("#canvas").screenshot())).convert("L")).astype(int)
    page.keyboard.press("h")

    def on_jaws() -> float:
        places = colored(page, ORANGE)
        beyond = places[places[:, 0] > 0.62]  # of the wrist, which has the texture of the shaft
        rows, columns = (beyond[:, ::-1] * plain.shape).astype(int).T
        return float((plain[rows, columns] > 160).mean())

    pose(page, made, frame)
    assert on_jaws() > 0.9
    slide(page, 1, np.degrees(made.jaws[frame]) + 25)
    assert on_jaws() < 0.5


def test_frames_are_posed_one_after_another_by_the_keyboard(page: Any, server: PosingServer, made: PosingWorld) -> None:
    root = server.posed.root
    assert "0 of 10 suggested frames posed" in page.inner_text("aside")
    assert "not known yet" in page.inner_text("#sure")
    asked = []
    for count in range(1, 4):
        asked.append(server.overview(NAME)["suggested"][0]["frame"])
        pose(page, made, asked[-1])
        page.keyboard.press("Enter")
        saved(page, count)
        page.locator(f'figure[data-index="{server.overview(NAME)["suggested"][0]["frame"]}"]').wait_for()
    kept = read_answers(root)
    assert [answer.frame for answer in kept] == [made.capture.frames[frame].name for frame in asked]
    assert kept[1].roll_deg == pytest.approx(np.degrees(made.rolls[asked[1]]), abs=0.6)
    assert kept[1].joints_deg[JOINT] == pytest.approx(np.degrees(made.jaws[asked[1]]), abs=0.6)
    assert "±" in page.inner_text("#sure")
    page.keyboard.press("u")
    saved(page, 2)
    assert len(read_answers(root)) == 2


def test_keys_turn_skip_and_look_about(page: Any, server: PosingServer) -> None:
    first, second = (item["frame"] for item in server.overview(NAME)["suggested"][:2])
    before = float(page.locator("#sliders input").first.input_value())
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("ArrowRight")
    assert float(page.locator("#sliders input").first.input_value()) == pytest.approx(before + 12, abs=1)
    other = page.locator("#strip figure:not([aria-current])").first.get_attribute("data-index")
    page.locator(f'figure[data-index="{other}"]').click()
    page.locator(f'figure[data-index="{other}"][aria-current]').wait_for()
    assert len(colored(page, ORANGE)) == 0  # another frame, without this one's lines
    page.keyboard.press("s")
    page.locator(f'figure[data-index="{second}"][aria-current]').wait_for()
    assert first != second
    assert read_answers(server.posed.root) == []


def test_an_answer_that_does_not_fit_is_spoken_of(page: Any, server: PosingServer, made: PosingWorld) -> None:
    for frame in (0, 10, 20, 30, 39):
        server.save(NAME, frame, float(np.degrees(made.rolls[frame])), {JOINT: float(np.degrees(made.jaws[frame]))})
    page.reload()
    page.locator("#strip figure").first.wait_for()
    frame = server.overview(NAME)["suggested"][0]["frame"]
    slide(page, 0, np.degrees(made.rolls[frame]) + 60)
    slide(page, 1, np.degrees(made.jaws[frame]))
    page.keyboard.press("Enter")
    saved(page, 6)
    assert "what its neighbours say" in page.inner_text("#said")
    assert page.locator("#said.doubted").count() == 1


def test_arrows_on_a_focused_slider_move_that_slider_alone(page: Any) -> None:
    roll, jaw = (page.get_by_role("slider", name=name, exact=True) for name in ("roll", JOINT.replace("_", " ")))
    before = float(roll.input_value()), float(jaw.input_value())
    jaw.focus()
    page.keyboard.press("ArrowRight")
    assert (float(roll.input_value()), float(jaw.input_value())) == (before[0], before[1] + 1)
    assert jaw.evaluate("input => input.ariaValueText").startswith(f"{before[1] + 1:.0f}°")


def test_a_file_that_leads_to_the_address_opens_the_page_and_another_page_gets_nothing(server, context, tmp_path):
    """As `neeco view` opens a browser; the file's origin is another site's."""
    leading = tmp_path / "view.html"
    leading.write_text(f'<!doctype html><meta http-equiv="refresh" content="0;url={server.address}">')
    opened = context.new_page()
    opened.goto(leading.as_uri())
    opened.locator("#strip figure").first.wait_for(timeout=30_000)
    opened.reload()
    opened.locator("#strip figure").first.wait_for(timeout=30_000)
    address = f"http://{urlsplit(server.address).netloc}/"
    other = context.new_page()
    (tmp_path / "other.html").write_text(f'<!doctype html><img src="{address}"><a href="{address}">there</a>')
    answers: list[int] = []
    other.on("response", lambda got: answers.append(got.status) if got.url.startswith("http") else None)
    other.goto((tmp_path / "other.html").as_uri())
    other.get_by_text("there").click()
    other.wait_for_url(address)
    assert answers
    assert set(answers) == {403}
    other.close()
    opened.close()
