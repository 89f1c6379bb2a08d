"""`neeco view RUN --export FILE.html`: one file that carries the scene and renders it, without server, network or GPU.

The scene is packed as `neeco-page/1` (docs/viewer.md): every number of a Gaussian becomes a plane of its own, low bytes
before high ones, so that deflate finds the likeness of neighbours. What joints move can be packed; what
a network moves cannot.
"""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from torch import Tensor
from torch.nn.functional import normalize

import neeco
from neeco.base.errors import NeecoError
from neeco.base.files import write_text
from neeco.geometry.lines import frame_about
from neeco.labels.labellers import threshold_of
from neeco.raster.reference import SH_C0
from neeco.scene import DrawableScene, GaussianScene
from neeco.scene.drawable import ArticulatedMotion
from neeco.scene.gaussian_scene import require_gaussians
from neeco.synthesis.samplers import shafts_of
from neeco.training.run import TrainedRun, load_run
from neeco.viewer.views import slider_ranges

SCHEMA = "neeco-page/1"
SCRIPTS = ("scene.js", "states.js", "drawing.js", "camera.js", "panel.js", "main.js")  # in this order, as one module
WORKER, STYLE, WASM = "worker.js", "page.css", "viewer.wasm"
MAX_DEGREE = 3


@dataclass(frozen=True, kw_only=True)
class ExportSettings:
    """Limits of what an exported page holds."""

    embedded_degree: int = 1  # degree of the harmonics in a report: half the size, for an overview
    max_instruments: int = 8  # maximum number of instruments of the page's rasteriser
    max_axes: int = 8  # maximum number of axes of one instrument
    max_labels: int = 32  # maximum number of labels of the page's rasteriser
    thinnest_mm: float = 0.01  # minimum thickness of a Gaussian in mm, below any pixel
    position_steps: int = 2**20 - 1  # of a body's box: 2**16 change the order in depth of neighbours, which costs 5 dB


EXPORT = ExportSettings()

NOT_FINITE = "--export: the scene holds numbers that are not finite; train again"
BYTES = {"uint8": 1, "int8": 1, "uint16": 2, "uint24": 3}


def export_page(run: Path, output: Path, sh_degree: int, device: torch.device) -> str:
    """Write the page of a run to `output`; returns a line that says what was written.

    sh_degree: of the spherical harmonics that are kept, 0 to 3. Raises NeecoError for a run that is unfinished or whose
    method asks a network for every state, and where the file cannot be written.
    """
    if not 0 <= sh_degree <= MAX_DEGREE:
        raise NeecoError(f"--sh must be 0 to {MAX_DEGREE} (got {sh_degree})")
    trained = load_run(run, device)
    page = page_of_run(trained, sh_degree)
    write_text(Path(output), page)
    return f"{output}: {len(page) / 1e6:.2f} MB, {trained.scene.num_gaussians:,} Gaussians; open it in any browser"


def page_of_run(run: TrainedRun, sh_degree: int) -> str:
    """Return the page of a run, harmonics up to `sh_degree`. Raises NeecoError if unsupported (`why_not`)."""
    scene, packed = run.scene, pack(run.scene, sh_degree)
    facts = [
        ("capture", Path(run.config["capture"]).name),
        ("method", scene.method),
        ("Gaussians", f"{scene.num_gaussians:,}"),
        ("frames trained on", str(len(scene.recorded.names))),
    ]
    iterations = scene.diagnostics.get("iterations")
    if isinstance(iterations, int):
        facts.append(("iterations", f"{iterations:,}"))
    facts.append(("made with", f"neeco {neeco.__version__}"))
    return page_of(*packed, Path(run.path).resolve().name, facts)


