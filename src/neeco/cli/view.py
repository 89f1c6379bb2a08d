"""`neeco view`: show a run or a capture in a browser, or a run as one file; pose frames of a capture by hand."""

from __future__ import annotations

import contextlib
import tempfile
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from neeco.base.errors import NeecoError
from neeco.base.settings import Device
from neeco.synthesis.settings import RECORDED_SIZE, SizeSettings

POLL_S = 0.5  # s between two checks for Ctrl-C


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Show a run, also during training, in a web browser: any state and view, with unobserved regions and errors; or
    a capture before training. With --export, write one file that shows a run without a server. With --annotate, set
    roll and joints of an instrument detected in a video by hand, in the most informative frames."""

    source: Annotated[Path, tyro.conf.arg(metavar="RUN|CAPTURE"), tyro.conf.Positional]
    """Run folder of `neeco train`, finished or not, or a capture. With --annotate: a capture, or a run of one, whose
    scene is then overlaid semi-transparently."""
    port: int = 8080
    """Port to listen on; the next free one if it is in use."""
    host: str = "127.0.0.1"
    """Address to listen on. All but the loopback address are reachable from other machines, by plain HTTP."""
    no_browser: bool = False
    """Do not open a web browser; only print the address."""
    annotate: bool = False
    """Pose frames of the capture by hand; they are stored in its hand_posed.yaml, and its states are solved again."""
    export: Path | None = None
    """Write one HTML file instead, as in --export page.html."""
    size: tyro.conf.OmitArgPrefixes[SizeSettings] = RECORDED_SIZE
    sh: int = 3
    """Degree of the spherical harmonics in an exported file, 0 to 3; lower is smaller."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Export, or serve until Ctrl-C."""
    from neeco.raster.devices import device_of

    if arguments.annotate and arguments.export is not None:
        raise NeecoError("--annotate, --export: cannot be combined; give one of the two")
    if arguments.annotate:
        from neeco.viewer.posing import PosingServer

        with PosingServer(arguments.source, arguments.host, arguments.port) as server:
            return _serve(server.address, arguments)
    if arguments.export is not None:
        from neeco.cli._output import require_ending
        from neeco.viewer.export import export_page

        if arguments.size != RECORDED_SIZE:
            raise NeecoError("--size, --scale: an exported page renders at the size of its window; remove them")
        require_ending("--export", arguments.export, ".html", ".htm")
        print(export_page(arguments.source, arguments.export, arguments.sh, device_of(arguments.device)))
        return 0
    arguments.size.check()
    source = arguments.source
    if not source.exists():
        raise NeecoError(f"{source}: neither a run folder nor a capture; correct the path")
    if (source / "transforms.json").is_file() and not (source / "config.yaml").exists():  # a capture, no run
        from neeco.viewer.recording import RecordingServer

        with RecordingServer(source, arguments.host, arguments.port) as recording:
            return _serve(recording.address, arguments)
    from neeco.viewer.server import ViewerServer

    device = device_of(arguments.device)
    with ViewerServer(source, arguments.host, arguments.port, device, arguments.size) as viewer:
        return _serve(viewer.address, arguments)


def _serve(address: str, arguments: Arguments) -> int:
    """Print the address of a server, and wait for Ctrl-C."""
    from neeco.viewer.access import is_loopback

    if not is_loopback(arguments.host):
        warnings.warn(
            f"--host {arguments.host}: plain HTTP: others on the network can read the images and the token; "
            "use a trusted network, or the default host with `ssh -L`",
            stacklevel=2,
        )
    try:
        print(f"{address}  (Ctrl-C ends)", flush=True)
        with contextlib.nullcontext() if arguments.no_browser else _opened(address):
            while True:  # short waits, because a signal just before a wait is handled after it
                time.sleep(POLL_S)
    except KeyboardInterrupt:
        print()
    return 0


@contextlib.contextmanager
def _opened(address: str) -> Iterator[None]:
    """Open a browser via a file that only its user can read: all users can read a process's arguments."""
    import webbrowser

    with tempfile.TemporaryDirectory(prefix="neeco-view-") as folder:
        page = Path(folder) / "view.html"
        page.write_text(f'<!doctype html><meta http-equiv="refresh" content="0;url={address}">', encoding="utf-8")
        webbrowser.open(page.as_uri())
        yield
