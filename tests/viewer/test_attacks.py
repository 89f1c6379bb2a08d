"""What a page, a program or a scene file may send to the server, and that it goes on serving the others."""

from __future__ import annotations

import json
import logging
import shutil
import socket
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from neeco.base.errors import NeecoError
from neeco.viewer.access import MAX_MESSAGE
from neeco.viewer.server import RenderThread, ViewerServer

viser = pytest.importorskip("viser")
import msgspec  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import ClientConnection, connect  # noqa: E402

Serve = Callable[..., ViewerServer]
PROTOCOL = f"viser-v{viser.__version__}"
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, 0.0, 0.0],
    "fov": 0.8,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 48,
    "image_width": 64,
    "look_at": [0.0, 0.0, 1.0],
    "up_direction": [0.0, -1.0, 0.0],
}


@pytest.fixture(scope="module")
def shared(made_run: Path) -> Iterator[ViewerServer]:
    """One server for all tests that leave it as it is."""
    viewer = ViewerServer(made_run)
    yield viewer
    viewer.stop()


def port_of(viewer: ViewerServer) -> int:
    return int(urlsplit(viewer.address).port or 0)


def answer(port: int, *lines: bytes, wait: float = 20.0) -> bytes:
    """The status line of what a raw request gets; empty: the connection was ended."""
    with socket.create_connection(("127.0.0.1", port), timeout=wait) as raw:
        raw.sendall(b"\r\n".join([*lines, b"", b""]))
        return raw.recv(4096).partition(b"\r\n")[0]


def opened(viewer: ViewerServer) -> ClientConnection:
    return connect(viewer.address.replace("http", "ws"), subprotocols=[PROTOCOL], max_size=None)


def looks(connection: ClientConnection, **changed: Any) -> None:
    """Say where the browser's camera stands."""
    connection.send(msgspec.msgpack.encode(CAMERA | changed))


def exhaust(connection: ClientConnection) -> None:
    """Hear all that the server says. Raises ConnectionClosed when it ends that, TimeoutError when it falls silent."""
    while True:
        connection.recv(timeout=20)


def client_of(viewer: ViewerServer, known: Collection[Any] = ()) -> Any:
    """The newest browser, once it has its panel; known: the sessions of those before."""
    until = time.monotonic() + 20
    while time.monotonic() < until:
        if set(viewer.render_thread.sessions) - set(known):
            clients = viewer._server.get_clients()
            return clients[max(clients)]
        time.sleep(0.02)
    raise AssertionError("no browser has come")


def is_served(viewer: ViewerServer) -> bool:
    """Does a new browser get a page, and a picture?"""
    port = port_of(viewer)
    page = f"GET {urlsplit(viewer.address).path} HTTP/1.1".encode()
    assert answer(port, page, f"Host: 127.0.0.1:{port}".encode()) == b"HTTP/1.1 200 OK"
    with opened(viewer) as connection:
        before = set(viewer.render_thread.sessions)
        looks(connection)
        until = time.monotonic() + 20
        while time.monotonic() < until:
            if any(session.status_at > 0 for session in viewer.render_thread.sessions if session not in before):
                return True
            time.sleep(0.02)
    return False


@pytest.mark.parametrize(
    "path",
    [
        b"/../../../../../../etc/passwd",
        b"/..%2f..%2f..%2f..%2f..%2fetc/passwd",
        b"//etc/passwd",
        b"//[",
        b"/%00",
        b"/" + b"a" * 3000,
        b"/assets",
    ],
)
def test_only_the_pages_own_files_are_served(shared: ViewerServer, path: bytes, caplog) -> None:
    port = port_of(shared)
    token = urlsplit(shared.address).path.rstrip("/").encode()
    status = answer(port, b"GET " + token + path + b" HTTP/1.1", f"Host: 127.0.0.1:{port}".encode())
    assert status.split(b" ")[1] in (b"400", b"404")
    assert not [record for record in caplog.records if record.exc_info]


