"""`neeco view CAPTURE --annotate` over HTTP: what the page is given, what it may save, and who may ask."""

from __future__ import annotations

import http.client
import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from PIL import Image
from posing_world import JOINT, NAME, PosingWorld, measured_world
from viewer_world import grasper_scene, write_run

from neeco.capture.readers import read_capture
from neeco.cli import main
from neeco.ingest.posing.hand_posed import read_answers
from neeco.viewer.posing_server import PosingServer

JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> PosingWorld:
    return measured_world(tmp_path_factory.mktemp("posing") / "capture")


@pytest.fixture
def server(made: PosingWorld, tmp_path: Path) -> Iterator[PosingServer]:
    with PosingServer(Path(shutil.copytree(made.root, tmp_path / "capture")), port=18300) as started:
        yield started


def ask(
    server: PosingServer, path: str, body: Any = None, headers: dict[str, str] | None = None
) -> tuple[int, dict[str, str], bytes]:
    host, port = server.address.split("/")[2].split(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=30)
    method = "GET" if body is None else "POST"
    sent = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
    connection.request(method, path, sent, (JSON if body is not None else {}) if headers is None else headers)
    answer = connection.getresponse()
    return answer.status, dict(answer.getheaders()), answer.read()


def answer_for(made: PosingWorld, frame: int, turned: float = 0.0) -> dict[str, Any]:
    roll, jaw = (float(np.degrees(values[frame])) for values in (made.rolls, made.jaws))
    return {"instrument": NAME, "frame": frame, "roll": roll + turned, "joints": {JOINT: jaw}}


def test_the_page_is_whole_and_may_load_nothing_from_elsewhere(server: PosingServer) -> None:
    status, headers, page = ask(server, "/")
    assert status == 200
    assert b"{{" not in page
    assert "default-src 'none'" in headers["Content-Security-Policy"]


def test_an_answer_is_kept_and_changes_the_states(server: PosingServer, made: PosingWorld) -> None:
    root = server.session.posed.root
    before = json.loads(ask(server, "/overview")[2])
    assert (before["done"], before["of"], before["sure"]["roll"]) == (0, 10, [180.0, 180.0])
    asked = before["suggested"][0]["frame"]
    status, _, body = ask(server, "/save", answer_for(made, asked))
    after = json.loads(body)
    assert (status, after["done"], after["said"]) == (200, 1, [])
    assert asked not in [item["frame"] for item in after["suggested"]]
    assert after["sure"]["roll"][0] < 90
    kept = read_answers(root)
    assert [answer.frame for answer in kept] == [made.capture.frames[asked].name]
    assert kept[0].when is not None
    jaw = read_capture(root).frames[asked].state.instruments[NAME].joints[JOINT]
    assert jaw == pytest.approx(made.jaws[asked], abs=0.1)
    undone = json.loads(ask(server, "/undo", {"instrument": NAME})[2])
    assert (undone["done"], undone["frame"]) == (0, asked)
    assert read_answers(root) == []


def test_it_says_at_once_what_contradicts_an_answer(server: PosingServer, made: PosingWorld) -> None:
    for frame in (0, 10, 20, 30, 39):
        assert json.loads(ask(server, "/save", answer_for(made, frame))[2])["said"] == []
    said = json.loads(ask(server, "/save", answer_for(made, 20, turned=25.0))[2])["said"]
    assert "roll differs by 25° from an earlier answer" in said