def page_of(header: dict[str, Any], planes: bytes, title: str, facts: list[tuple[str, str]]) -> str:
    """The whole page; facts: (name, value) of what it says of itself. Everything that comes from the run is escaped, or
    packed so that it holds no markup."""
    script, style = _source(*SCRIPTS), _source(STYLE)
    try:
        head = json.dumps(header, separators=(",", ":"), allow_nan=False)
    except ValueError:
        raise NeecoError(NOT_FINITE) from None
    pages = Environment(loader=PackageLoader("neeco.viewer", "page"), autoescape=True, undefined=StrictUndefined)
    return pages.get_template("page.html").render(
        title=title,
        subtitle="learned with neeco: move the sliders, drag the picture",
        facts=facts,
        script=Markup(script),
        style=Markup(style),
        worker=Markup(_source(WORKER)),
        script_hash=Markup(_hash(script)),
        style_hash=Markup(_hash(style)),
        head=_deflated(head.encode()),
        scene=_deflated(planes),
        wasm=_deflated(files(__package__).joinpath(WASM).read_bytes()),
    )


def _source(*names: str) -> str:
    folder = files(__package__).joinpath("page")
    return "\n".join(folder.joinpath(name).read_text(encoding="utf-8") for name in names)


def _hash(text: str) -> str:
    """Return the source expression of an inline script or style in a Content-Security-Policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _deflated(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode()


def why_not(scene: DrawableScene) -> str | None:
    """Why a page cannot hold `scene`, in a line that says what can show it; None where it can."""
    motion = scene.motion()
    if motion is None:
        return (
            f"method {scene.method} asks a network for every state, which a page cannot; "
            "look at it with `neeco view RUN`, or export a run of method kinematic or 3dgs"
        )
    most_axes = max((len(axes) for axes in motion.axes), default=0)
    for name, count, most in (
        ("instruments", len(scene.instruments), EXPORT.max_instruments),
        ("axes of an instrument", most_axes, EXPORT.max_axes),
        ("labels", len(scene.label_names), EXPORT.max_labels),
    ):
        if count > most:
            return f"{count} {name}: a page has room for {most}; look at it with `neeco view RUN`"
    return None


@torch.no_grad()
def pack(scene: DrawableScene, sh_degree: int) -> tuple[dict[str, Any], bytes]:
    """Return (header, planes) of a scene, harmonics up to `sh_degree`. Raises NeecoError if its method cannot be
    packed, or it exceeds the page's numbers of instruments, joints or labels."""
    motion = scene.motion()
    if (refusal := why_not(scene)) or motion is None:
        raise NeecoError(f"--export: {refusal}")
    scene = require_gaussians(scene, "--export")
    canonical = scene.canonical
    degree = min(sh_degree, scene.sh_degree)
    rows, boxes = [], []  # positions relative to the box of each body, and the boxes' corners
    for body in torch.split(canonical.means, list(canonical.counts)):
        low, high = (body.amin(0), body.amax(0)) if len(body) else (body.new_zeros(3), body.new_ones(3))
        rows.append(_rounded((body - low) / (high - low).clamp_min(1e-9) * EXPORT.position_steps))
        boxes.append([low.tolist(), high.tolist()])
    scales, scale_range = _quantized(motion.log_scales.clamp_min(float(np.log(EXPORT.thinnest_mm))), 255)
    base, base_range = _quantized(canonical.sh_dc[:, 0] * SH_C0 + 0.5, 65535)
    turns = [_quantized(column[:, None], 65535) for column in motion.amounts.flatten(1).unbind(1)]
    none = np.zeros((len(canonical), 0), np.int64)  # where nothing turns
    rest = canonical.sh_rest  # harmonics [N, 15, 3] without the first, in -127 to 127 of the maximum of every degree
    harmonics, bands = [none], []
    for d in range(1, degree + 1):
        band = rest[:, d * d - 1 : (d + 1) ** 2 - 1]
        largest = max(float(band.abs().max()) if band.numel() else 0.0, 1e-9)
        harmonics.append(_rounded(band / largest * 127).reshape(len(rest), -1))
        bands.append(largest)
    fields = (  # name, whole numbers [N, K], type
        ("mean", np.concatenate(rows), "uint24"),
        ("quat", _rounded(normalize(canonical.quats, dim=1) * 127), "int8"),
        ("scale", scales, "uint8"),
        ("opacity", _rounded(torch.sigmoid(canonical.opacity_logits)[:, None] * 255), "uint8"),
        ("base", base, "uint16"),
        ("turn", np.concatenate([none, *(numbers for numbers, _ in turns)], 1), "uint16"),
        ("label", _rounded(scene.label_channels() * 255), "uint8"),
        ("sh", np.concatenate(harmonics, 1), "int8"),
    )
    turn_ranges = [ends for _, ends in turns]
    lamps = zip(scene.shadow_offsets.tolist(), scene.shadow_strengths.clamp(0, 1).tolist(), strict=True)
    header = {
        "schema": SCHEMA,
        "counts": list(canonical.counts),
        "degree": degree,
        "fields": [[name, numbers.shape[1], kind] for name, numbers, kind in fields],
        "ranges": {"mean": boxes, "scale": scale_range, "base": base_range, "turn": turn_ranges, "sh": bands},
        "light": {
            "falloff": scene.falloff.tolist(),
            "vignette": scene.vignette.tolist(),
            "background": scene.background,
            "shadow_width": float(scene.shadow_width),
            "lamps": [[*offset, strength] for offset, strength in lamps if strength > 0] if scene.casts_shadow else [],
        },
        "threshold": threshold_of(scene),
        "labels": [list(name) for name in scene.label_names],
        "instruments": _instruments(scene, motion),
        "recorded": _recorded(scene, motion),
    }
    planes = []
    for _, numbers, kind in fields:  # K planes of N numbers, all low bytes before the high ones
        split = np.ascontiguousarray(numbers.T, "<i4")[..., None].view(np.uint8)  # [K, N, 4]
        planes.append(np.ascontiguousarray(split[..., : BYTES[kind]].transpose(2, 0, 1)).tobytes())
    return header, b"".join(planes)