def test_a_request_with_a_body_or_without_an_end_is_a_line_in_the_log_and_no_trouble(shared, caplog, capfd):
    port = port_of(shared)
    host = f"Host: 127.0.0.1:{port}".encode()
    assert b"200" not in answer(port, b"GET / HTTP/1.1", host, b"Content-Length: 5")
    assert b"200" not in answer(port, b"GET / HTTP/1.1", host, b"Transfer-Encoding: chunked")
    for sent in (b"", b"GET / HT"):
        with socket.create_connection(("127.0.0.1", port)) as raw:
            raw.sendall(sent)
    assert is_served(shared)
    assert not [record for record in caplog.records if record.exc_info and record.levelno >= logging.WARNING]
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize(
    "message",
    [
        "text",
        b"\x91" * 100_000,  # lists in lists
        msgspec.msgpack.encode({"no": "type"}),
        msgspec.msgpack.encode({"type": "NoSuchMessage"}),
        msgspec.msgpack.encode({"type": "ViewerCameraMessage", "wxyz": 1}),
        b"\x00" * (MAX_MESSAGE + 1),
    ],
)
def test_what_is_not_understood_ends_that_connection_alone(shared, message, caplog, capfd):
    with opened(shared) as other:
        looks(other)
        with opened(shared) as connection:
            looks(connection)
            connection.send(message)
            with pytest.raises(ConnectionClosed):
                exhaust(connection)
        other.ping().wait(20)
    assert is_served(shared)
    assert not [record for record in caplog.records if record.exc_info and record.levelno >= logging.WARNING]
    assert "Traceback" not in capfd.readouterr().err


def press(connection: ClientConnection, client: Any, label: str, value: Any = 1) -> None:
    """Say that the user set the control of that name."""
    handles = {handle._impl.props.label: handle for handle in client.gui._gui_input_handle_from_uuid.values()}
    update = {"type": "GuiUpdateMessage", "uuid": handles[label]._impl.uuid, "updates": {"value": value}}
    connection.send(msgspec.msgpack.encode(update))


def wait_until(true: Callable[[], bool]) -> None:
    until = time.monotonic() + 20
    while not true():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_the_buttons_of_a_page_save_states_and_images(made_run: Path, serve: Serve, tmp_path: Path, caplog) -> None:
    run = tmp_path / "run"
    shutil.copytree(made_run, run)
    viewer = serve(run)
    with opened(viewer) as connection:
        looks(connection)
        client = client_of(viewer)
        (session,) = viewer.render_thread.sessions
        press(connection, client, "along shaft (mm)", 5.0)
        press(connection, client, "drag it in the scene", True)
        wait_until(lambda: session.overlays.gizmo_pose("grasper") is not None)
        for _ in range(2):
            press(connection, client, "keep this state")
        wait_until(lambda: "kept: 2 in" in session._panel.saved.content)
        press(connection, client, "save labelled image")
        wait_until(lambda: "written:" in session._panel.saved.content)
        press(connection, client, "show", "unobserved")
        wait_until(lambda: "magenta: unobserved" in session._panel.status.content)
        press(connection, client, "back to the recording")
        wait_until(lambda: session.overlays.gizmo_pose("grasper") is None)
    assert len((run / "kept" / "states.jsonl").read_text().splitlines()) == 2
    assert not [record for record in caplog.records if record.exc_info]


NAN = float("nan")
PLACES = [(label, value) for value in (NAN, 1e9) for label in ("frame", "along shaft (mm)")]
CAMERAS: list[dict[str, Any]] = [
    {"position": [NAN] * 3},
    {"position": [1e300, -1e300, 1e300]},
    {"wxyz": [0.0] * 4},
    {"wxyz": [1.0]},
    {"fov": NAN},
    {"fov": "wide"},
    {"image_height": 1, "image_width": 10**12},
    {"image_height": 10**12, "image_width": 10**12},
    {"image_height": 0, "image_width": 0},
]


@pytest.mark.parametrize("odd", [*PLACES, *CAMERAS], ids=str)
def test_a_place_or_a_camera_that_is_none_does_not_end_the_others_pictures(shared: ViewerServer, odd: Any) -> None:
    known = set(shared.render_thread.sessions)
    with opened(shared) as connection:
        looks(connection)
        client = client_of(shared, known)
        if isinstance(odd, dict):
            looks(connection, **odd)
        else:
            press(connection, client, *odd)
            press(connection, client, "play", True)
            press(connection, client, "go to this frame's camera")
        time.sleep(0.1)
        assert shared.render_thread._thread.is_alive()
        assert is_served(shared)