def test_a_frame_is_shown_along_the_shaft(server: PosingServer) -> None:
    status, headers, body = ask(server, f"/picture?instrument={NAME}&index=5")
    assert (status, headers["Content-Type"]) == (200, "image/jpeg")
    pixels = np.asarray(Image.open(io.BytesIO(body)).convert("L")).astype(float)
    rod = pixels[:, : pixels.shape[1] // 4]
    # texture in the middle, the even wall above and below
    assert rod[rod.shape[0] // 2 - 20 : rod.shape[0] // 2 + 20].std() > 5 * rod[:20].std()
    small = Image.open(io.BytesIO(ask(server, f"/picture?instrument={NAME}&index=5&small=1")[2]))
    assert small.width < pixels.shape[1] / 4


def test_a_run_shows_its_scene_as_a_ghost_that_follows_the_sliders(made: PosingWorld, tmp_path: Path) -> None:
    capture = Path(shutil.copytree(made.root, tmp_path / "capture"))
    run = write_run(grasper_scene(NAME, JOINT), tmp_path / "run", capture)

    def ghost(jaw: float) -> np.ndarray:
        state = quote(json.dumps({"roll": 0.0, "joints": {JOINT: jaw}}))
        status, headers, body = ask(started, f"/ghost?instrument={NAME}&index=5&state={state}")
        assert (status, headers["Content-Type"]) == (200, "image/png")
        return np.asarray(Image.open(io.BytesIO(body)))[..., 3] > 0

    with PosingServer(run, port=18320) as started:
        assert json.loads(ask(started, "/overview")[2])["ghost"]
        closed, opened = ghost(0.0), ghost(60.0)
        height, width = closed.shape
        shaft = closed[:, : width // 5]
        assert 0 < shaft.mean() < 0.5
        assert shaft[height // 2 - 3 : height // 2 + 3].mean() > 0.9
        beyond = slice(width // 2, None)
        assert np.flatnonzero(opened[:, beyond].any(1)).size > 1.5 * np.flatnonzero(closed[:, beyond].any(1)).size
        assert ask(started, f"/ghost?instrument={NAME}&index=5&state=1")[0] == 404
        assert (
            ask(started, f"/ghost?instrument={NAME}&index=5&state={quote(json.dumps({'roll': 1, 'joints': {}}))}")[0]
            == 404
        )


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/save", {"instrument": NAME, "frame": 3, "roll": 10.0, "joints": {}}),
        ("/save", {"instrument": NAME, "frame": 999, "roll": 10.0, "joints": {JOINT: 3.0}}),
        ("/save", {"instrument": NAME, "frame": 3, "roll": 1e9, "joints": {JOINT: 3.0}}),
        ("/save", {"instrument": NAME, "frame": 3, "roll": "up", "joints": {JOINT: 3.0}}),
        ("/save", {"instrument": "rope", "frame": 3, "roll": 1.0, "joints": {JOINT: 3.0}}),
        ("/save", b"[" * 20000),
        ("/undo", {"instrument": "rope"}),
        ("/undo", []),
        ("/overview?instrument=rope", None),
        (f"/frame?instrument={NAME}&index=-1", None),
        (f"/frame?instrument={NAME}&index=nine", None),
    ],
)
def test_what_cannot_be_is_answered_in_a_line_and_nothing_is_written(
    server: PosingServer, path: str, body: Any
) -> None:
    status, _, said = ask(server, path, body)
    if path == "/undo" and isinstance(body, dict):  # nothing to take back
        assert status == 400
    assert status == 400
    assert "\n" not in json.loads(said)["error"]
    assert read_answers(server.session.posed.root) == []
    assert ask(server, "/overview")[0] == 200


def test_others_may_not_ask(server: PosingServer, made: PosingWorld) -> None:
    answer = answer_for(made, 3)
    assert ask(server, "/", headers={"Host": "evil.example"})[0] == 403
    assert ask(server, "/save", answer, JSON | {"Origin": "http://evil.example"})[0] == 403
    assert ask(server, "/save", answer, {"Content-Type": "text/plain"})[0] == 403
    assert ask(server, "/save", b"x" * 100_000)[0] == 400
    assert ask(server, "/etc/passwd")[0] == 404
    assert read_answers(server.session.posed.root) == []


def test_one_capture_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path), str(tmp_path), "--annotate"]) == 1
    assert "give one capture" in capsys.readouterr().err
    assert main(["view", str(tmp_path), "--annotate", "--export", str(tmp_path / "page.html")]) == 1
    assert "give one of the two" in capsys.readouterr().err
