"""A data set is uploaded with its card, into a hub that this test serves on the loopback."""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from neeco.base.errors import NeecoError
from neeco.synthesis.writers.hub import check_hub, push_to_hub

TOKEN = "hf_of_nobody"


class Hub(ThreadingHTTPServer):
    """The few calls of the Hub's interface that an upload of small files makes."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Call)
        self.created: list[dict] = []
        self.files: dict[str, bytes] = {}
        self.refuses: str | None = None  # a call that it refuses

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Call(BaseHTTPRequestHandler):
    server: Hub

    def do_GET(self) -> None:
        self.answer(b"")

    def do_POST(self) -> None:
        self.answer(self.rfile.read(int(self.headers.get("Content-Length", 0))))

    def answer(self, body: bytes) -> None:
        hub, call = self.server, self.path.split("?")[0]
        if self.headers.get("Authorization") != f"Bearer {TOKEN}" or call == hub.refuses:
            return self.reply(403, {"error": "Forbidden"})
        if call == "/api/whoami-v2":
            return self.reply(200, {"type": "user", "name": "lab", "orgs": []})
        if call == "/api/validate-yaml":
            return self.reply(200, {"errors": [], "warnings": []})
        if call == "/api/repos/create":
            hub.created.append(json.loads(body))
            return self.reply(200, {"url": f"{hub.address}/datasets/lab/rods", "name": "lab/rods"})
        if call == "/api/datasets/lab/rods/preupload/main":
            files = json.loads(body)["files"]
            return self.reply(
                200,
                {"files": [{"path": each["path"], "uploadMode": "regular", "shouldIgnore": False} for each in files]},
            )
        if call == "/api/datasets/lab/rods/commit/main":
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    hub.files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
            return self.reply(200, {"commitUrl": f"{hub.address}/datasets/lab/rods/commit/1", "commitOid": "1"})
        return self.reply(404, {"error": f"unknown: {call}"})

    def reply(self, status: int, content: dict) -> None:
        data = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, environment) -> Iterator[Hub]:
    constants = pytest.importorskip("huggingface_hub.constants", reason="the extra hub")
    served = Hub()
    threading.Thread(target=served.serve_forever, daemon=True).start()
    monkeypatch.setattr(constants, "ENDPOINT", served.address)
    environment["HF_TOKEN"] = TOKEN
    yield served
    served.shutdown()
    served.server_close()


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    folder = tmp_path / "dataset"
    for name, content in {
        "README.md": b"---\nlicense: unknown\n---\n",
        "images/000000.png": b"image",
        "yolo/labels/val/000000.txt": b"0 .5 .5 .1 .1\n",
        ".records/000000.json": b"{}",
    }.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder


def test_the_hub_gets_the_data_set_its_card_and_nothing_else(hub: Hub, dataset: Path) -> None:
    for _ in range(2):
        check_hub("lab/rods")
        assert push_to_hub(dataset, "lab/rods") == f"{hub.address}/datasets/lab/rods"
    assert hub.created[0] == hub.created[0] | {"name": "rods", "organization": "lab", "type": "dataset"}
    assert hub.created[0].get("private") or hub.created[0].get("visibility") == "private"
    names = {"README.md", "images/000000.png", "yolo/labels/val/000000.txt"}
    assert hub.files == {name: (dataset / name).read_bytes() for name in names}


def test_whoever_is_not_logged_in_learns_it_before_anything_is_rendered(hub, environment):
    environment["HF_TOKEN"] = "hf_expired"
    with pytest.raises(NeecoError, match=r"^--push-to-hub lab/rods: .+; log in with `hf auth login`") as caught:
        check_hub("lab/rods")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["no name", "a/b/c", "-rods"])
def test_a_wrong_name_is_said_to_be_wrong_not_logged_out(hub: Hub, name: str) -> None:
    with pytest.raises(NeecoError, match=r"is not a repository's name; give NAME or OWNER/NAME"):
        check_hub(name)


def test_a_refused_upload_is_one_line(hub: Hub, dataset: Path) -> None:
    hub.refuses = "/api/repos/create"
    with pytest.raises(NeecoError, match=r"^--push-to-hub lab/rods: .*403") as caught:
        push_to_hub(dataset, "lab/rods")
    assert "\n" not in str(caught.value)
    hub.shutdown()
    hub.server_close()
    with pytest.raises(NeecoError, match=r"^--push-to-hub lab/rods: ") as caught:
        check_hub("lab/rods")
    assert "\n" not in str(caught.value)
