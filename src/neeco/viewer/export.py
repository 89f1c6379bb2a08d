"""`neeco view RUN --export FILE.html`: one file that carries the scene and draws it, without server, network or GPU."""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

import neeco
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import EVALUATION_FILE
from neeco.files import read_json, write_text
from neeco.scene import Scene
from neeco.scene.scene import gaussian_scene
from neeco.training.run import Run, load_run
from neeco.viewer.packed import pack, why_not

SCRIPTS = ("scene.js", "states.js", "drawing.js", "camera.js", "panel.js", "main.js")  # in this order, as one module
WORKER, STYLE, WASM = "worker.js", "page.css", "viewer.wasm"
MOST_DEGREE = 3
EMBEDDED_DEGREE = 1  # in a report: half the size, and for a first look
NUMBERS = (
    ("psnr", "PSNR", "{:.1f} dB"),
    ("psnr_instrument", "in instrument", "{:.1f} dB"),
    ("mask_iou", "IoU", "{:.3f}"),
)


def export_page(run: Path, output: Path, sh_degree: int, device: torch.device) -> str:
    """Write the page of a run to `output`; returns a line that says what was written.

    sh_degree: of the spherical harmonics that are kept, 0 to 3. Raises NeecoError for a run that is unfinished or whose
    method asks a network for every state, and where the file cannot be written.
    """
    if not 0 <= sh_degree <= MOST_DEGREE:
        raise NeecoError(f"--sh: {sh_degree} is no degree of harmonics; give 0 to {MOST_DEGREE}")
    trained = load_run(run, device)
    page = page_of_run(trained, sh_degree)
    write_text(Path(output), page)
    return f"{output}: {len(page) / 1e6:.2f} MB, {trained.scene.num_gaussians:,} Gaussians; open it in any browser"


def embedded_page(run: Run) -> str | None:
    """The page of a run for a frame in its report; None where a page cannot hold it."""
    return None if why_not(run.scene) else page_of_run(run, EMBEDDED_DEGREE)


def page_of_run(run: Run, sh_degree: int) -> str:
    """The page of a run, harmonics up to `sh_degree`. Raises NeecoError where a page cannot hold it (`why_not`)."""
    if refusal := why_not(run.scene):
        raise NeecoError(f"--export: {refusal}")
    scene = gaussian_scene(run.scene, "--export")
    header, planes = pack(scene, sh_degree)
    return page_of(header, planes, Path(run.path).resolve().name, facts_of(run, scene))


def page_of(header: dict[str, Any], planes: bytes, title: str, facts: list[tuple[str, str]]) -> str:
    """The whole page. Everything that comes from the run is escaped, or packed so that it holds no markup."""
    script, style = _source(*SCRIPTS), _source(STYLE)
    return (
        _templates()
        .get_template("page.html")
        .render(
            title=title,
            subtitle="learned with neeco: move the sliders, drag the picture",
            facts=facts,
            script=Markup(script),
            style=Markup(style),
            worker=Markup(_source(WORKER)),
            script_hash=Markup(_hash(script)),
            style_hash=Markup(_hash(style)),
            head=_deflated(json.dumps(header, separators=(",", ":"), allow_nan=False).encode()),
            scene=_deflated(planes),
            wasm=_deflated(files(__package__).joinpath(WASM).read_bytes()),
        )
    )


def facts_of(run: Run, scene: Scene) -> list[tuple[str, str]]:
    """What the page says of itself: (name, value)."""
    facts = [
        ("capture", Path(run.config["capture"]).name),
        ("method", scene.method),
        ("Gaussians", f"{len(scene.canonical):,}"),
        ("frames trained on", str(len(scene.recorded.names))),
    ]
    iterations = scene.diagnostics.get("iterations")
    if isinstance(iterations, int):
        facts.append(("iterations", f"{iterations:,}"))
    return [*facts, *_scores(Path(run.path) / EVALUATION_FILE), ("made with", f"neeco {neeco.__version__}")]


def _scores(path: Path) -> list[tuple[str, str]]:
    """A line per split of evaluation.json; none where the run was not evaluated."""
    if not path.is_file():
        return []
    try:
        given = read_json(path)["given"]
        return [(split, _written(scores)) for split, scores in given.items()]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        said = " ".join(str(error).split())
        raise NeecoError(f"{path}: not what `neeco evaluate` writes ({said}); evaluate again") from None


def _written(scores: dict[str, Any]) -> str:
    known = [(name, form.format(scores[key])) for key, name, form in NUMBERS if scores.get(key) is not None]
    return ", ".join(f"{name} {value}" for name, value in known)


def _source(*names: str) -> str:
    folder = files(__package__).joinpath("page")
    return "\n".join(folder.joinpath(name).read_text(encoding="utf-8") for name in names)


def _hash(text: str) -> str:
    """As a Content-Security-Policy names an inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _deflated(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode()


@cache
def _templates() -> Environment:
    return Environment(loader=PackageLoader("neeco.viewer", "page"), autoescape=True, undefined=StrictUndefined)
