"""`neeco view CAPTURE --annotate` over its web socket: what the page is given, what it may save, and who may ask."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import quote, urlsplit

import numpy as np
import pytest
from PIL import Image
from posing_world import JOINT, NAME, PosingWorld, measured_world
from viewer_world import grasper_scene, write_run

from neeco.base.errors import NeecoError
from neeco.capture.readers import read_capture
from neeco.cli import main
from neeco.ingest.posing.posed_capture import read_answers
from neeco.viewer import posing
from neeco.viewer.access import Access
from neeco.viewer.posing import PosingServer

pytest.importorskip("viser")
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> PosingWorld:
    return measured_world(tmp_path_factory.mktemp("posing") / "capture")


@pytest.fixture
def server(made: PosingWorld, tmp_path: Path) -> Iterator[PosingServer]:
    with PosingServer(Path(shutil.copytree(made.root, tmp_path / "capture")), port=18300) as started:
        yield started


def converse(server: PosingServer, *messages: str) -> list[dict[str, Any]]:
    """What one page is answered."""
    with connect(server.address.replace("http", "ws")) as socket:
        for message in messages:
            socket.send(message)
        return [json.loads(socket.recv(timeout=30)) for _ in messages]


def ask(server: PosingServer, what: str, **fields: Any) -> dict[str, Any]:
    return converse(server, json.dumps({"ask": what, "instrument": NAME} | fields))[0]


def image(server: PosingServer, what: str, **fields: Any) -> Image.Image:
    with urllib.request.urlopen(address_of(server, what, fields), timeout=30) as answer:
        return Image.open(io.BytesIO(answer.read()))


def address_of(server: PosingServer, what: str, fields: Any) -> str:
    named = {"instrument": NAME} | fields if isinstance(fields, dict) else fields
    return f"{server.address}{what}/{quote(json.dumps(named), safe='')}"


def answer_for(made: PosingWorld, frame: int, turned: float = 0.0) -> dict[str, Any]:
    roll, jaw = (float(np.degrees(values[frame])) for values in (made.rolls, made.jaws))
    return {"index": frame, "roll": roll + turned, "joints": {JOINT: jaw}}


def test_the_page_is_whole_and_may_load_nothing_from_elsewhere(server: PosingServer) -> None:
    with urllib.request.urlopen(server.address, timeout=20) as answer:
        assert b"{{" not in answer.read()
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]


def test_an_answer_is_kept_and_changes_the_states(server: PosingServer, made: PosingWorld) -> None:
    root = server.posed.root
    before = ask(server, "overview")
    assert (before["done"], before["of"], before["sure"]["roll"]) == (0, 10, [180.0, 180.0])
    asked = before["suggested"][0]["frame"]
    after = ask(server, "save", **answer_for(made, asked))
    assert (after["done"], after["said"]) == (1, [])
    assert asked not in [item["frame"] for item in after["suggested"]]
    assert after["sure"]["roll"][0] < 90
    kept = read_answers(root)
    assert [answer.frame for answer in kept] == [made.capture.frames[asked].name]
    assert kept[0].when is not None
    jaw = read_capture(root).frames[asked].state.instruments[NAME].joints[JOINT]
    assert jaw == pytest.approx(made.jaws[asked], abs=0.1)
    undone = ask(server, "undo")
    assert (undone["done"], undone["frame"]) == (0, asked)
    assert read_answers(root) == []


def test_it_says_at_once_what_contradicts_an_answer(server: PosingServer, made: PosingWorld) -> None:
    for frame in (0, 10, 20, 30, 39):
        assert ask(server, "save", **answer_for(made, frame))["said"] == []
    said = ask(server, "save", **answer_for(made, 20, turned=25.0))["said"]
    assert "roll differs by 25° from an earlier answer" in said


def test_a_frame_is_shown_along_the_shaft(server: PosingServer) -> None:
    pixels = np.asarray(image(server, "picture", index=5, small=False).convert("L")).astype(float)
    rod = pixels[:, : pixels.shape[1] // 4]
    # texture in the middle, the even wall above and below
    assert rod[rod.shape[0] // 2 - 20 : rod.shape[0] // 2 + 20].std() > 5 * rod[:20].std()
    assert image(server, "picture", index=5, small=True).width < pixels.shape[1] / 4


def test_a_run_shows_its_scene_as_a_ghost_that_follows_the_sliders(made: PosingWorld, tmp_path: Path) -> None:
    capture = Path(shutil.copytree(made.root, tmp_path / "capture"))
    run = write_run(grasper_scene(NAME, JOINT), tmp_path / "run", capture)

    def ghost(jaw: float) -> np.ndarray:
        return np.asarray(image(started, "ghost", index=5, roll=0.0, joints={JOINT: jaw}))[..., 3] > 0

    with PosingServer(run, port=18320) as started:
        assert ask(started, "overview")["ghost"]
        closed, opened = ghost(0.0), ghost(60.0)
        height, width = closed.shape
        shaft = closed[:, : width // 5]
        assert 0 < shaft.mean() < 0.5
        assert shaft[height // 2 - 3 : height // 2 + 3].mean() > 0.9
        beyond = slice(width // 2, None)
        assert np.flatnonzero(opened[:, beyond].any(1)).size > 1.5 * np.flatnonzero(closed[:, beyond].any(1)).size
        with pytest.raises(urllib.error.HTTPError, match="400") as refused:
            image(started, "ghost", index=5, roll=1.0, joints={})
        assert b"in degrees" in refused.value.read()


ODD_ANSWERS: list[dict[str, Any]] = [
    {"joints": {}},
    {"index": 999},
    {"roll": 1e9},
    {"roll": "up"},
    {"instrument": "rope"},
    {"ask": "undo", "instrument": "rope"},
    {"ask": "frame", "index": -1},
    {"ask": "secrets"},
]


def test_what_cannot_be_is_answered_in_a_line_and_nothing_is_written(server: PosingServer) -> None:
    answer = {"ask": "save", "instrument": NAME, "index": 3, "roll": 10.0, "joints": {JOINT: 3.0}}
    messages = [json.dumps(answer | odd) for odd in ODD_ANSWERS] + ["[]", "no JSON", "[" * 20000]
    *refused, overview = converse(server, *messages, json.dumps({"ask": "overview", "instrument": NAME}))
    assert len(refused) == len(messages)
    assert not [each for each in refused if "\n" in each["error"]]
    assert overview["done"] == 0
    assert read_answers(server.posed.root) == []


def test_a_picture_that_cannot_be_is_refused_in_a_line(server: PosingServer) -> None:
    odd = [{"index": 999, "small": True}, {"index": "1", "small": True}, {"index": 1}, {"instrument": "rope"}, [], 3]
    for fields in odd:
        with pytest.raises(urllib.error.HTTPError, match="400") as refused:
            urllib.request.urlopen(address_of(server, "picture", fields), timeout=20)
        assert b"\n" not in refused.value.read().strip()
        assert refused.value.headers["Content-Type"].startswith("text/plain")  # of a page, scripts in it would run


def test_pictures_come_side_by_side(server: PosingServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each waits until another one is read, too."""
    meet, opened = threading.Barrier(2, timeout=20), posing.open_image
    monkeypatch.setattr(posing, "open_image", lambda path: (meet.wait(), opened(path))[1])
    with ThreadPoolExecutor(6) as pool:
        widths = list(pool.map(lambda k: image(server, "picture", index=k, small=True).width, range(12)))
    assert widths == [PosingServer.thumbnail_width] * 12


