"""Who is let in, what a browser is told, and that what a run is called stays text."""

from __future__ import annotations

import base64
import hashlib
import socket
from pathlib import Path

import numpy as np
import pytest
from viewer_world import grasper_scene, write_recorded_images, write_run

from neeco.base.errors import NeecoError
from neeco.viewer.access import Access, is_loopback
from neeco.viewer.panel import message_html, status_html
from neeco.viewer.runs import ViewedRun
from neeco.viewer.views import Controls, Picture

pytest.importorskip("viser")
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

ACCESS = Access("127.0.0.1", 80, "a-token")
HOSTILE = '<img src=x onerror="alert(1)">{1+1}[a](javascript:alert(1))'
PAGE = b'<html><script data-p="x">let a = 1;</script>'


class Connection:
    @staticmethod
    def respond(status: int, text: str) -> Response:
        return Response(int(status), text, Headers(), text.encode())


def asked(path: str, **headers: str) -> Response:
    """What a page whose text is its path answers."""
    request = Request(path, Headers({"Host": "127.0.0.1:80"} | headers))
    return ACCESS.controlled(lambda _, seen: Response(200, "OK", Headers(), PAGE + seen.path.encode()))(
        Connection, request
    )


@pytest.mark.parametrize(
    ("path", "seen"), [("/a-token", "/"), ("/a-token/", "/"), ("/a-token/a/b?token=x", "/a/b"), ("/a-token?x=1", "/")]
)
def test_the_token_in_the_path_opens_the_page_which_does_not_see_it(path: str, seen: str) -> None:
    answer = asked(path)
    assert (answer.status_code, answer.body) == (200, PAGE + seen.encode())


@pytest.mark.parametrize(
    "path", ["/", "", "/?token=a-token", "//a-token", "/x/a-token", "/a-tokens/", "/A-token", "/\udcff", "/%61-token/"]
)
@pytest.mark.parametrize(
    "headers",
    [{}, {"Cookie": "token=a-token", "Origin": "http://127.0.0.1:80", "Referer": "http://127.0.0.1/a-token/"}],
)
def test_without_the_token_in_the_path_nobody_is_let_in(path: str, headers: dict[str, str]) -> None:
    answer = asked(path, **headers)
    assert answer.status_code == 403
    assert b"open the whole address" in answer.body


def test_the_policy_lets_the_pages_own_script_run_and_connects_nowhere_else() -> None:
    headers = asked("/a-token/").headers
    digest = base64.b64encode(hashlib.sha256(b"let a = 1;").digest()).decode()
    directives = dict(part.split(" ", 1) for part in headers["Content-Security-Policy"].split("; "))
    assert f"'sha256-{digest}'" in directives["script-src"]
    assert "unsafe" not in directives["script-src"].replace("'wasm-unsafe-eval'", "")
    assert directives["connect-src"] == "'self' ws://127.0.0.1:80 data: blob:"
    assert directives["default-src"] == "'none'"
    assert headers["Referrer-Policy"] == "no-referrer"


def test_every_server_has_a_token_of_its_own() -> None:
    first, second = (Access.at("127.0.0.1", 18700) for _ in range(2))
    assert len(first.token) >= 32
    assert first.token != second.token


@pytest.mark.parametrize(
    ("host", "own"),
    [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("lab", False), ("10.0.0.1", False)],
)
def test_loopback_is_known(host: str, own: bool) -> None:
    assert is_loopback(host) is own


def test_the_printed_address_carries_the_token() -> None:
    assert Access("127.0.0.1", 8080, "t").address == "http://127.0.0.1:8080/t/"
    assert Access("::1", 8080, "t").address == "http://[::1]:8080/t/"
    assert Access("0.0.0.0", 8080, "t").address == f"http://{socket.gethostname()}:8080/t/"


def test_a_port_that_is_taken_gives_the_next() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < Access.at("127.0.0.1", port).port < port + 100


@pytest.mark.parametrize(
    ("host", "port", "named"),
    [
        ("127.0.0.1", 0, "--port"),
        ("127.0.0.1", 65536, "--port"),
        ("no such host", 80, "--host"),  # which no name server is asked for
        ("203.0.113.1", 8080, "--host"),
    ],
)
def test_a_host_or_port_that_cannot_be_is_named(host: str, port: int, named: str) -> None:
    with pytest.raises(NeecoError, match=named):
        Access.at(host, port)


def test_names_of_a_run_stay_text(tmp_path: Path) -> None:
    scene = grasper_scene(frame_name="<b>{:06d}")
    run = write_run(scene, tmp_path / "<script>run", write_recorded_images(scene, tmp_path / "capture"))
    picture = Picture(np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6)))
    html = status_html(ViewedRun(run).loaded, Controls(2.0), picture, 0.1, [HOSTILE, HOSTILE])
    assert "<script" not in html
    assert "<img" not in html
    assert "<b>0" not in html
    assert "&lt;script&gt;run" in html
    assert "<img" not in message_html(HOSTILE)
    assert len(message_html("x" * 10**6)) < 1000
