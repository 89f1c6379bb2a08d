"""`neeco view CAPTURE --annotate` over HTTP: what the page is given, what it may save, and who may ask."""

from __future__ import annotations

import contextlib
import http.client
import io
import json
import shutil
import socket
import subprocess
import sys
import time
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

from neeco.capture.readers import read_capture
from neeco.cli import main
from neeco.errors import NeecoError
from neeco.ingest.posing.hand_posed import read_answers
from neeco.viewer import posing_server
from neeco.viewer.access import free_port
from neeco.viewer.posing_server import PosingServer

JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> PosingWorld:
    return measured_world(tmp_path_factory.mktemp("posing") / "capture")


@pytest.fixture
def server(made: PosingWorld, tmp_path: Path) -> Iterator[PosingServer]:
    with PosingServer(Path(shutil.copytree(made.root, tmp_path / "capture")), port=18300) as started:
        yield started


def place_of(server: PosingServer) -> tuple[str, int]:
    address = urlsplit(server.address)
    return str(address.hostname), int(address.port or 0)


def cookie_of(server: PosingServer) -> str:
    return f"neeco_{place_of(server)[1]}={urlsplit(server.address).query.removeprefix('token=')}"


def ask(
    server: PosingServer, path: str, body: Any = None, headers: dict[str, str] | None = None
) -> tuple[int, dict[str, str], bytes]:
    host, port = place_of(server)
    connection = http.client.HTTPConnection(host, port, timeout=30)
    method = "GET" if body is None else "POST"
    sent = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
    given = (JSON if body is not None else {}) if headers is None else headers
    connection.request(method, path, sent, {"Cookie": cookie_of(server)} | given)
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
    assert ask(server, "/", headers={"Cookie": ""})[0] == 403
    assert ask(server, "/save", answer, JSON | {"Cookie": ""})[0] == 403
    assert ask(server, "/save", answer, JSON | {"Sec-Fetch-Site": "cross-site"})[0] == 403
    assert ask(server, "/?" + urlsplit(server.address).query, headers={"Cookie": ""})[0] == 200
    assert ask(server, "/save", answer, JSON | {"Origin": "http://evil.example"})[0] == 403
    assert ask(server, "/save", answer, {"Content-Type": "text/plain"})[0] == 403
    assert ask(server, "/save", b"x" * 100_000)[0] == 400
    assert ask(server, "/etc/passwd")[0] == 404
    assert read_answers(server.session.posed.root) == []


def raw(server: PosingServer, *lines: str, body: bytes = b"") -> tuple[bytes, float]:
    """All that a raw request gets, and after how many seconds the connection ended."""
    began = time.monotonic()
    with socket.create_connection(place_of(server), timeout=20) as connection:
        connection.sendall("".join(f"{line}\r\n" for line in [*lines, ""]).encode() + body)
        heard = b""
        while more := connection.recv(65536):
            heard += more
    return heard, time.monotonic() - began


def test_a_body_is_read_only_from_those_who_may_ask(server: PosingServer) -> None:
    host = f"Host: 127.0.0.1:{place_of(server)[1]}"
    with socket.create_connection(place_of(server), timeout=5) as stranger:
        # the body never comes
        stranger.sendall(f"POST /save HTTP/1.1\r\n{host}\r\nContent-Length: 100\r\n\r\n".encode())
        assert stranger.recv(4096).startswith(b"HTTP/1.1 403 ")


@pytest.mark.parametrize("header", ["Content-Length: 3", "Content-Length: x", "Transfer-Encoding: chunked"])
def test_a_get_with_a_body_is_refused_and_its_body_is_no_request(server: PosingServer, header: str) -> None:
    host = f"Host: 127.0.0.1:{place_of(server)[1]}"
    heard, _ = raw(
        server, "GET / HTTP/1.1", host, f"Cookie: {cookie_of(server)}", header, body=b"GET / HTTP/1.1\r\n\r\n"
    )
    assert heard.startswith(b"HTTP/1.1 400 ")
    assert heard.count(b"HTTP/1.1 ") == 1


def test_requests_are_bounded_in_time_and_size(server: PosingServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(posing_server, "WAIT_S", 0.5)
    with socket.create_connection(place_of(server), timeout=10) as slow:
        began = time.monotonic()
        with contextlib.suppress(OSError):
            for _ in range(50):  # a byte now and then keeps no connection open
                slow.sendall(b"G")
                time.sleep(0.1)
        assert time.monotonic() - began < 4
    with contextlib.suppress(ConnectionError):
        heard, _ = raw(server, "GET / HTTP/1.1", *(f"X-{number}: {'x' * 60_000}" for number in range(4)))
        assert b" 200 " not in heard
    assert ask(server, "/overview")[0] == 200


def test_connections_are_bounded(made: PosingWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(posing_server, "MAX_CONNECTIONS", 3)
    with PosingServer(made.root, port=18340) as server:
        held = [socket.create_connection(place_of(server), timeout=5) for _ in range(3)]
        time.sleep(0.2)
        with socket.create_connection(place_of(server), timeout=5) as further:
            assert further.recv(1) == b""
        for connection in held:
            connection.close()
        time.sleep(0.2)
        assert ask(server, "/overview")[0] == 200


def test_a_browser_that_goes_away_is_a_line_in_the_log(server: PosingServer, caplog, capfd, monkeypatch) -> None:
    def gone() -> None:
        raise BrokenPipeError

    monkeypatch.setattr(server.session, "overview", lambda _: gone())
    host = f"Host: 127.0.0.1:{place_of(server)[1]}"
    raw(server, "GET /overview HTTP/1.1", host, f"Cookie: {cookie_of(server)}")
    assert "a browser went away (BrokenPipeError)" in caplog.text
    assert "Traceback" not in caplog.text + capfd.readouterr().err


def test_it_listens_on_ipv6_loopback(made: PosingWorld) -> None:
    try:
        free_port("::1", 18345)
    except NeecoError:
        pytest.skip("no IPv6 here")
    for host in ("::1", "[::1]"):
        with PosingServer(made.root, host, 18345) as server:
            assert server.address.startswith("http://[::1]:18345/?token=")
            assert ask(server, "/overview")[0] == 200


SERVE = """\
import sys, time
from pathlib import Path
from neeco.viewer.posing_server import PosingServer
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
            saved = pool.map(lambda k: ask(servers[k % 2], "/save", answer_for(made, k))[0], frames)
            assert list(saved) == [200] * 6
        assert sorted(answer.frame for answer in read_answers(root)) == [made.capture.frames[k].name for k in frames]
        with ThreadPoolExecutor() as pool:
            undone = pool.map(lambda k: ask(servers[k % 2], "/undo", {"instrument": NAME})[0], range(4))
            assert list(undone) == [200] * 4
        assert len(read_answers(root)) == 2
        assert [json.loads(ask(server, "/overview")[2])["done"] for server in servers] == [2, 2]
    assert [path.name for path in root.iterdir() if path.name.startswith(".")] == []


def test_posing_and_export_exclude_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path), "--annotate", "--export", str(tmp_path / "page.html")]) == 1
    assert "give one of the two" in capsys.readouterr().err