def test_without_the_token_nobody_may_ask(server: PosingServer) -> None:
    address = urlsplit(server.address)
    token = address.path.strip("/")
    for path in ("/", "/x/", f"/?token={token}"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(f"http://{address.netloc}{path}", timeout=20)
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://{address.netloc}{path}", additional_headers={"Cookie": f"token={token}"})
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{server.address}etc/passwd", timeout=20)


def test_a_message_beyond_all_bounds_ends_its_own_page_alone(server: PosingServer, caplog, capfd) -> None:
    with connect(server.address.replace("http", "ws")) as socket:
        with contextlib.suppress(ConnectionClosed):
            socket.send("x" * 2**21)
        with pytest.raises(ConnectionClosed):
            socket.recv(timeout=20)
    assert ask(server, "overview")["done"] == 0
    assert "Traceback" not in caplog.text + capfd.readouterr().err


def test_it_listens_on_ipv6_loopback(made: PosingWorld) -> None:
    try:
        Access.at("::1", 18345)
    except NeecoError:
        pytest.skip("no IPv6 here")
    for host in ("::1", "[::1]"):
        with PosingServer(made.root, host, 18345) as server:
            assert server.address.startswith("http://[::1]:18345/")
            assert ask(server, "overview")["done"] == 0


SERVE = """\
import sys, time
from pathlib import Path
from neeco.viewer.posing import PosingServer
with PosingServer(Path(sys.argv[1]), port=18360) as server:
    print(server.address, flush=True)
    time.sleep(120)
"""


def test_answers_to_two_servers_on_one_capture_are_all_kept(made: PosingWorld, tmp_path: Path) -> None:
    """And an answer that one of them took is in the other's overview."""
    root = Path(shutil.copytree(made.root, tmp_path / "capture"))
    command = [sys.executable, "-c", SERVE, str(root)]
    with contextlib.ExitStack() as stack:
        started = [stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True)) for _ in range(2)]
        for process in started:
            stack.callback(process.kill)
        servers = [
            SimpleNamespace(address=str(process.stdout and process.stdout.readline()).strip()) for process in started
        ]
        frames = range(6)
        with ThreadPoolExecutor() as pool:
            saved = pool.map(lambda k: ask(servers[k % 2], "save", **answer_for(made, k)), frames)
            assert all(answer["done"] for answer in saved)
        assert sorted(answer.frame for answer in read_answers(root)) == [made.capture.frames[k].name for k in frames]
        with ThreadPoolExecutor() as pool:
            undone = pool.map(lambda k: ask(servers[k % 2], "undo"), range(4))
            assert all(answer["frame"] is not None for answer in undone)
        assert len(read_answers(root)) == 2
        assert [ask(server, "overview")["done"] for server in servers] == [2, 2]
    assert [path.name for path in root.iterdir() if path.name.startswith(".")] == []


def test_posing_and_export_exclude_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path), "--annotate", "--export", str(tmp_path / "page.html")]) == 1
    assert "give one of the two" in capsys.readouterr().err