def test_a_storm_of_messages_leaves_the_others_their_pictures(shared: ViewerServer) -> None:
    with opened(shared) as connection:
        for step in range(3000):
            looks(connection, position=[0.001 * step, 0.0, 0.0])
        assert is_served(shared)


def test_a_browser_for_which_time_cannot_go_on_does_not_end_the_others_pictures() -> None:
    drawn: list[bool] = []

    def fail(now: float) -> None:
        raise RuntimeError("no time")

    thread = RenderThread()
    thread.start()
    try:
        thread.add(SimpleNamespace(key=1, render=lambda sharp: None, tick=fail))
        time.sleep(0.2)
        thread.add(SimpleNamespace(key=2, render=lambda sharp: drawn.append(sharp), tick=lambda now: None))
        time.sleep(0.6)
    finally:
        thread.stop()
    assert drawn == [False, True]


def rewritten(run: Path, folder: Path, change: Callable[[dict[str, Any], dict[str, torch.Tensor]], None]) -> Path:
    """A copy of a run, whose scene `change` has altered."""
    copy = folder / "run"
    shutil.copytree(run, copy)
    path = copy / "scene.safetensors"
    with safe_open(path, framework="pt") as stream:
        header = json.loads(stream.metadata()["neeco"])
        tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
    change(header, tensors)
    save_file(tensors, path, {"neeco": json.dumps(header)})
    return copy


ODD_SCENES: dict[str, Callable[[dict[str, Any], dict[str, torch.Tensor]], Any]] = {
    "counts beyond all": lambda header, _: header.update(counts=[10**15, 1]),
    "sh_degree below": lambda header, _: header.update(sh_degree=-1),
    "endless words": lambda header, _: header.update(background="x" * 10**6),
    "a method elsewhere": lambda header, _: header.update(method="../../evil"),
    "a huge image": lambda header, _: header["recorded"][0].update(intrinsics=[60, 60, 32, 24, 10**9, 10**9, 0.01]),
    "a lens of NaN": lambda header, _: header["recorded"][0].update(intrinsics=[NAN, 60, 32, 24, 64, 48, 0.01]),
    "a joint of words": lambda header, _: header["recorded"][0].update(joints={"grasper": {"jaw_angle": "<b>"}}),
    "limits beyond all": lambda header, _: header["instruments"][0].update(joints={"jaw_angle": [-1e308, 1e308]}),
    "instruments without poses": lambda header, _: header.update(instruments=header["instruments"] * 1000),
    "Gaussians at NaN": lambda _, tensors: tensors["canonical.means"].fill_(NAN),
    "cameras that are none": lambda _, tensors: tensors["recorded.cameras"].zero_(),
    "poses at NaN": lambda _, tensors: tensors["recorded.poses"].fill_(NAN),
}


@pytest.mark.parametrize("change", ODD_SCENES.values(), ids=ODD_SCENES.keys())
def test_a_scene_that_cannot_be_is_refused_in_one_short_line(made_run, tmp_path, change):
    run = rewritten(made_run, tmp_path, change)
    with pytest.raises(NeecoError) as refused:
        ViewerServer(run)
    said = str(refused.value)
    assert said.startswith(str(run / "scene.safetensors"))
    assert "\n" not in said
    assert len(said) < len(str(run)) + 300


@pytest.mark.parametrize(
    "change",
    [
        lambda header, _: header["recorded"][0].update(name="x" * 10**6),
        lambda header, _: header.update(diagnostics={"<img src=x onerror=alert(1)>": "<img src=x onerror=alert(1)>"}),
        lambda _, tensors: tensors["canonical.log_scales"].fill_(1e9),
        lambda _, tensors: tensors["canonical.quats"].zero_(),
        lambda _, tensors: tensors["canonical.means"].fill_(1e9),
    ],
)
def test_an_odd_scene_is_still_served(made_run: Path, serve: Serve, tmp_path: Path, change: Callable[..., Any]) -> None:
    assert is_served(serve(rewritten(made_run, tmp_path, change)))