def _quantized(values: Tensor, steps: int) -> tuple[np.ndarray, list[float]]:
    """Return numbers [N, K] quantised to this many steps of their common range, and the range."""
    low, high = (float(values.min()), float(values.max())) if values.numel() else (0.0, 1.0)
    return _rounded((values - low) / max(high - low, 1e-9) * steps), [low, high]


def _rounded(values: Tensor) -> np.ndarray:
    if not values.isfinite().all():
        raise NeecoError(NOT_FINITE)
    return np.rint(values.double().cpu().numpy()).astype(np.int64)


def _instruments(scene: GaussianScene, motion: ArticulatedMotion) -> list[dict[str, Any]]:
    """Name, shaft, joints and their axes of every instrument that moves, in its own frame, mm and rad."""
    if not motion.axes:
        return []
    shafts, ranges = shafts_of(scene), slider_ranges(scene.instruments, scene.recorded.states)
    instruments = []
    for instrument, axes in zip(scene.instruments, motion.axes, strict=False):
        names, joints = list(instrument.joints), []
        for name in names:
            span = ranges[instrument.name, name]
            joints.append({"name": name, "range": [span.lower, span.upper], "slides": instrument.slides(name)})
        shaft = shafts[instrument.name]
        side, up, _ = frame_about(shaft.along).T
        vectors = {"end": shaft.end, "along": shaft.along, "side": side, "up": up}
        moves = []
        for item in axes:
            place = {"pivot": item.pivot.tolist(), "axis": item.axis.tolist()}
            moves.append(place | {"joint": names.index(item.reading), "slides": item.slides})
        shape = {name: vector.tolist() for name, vector in vectors.items()}
        instruments.append({"name": instrument.name, "shaft": shape, "joints": joints, "axes": moves})
    return instruments


def _recorded(scene: GaussianScene, motion: ArticulatedMotion) -> dict[str, Any]:
    """Names, cameras and states of the frames trained on; matrices are the first three rows, 12 numbers."""
    moving = scene.instruments[: len(motion.axes)]
    states = [scene.registered(state) for state in scene.recorded.states]
    return {
        "names": list(scene.recorded.names),
        "cameras": [_rows(camera.world_from_camera) for camera in scene.recorded.cameras],
        "lenses": [
            [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, camera.near]
            for camera in scene.recorded.cameras
        ],
        "poses": [[_rows(state.instruments[item.name].pose) for item in moving] for state in states],
        "joints": [
            [[state.instruments[item.name].joints[joint] for joint in item.joints] for item in moving]
            for state in states
        ],
    }


def _rows(matrix: Tensor) -> list[float]:
    return [round(value, 5) for value in matrix[:3].double().flatten().tolist()]
