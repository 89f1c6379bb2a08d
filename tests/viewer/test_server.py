"""The server as programs meet it; what browsers do with it is in test_browser.py."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import pytest

from neeco.base.errors import NeecoError, install_hint
from neeco.cli import main
from neeco.viewer.server import VIEWER, AdaptiveResolution, RenderThread, ViewerServer

viser = pytest.importorskip("viser")
from viser import _messages as messages  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

Serve = Callable[..., ViewerServer]
PROTOCOL = f"viser-v{viser.__version__}"


def status(url: str, **headers: str) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=20) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as refused:
        return refused.code


def socket_status(viewer: ViewerServer, path: str, **headers: str) -> int:
    """101: the web socket was opened."""
    address = f"ws://127.0.0.1:{port_of(viewer)}{path}"
    try:
        with connect(address, subprotocols=[PROTOCOL], additional_headers=headers):
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


def port_of(viewer: ViewerServer) -> int:
    return int(urlsplit(viewer.address).port or 0)


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_page_and_socket_open_with_the_token_in_the_address_alone(made_run: Path, serve: Serve, host: str) -> None:
    viewer = serve(made_run, host=host)
    path = urlsplit(viewer.address).path
    root = f"http://127.0.0.1:{port_of(viewer)}"
    pages = [path, "/", "/x/", f"/?token={path.strip('/')}"]
    assert [status(root + page) for page in pages] == [200, 403, 403, 403]
    assert [socket_status(viewer, page) for page in pages] == [101, 403, 403, 403]
    other_site = {"Origin": "http://evil.example", "Cookie": f"token={path.strip('/')}"}
    assert socket_status(viewer, "/", **other_site) == 403


def test_it_listens_on_loopback_only(made_run: Path, serve: Serve) -> None:
    port = port_of(serve(made_run))
    with socket.socket() as other:  # the same port of every address is still free but for loopback's
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.2", port))


def test_a_browser_that_asks_for_a_tunnel_gets_none(made_run, serve, monkeypatch):
    asked: list[object] = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *given: asked.append(given))
    viewer = serve(made_run)
    wish = messages.ShareUrlRequest()
    with connect(viewer.address.replace("http", "ws"), subprotocols=[PROTOCOL]) as wishing:
        wishing.send(_packed(wish))
        time.sleep(0.5)
    assert asked == []


def _packed(message: object) -> bytes:
    import msgspec

    return msgspec.msgpack.encode({"type": type(message).__name__})


def test_a_server_that_the_guard_does_not_see_is_not_left_running(made_run, monkeypatch):
    stopped: list[object] = []

    class Other:
        def __init__(self, **_: object) -> None: ...

        def stop(self) -> None:
            stopped.append(self)

    monkeypatch.setattr("viser.ViserServer", Other)
    with pytest.raises(NeecoError, match="too old or too new"):
        ViewerServer(made_run)
    assert len(stopped) == 1


def test_without_viser_it_says_what_to_install(made_run: Path, uninstalled, capsys) -> None:
    uninstalled("viser")
    assert main(["view", str(made_run), "--no-browser"]) == 1
    assert capsys.readouterr().err == f"neeco: error: view: needs viser 1.1; {install_hint('view')}\n"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere"], "nowhere: neither a run folder nor a capture"),
        (["RUN", "--port", "70000"], "--port must be 1 to 65535 (got 70000)"),
        (["RUN", "--export", "x.html", "--sh", "4"], "--sh must be 0 to 3 (got 4)"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(arguments: list[str], told: str, made_run: Path, capsys) -> None:
    given = [str(made_run) if word == "RUN" else word for word in arguments]
    assert main(["view", *given, *([] if "--export" in given else ["--no-browser"])]) == 1
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1


def view(run: Path, seen: Callable[[str], object], *words: str, **environment: str) -> str:
    """What `neeco view` says as a warning before and after its address is `seen`, when it is asked to end."""
    program = "import sys; from neeco.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "view", str(run), "--device", "cpu", *words]
    variables, pipes = os.environ | environment, {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, env=variables, text=True, **pipes) as process:  # type: ignore[call-overload]
        seen(process.stdout.readline().split()[0])
        process.terminate()
        rest, errors = process.communicate(timeout=30)
    assert (process.returncode, rest.strip()) == (0, "")
    return str(errors)


def test_it_prints_its_address_and_ends_quietly_on_interrupt(made_run: Path) -> None:
    def seen(address: str) -> None:
        assert address.startswith("http://127.0.0.1:")
        assert status(address) == 200

    assert view(made_run, seen, "--no-browser") == ""


def test_a_browser_gets_no_token_in_its_arguments_and_plain_http_is_warned_of(made_run: Path, tmp_path: Path) -> None:
    """By way of a file that nobody else can read and that goes again."""
    browser, folder = tmp_path / "browser", tmp_path / "folder"
    browser.write_text(f'#!/bin/sh\ncp -pr "$(dirname "${{1#file://}}")" {folder}\nprintf %s "$1" > {tmp_path}/asked\n')
    browser.chmod(0o755)

    def seen(address: str) -> None:
        deadline = time.monotonic() + 30
        while not (tmp_path / "asked").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        token = urlsplit(address).path.strip("/")
        assert token in (folder / "view.html").read_text()
        assert token not in (tmp_path / "asked").read_text()

    assert "plain HTTP" in view(made_run, seen, "--host", "0.0.0.0", BROWSER=f"{browser} %s")
    assert folder.stat().st_mode & 0o077 == 0
    assert not Path(url2pathname(urlsplit((tmp_path / "asked").read_text()).path)).parent.exists()


class Browser:
    """A session that only notes what it is asked."""

    def __init__(self, key: int, seconds: float = 0.0) -> None:
        self.key, self.seconds, self.drawn = key, seconds, []

    def render(self, sharp: bool) -> None:
        self.drawn.append(sharp)
        time.sleep(self.seconds)

    def tick(self, now: float) -> float | None:
        return None


@pytest.fixture
def thread():
    thread = RenderThread()
    thread.start()
    yield thread
    thread.stop()


def test_what_moves_is_drawn_coarsely_and_once_still_sharp(thread: RenderThread) -> None:
    browser = Browser(1)
    thread.add(browser)
    time.sleep(0.6)
    assert browser.drawn == [False, True]


def test_wishes_made_while_one_is_drawn_become_one(thread: RenderThread) -> None:
    browser = Browser(1, seconds=0.2)
    thread.add(browser)
    for _ in range(20):
        thread.request(1)
        time.sleep(0.01)
    time.sleep(1.0)
    assert browser.drawn in ([False, False, True], [False, False, False, True])


def test_browsers_take_turns(thread: RenderThread) -> None:
    busy, other = Browser(1, seconds=0.02), Browser(2, seconds=0.02)
    thread.add(busy)
    thread.add(other)
    for _ in range(40):
        thread.request(1)
        thread.request(2)
        time.sleep(0.01)
    assert abs(len(busy.drawn) - len(other.drawn)) <= 2
    assert len(busy.drawn) > 4


def test_one_browsers_trouble_does_not_end_the_others_pictures(thread: RenderThread) -> None:
    class Broken(Browser):
        def render(self, sharp: bool) -> None:
            raise RuntimeError("no picture")

    healthy = Browser(2)
    thread.add(Broken(1))
    thread.add(healthy)
    time.sleep(0.6)
    assert healthy.drawn == [False, True]


def test_who_has_gone_is_not_drawn_for(thread: RenderThread) -> None:
    browser = Browser(1)
    thread.add(browser)
    thread.remove(1)
    time.sleep(0.4)
    thread.request(1)
    time.sleep(0.4)
    assert len(browser.drawn) <= 1


def test_a_slow_scene_is_drawn_smaller_and_a_fast_one_as_large_as_the_window() -> None:
    fast, slow = AdaptiveResolution(), AdaptiveResolution()
    for _ in range(3):
        fast.record(1e-3, 256 * 400)
        slow.record(5.0, 256 * 400)
    assert fast.height(False, 900, 1.6) == VIEWER.moving_px
    assert fast.height(True, 900, 1.6) == VIEWER.sharp_px
    assert fast.height(True, 300, 1.6) == 300
    assert slow.height(False, 900, 1.6) < slow.height(True, 900, 1.6) < 100
    fast.record(60.0, 256 * 400)  # had to find something out first
    assert fast.height(False, 900, 1.6) == VIEWER.moving_px


def test_a_size_asked_for_is_rendered_whatever_it_takes() -> None:
    asked = AdaptiveResolution(sharp_px=1280)
    for _ in range(3):
        asked.record(5.0, 256 * 400)
    assert asked.height(True, 2000, 1.6) == 1280
    assert asked.height(True, 900, 1.6) == 900  # all that the window shows
    assert asked.height(False, 2000, 1.6) < 100


def test_a_taken_port_gives_the_next_one(made_run: Path, serve: Serve) -> None:
    first = port_of(serve(made_run))
    assert port_of(serve(made_run, port=first)) > first
