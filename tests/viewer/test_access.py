"""Who is let in, what a browser is told, and that what a run is called stays text."""

from __future__ import annotations

import base64
import hashlib
import socket
from pathlib import Path

import numpy as np
import pytest
from viewer_world import grasper_scene, write_recorded_images, write_run

from neeco.errors import NeecoError
from neeco.viewer.access import AccessControl, content_security_policy, free_port, is_loopback, url_of
from neeco.viewer.panel import message_html, status_html
from neeco.viewer.runs import WatchedRun
from neeco.viewer.views import Picture, RunPicture

TOKEN = "a-token"
OWN, LOCKED = AccessControl(TOKEN, "neeco_80", loopback=True), AccessControl(TOKEN, "neeco_80")
COOKIE = f"neeco_80={TOKEN}"
HOSTILE = '<img src=x onerror="alert(1)">{1+1}[a](javascript:alert(1))'


def asked(guard: AccessControl, path: str = "/", **headers: str) -> str | None:
    return guard.refusal(path, {"host": ["127.0.0.1:80"]} | {name: [value] for name, value in headers.items()})


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "LOCALHOST", "[::1]:80", "127.3.2.1:9"])
def test_loopback_is_let_in_by_its_names(host: str) -> None:
    assert asked(OWN, host=host, cookie=COOKIE) is None
    assert asked(OWN, host=host, cookie=COOKIE, origin=f"http://{host}") is None


@pytest.mark.parametrize(
    "host", ["evil.example:8080", "127.0.0.1.evil.example", "192.168.0.7:80", "localhost.evil", ""]
)
def test_a_name_that_was_made_to_lead_here_is_refused(host: str) -> None:
    assert asked(OWN, host=host, cookie=COOKIE) is not None


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:81", "http://localhost:80", "http://127.0.0.1:80.evil"]
)
@pytest.mark.parametrize("guard", [OWN, LOCKED])
def test_pages_of_other_sites_are_refused(guard: AccessControl, origin: str) -> None:
    assert "another site" in asked(guard, f"/?token={TOKEN}", origin=origin)


def test_two_hosts_or_none_are_refused() -> None:
    assert OWN.refusal("/", {"host": ["127.0.0.1", "evil.example"], "cookie": [COOKIE]}) is not None
    assert OWN.refusal("/", {"cookie": [COOKIE]}) is not None


@pytest.mark.parametrize("guard", [OWN, LOCKED])
def test_what_a_page_of_another_site_fetches_is_refused_and_a_link_with_the_token_is_not(guard: AccessControl) -> None:
    def fetched(path: str, site: str, mode: str = "no-cors") -> str | None:
        return asked(guard, path, cookie=COOKIE, **{"sec-fetch-site": site, "sec-fetch-mode": mode})

    assert fetched("/overview", "same-origin", "cors") is None
    assert fetched("/", "none", "navigate") is None
    for site in ("cross-site", "same-site", "odd"):
        assert "another site" in fetched("/overview", site)
        assert "another site" in fetched(f"/picture?token={TOKEN}", site)
        assert "another site" in fetched("/", site, "navigate")
        assert fetched(f"/?token={TOKEN}", site, "navigate") is None


@pytest.mark.parametrize("guard", [OWN, LOCKED])
@pytest.mark.parametrize(
    ("path", "cookie"), [(f"/?token={TOKEN}", ""), (f"/?a=1&token={TOKEN}", "x=y"), ("/", f"a=b; neeco_80={TOKEN}")]
)
def test_the_token_is_taken_from_the_address_or_the_cookie(guard: AccessControl, path: str, cookie: str) -> None:
    assert asked(guard, path, cookie=cookie) is None
    assert asked(LOCKED, path, host="lab:80", cookie=cookie) is None


@pytest.mark.parametrize(
    ("path", "cookie"),
    [
        ("/", ""),
        ("/?token=", ""),
        ("/?token=wrong", ""),
        ("/", "neeco_81=a-token"),
        ("/a-token", "neeco_80="),
        ("/?token=ä", ""),
    ],
)
def test_without_the_token_nobody_is_let_in_on_loopback_neither(path: str, cookie: str) -> None:
    assert "token" in asked(LOCKED, path, cookie=cookie)
    assert "token" in asked(OWN, path, cookie=cookie)


def test_the_cookie_is_hidden_from_scripts_and_other_sites() -> None:
    headers = LOCKED.page_headers(f"/?token={TOKEN}", b"", "lab:80")
    assert headers["Set-Cookie"] == f"neeco_80={TOKEN}; HttpOnly; SameSite=Strict; Path=/"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "Set-Cookie" not in LOCKED.page_headers("/", b"", "lab:80")


def test_the_policy_lets_the_pages_own_script_run_and_connects_nowhere_else() -> None:
    told = content_security_policy(b'<html><script data-p="x">let a = 1;</script>', "lab:80")
    digest = base64.b64encode(hashlib.sha256(b"let a = 1;").digest()).decode()
    directives = dict(part.split(" ", 1) for part in told.split("; "))
    assert f"'sha256-{digest}'" in directives["script-src"]
    assert "unsafe" not in directives["script-src"].replace("'wasm-unsafe-eval'", "")
    assert directives["connect-src"] == "'self' ws://lab:80 data: blob:"
    assert directives["default-src"] == "'none'"
    assert "connect-src 'self' data: blob:" in content_security_policy(b"", "[::1]:80")


@pytest.mark.parametrize(
    ("host", "own"),
    [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("lab", False), ("10.0.0.1", False)],
)
def test_every_address_has_a_token_and_loopback_is_known(host: str, own: bool) -> None:
    assert is_loopback(host) is own
    assert AccessControl.at(host, 80).loopback is own
    assert len(AccessControl.at(host, 80).token) >= 32
    assert AccessControl.at(host, 80).token != AccessControl.at(host, 80).token


def test_the_printed_address_carries_the_token() -> None:
    assert url_of("127.0.0.1", 8080, "t") == "http://127.0.0.1:8080/?token=t"
    assert url_of("::1", 8080, "t") == "http://[::1]:8080/?token=t"
    assert url_of("lab", 8080, "t") == "http://lab:8080/?token=t"
    assert url_of("0.0.0.0", 8080, "t") == f"http://{socket.gethostname()}:8080/?token=t"


def test_a_port_that_is_taken_gives_the_next() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < free_port("127.0.0.1", port) < port + 100


@pytest.mark.parametrize(
    ("host", "port", "named"),
    [
        ("127.0.0.1", 0, "--port"),
        ("127.0.0.1", 65536, "--port"),
        ("no.such.host.invalid", 80, "--host"),
        ("203.0.113.1", 8080, "--host"),
    ],
)
def test_a_host_or_port_that_cannot_be_is_named(host: str, port: int, named: str) -> None:
    with pytest.raises(NeecoError, match=named):
        free_port(host, port)


def test_names_of_a_run_stay_text(tmp_path: Path) -> None:
    scene = grasper_scene(frame_name="<b>{:06d}")
    run = write_run(scene, tmp_path / "<script>run", write_recorded_images(scene, tmp_path / "capture"))
    picture = Picture(np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6)))
    part = RunPicture(loaded=WatchedRun(run).loaded, picture=picture, frame=2.0, exact=True, trouble=HOSTILE)
    html = status_html(part, 0.1, HOSTILE)
    assert "<script" not in html
    assert "<img" not in html
    assert "<b>0" not in html
    assert "&lt;script&gt;run" in html
    assert "<img" not in message_html(HOSTILE)


def test_endless_names_are_cut() -> None:
    assert len(message_html("x" * 10**6)) < 1000
