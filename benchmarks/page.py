"""How close the exported page is to `rasterize`, how fast it renders, and how soon it shows something.

    python benchmarks/page.py RUN [--frames 4] [--seconds 5]

Exports RUN, opens the file in Chromium (Playwright; `chromium` must be on the PATH) and prints, for some recorded
frames with their own and with a foreign reading of the first joint, PSNR whole and inside the instrument, equal label
ids and error of depth; then pictures a second while a joint (or the frame) moves, beside the native kernels.
"""

from __future__ import annotations

import argparse
import base64
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.capture.model import State
from neeco.evaluation.image_metrics import psnr
from neeco.labels.labellers import composited_parts, threshold_of
from neeco.raster import rasterize
from neeco.scene.gaussian_scene import GaussianScene
from neeco.training.run import open_gaussian_run
from neeco.viewer.export import export_page

OPENINGS = 5
DRAW = """async ([frame, reading, view]) => {
  const page = window.neeco;
  page.follow(true);
  page.wish.instruments.forEach((own, k) => page.reset(k));
  if (reading !== null) page.wish.instruments[0].joints[0] = reading;
  page.toFrame(frame);
  const { width, height, pixels, ids, depths } = await page.whole(view);
  const text = (array) => btoa(Array.from(new Uint8Array(array.buffer), (byte) => String.fromCharCode(byte)).join(""));
  return [width, height, text(pixels), text(ids), text(depths)];
}"""
MOVE = """async (seconds) => {
  const page = window.neeco, joints = page.head.instruments[0]?.joints ?? [];
  while (page.busy) await new Promise((done) => setTimeout(done, 10));
  page.busy = true;
  const began = performance.now();
  let drawn = 0;
  while (performance.now() - began < 1000 * seconds) {
    if (joints.length) page.wish.instruments[0].joints[0] = joints[0].range[0] + 0.3 + 0.2 * Math.sin(drawn / 10);
    else page.wish.frame = drawn % page.last;
    await page.show(1);
    drawn++;
  }
  page.busy = false;
  return (1000 * drawn) / (performance.now() - began);
}"""


def shown(page: Any, frame: int, reading: float | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image [H, W, 3] in [0, 1], label ids [H, W], depth [H, W] mm of the page."""
    width, height, pixels, _, depths = page.evaluate(DRAW, [frame, reading, 0])
    ids = page.evaluate(DRAW, [frame, reading, 2])[3]
    raw = [np.frombuffer(base64.b64decode(text), kind) for text, kind in ((pixels, "u1"), (ids, "u1"), (depths, "<f4"))]
    return raw[0].reshape(height, width, 4)[..., :3] / 255, raw[1].reshape(height, width), raw[2].reshape(height, width)


def states(scene: GaussianScene, frame: int) -> Iterator[tuple[float | None, State]]:
    """The recorded state, and the same with the reading of the frame half the recording away."""
    recorded = scene.recorded.states
    yield None, recorded[frame]
    if scene.instruments and scene.instruments[0].joints:
        name, joint = scene.instruments[0].name, next(iter(scene.instruments[0].joints))
        reading = recorded[(frame + len(recorded) // 2) % len(recorded)].instruments[name].joints[joint]
        given = recorded[frame].instruments[name]
        changed = replace(given, joints={**given.joints, joint: reading})
        yield reading, State({**recorded[frame].instruments, name: changed}, recorded[frame].time)


@torch.no_grad()
def compare(page: Any, scene: GaussianScene, frame: int) -> None:
    """A row of the table for every state of a frame."""
    for reading, state in states(scene, frame):
        truth = scene.render(state, scene.recorded.cameras[frame], labels=True)
        parts = composited_parts(truth, threshold_of(scene)).numpy()
        image, ids, depths = shown(page, frame, reading)
        drawn, counted = truth.color.clamp(0, 1), torch.from_numpy(parts > 0)
        whole, inside = (psnr(torch.from_numpy(image), drawn, mask) for mask in (None, counted))
        off = np.abs(depths - truth.depth.numpy())[truth.alpha.numpy() > 0.5]
        own = "own" if reading is None else f"{reading:.2f} rad"
        print(
            f"| {frame} | {own} | {whole:.1f} | {inside:.1f} | {100 * (ids == parts).mean():.3f} | "
            f"{np.quantile(off, 0.99):.2f} |"
        )


@torch.no_grad()
def native_rate(scene: GaussianScene, seconds: float) -> float:
    """Posed images a second, by the native kernels."""
    recorded, drawn, began = scene.recorded, 0, time.monotonic()
    while time.monotonic() - began < seconds:
        k = drawn % len(recorded.states)
        rasterize(scene.at(recorded.states[k]), recorded.cameras[k])
        drawn += 1
    return drawn / (time.monotonic() - began)


def opened(browser: Any, path: Path) -> tuple[Any, float]:
    """The page, and how long it took to show something, s."""
    page = browser.new_page(viewport={"width": 640, "height": 400})
    began = time.monotonic()
    page.goto(path.as_uri())
    while not page.evaluate("Boolean(window.neeco && window.neeco.drawn)"):
        time.sleep(0.005)
    return page, time.monotonic() - began


def main() -> None:
    """Print both tables."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=5.0)
    arguments = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as folder,
        open_gaussian_run(arguments.run, "page") as trained,
        sync_playwright() as driver,
    ):
        scene = trained.scene
        path = Path(folder) / "page.html"
        print(export_page(arguments.run, path, 3, torch.device("cpu")), end="\n\n")
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        times = []
        for _ in range(OPENINGS):
            page, seconds = opened(browser, path)
            times.append(seconds)
            page.close()
        page, _ = opened(browser, path)
        print(
            "| frame | first joint | dB whole | dB in instrument | % ids equal | depth off, 99 %, mm |\n"
            "|---|---|---|---|---|---|"
        )
        for frame in np.linspace(0, len(scene.recorded.states) - 1, arguments.frames).astype(int):
            compare(page, scene, int(frame))
        rates = [(page.evaluate(MOVE, arguments.seconds), native_rate(scene, arguments.seconds)) for _ in range(3)]
        in_page, native = (statistics.median(values) for values in zip(*rates, strict=True))
        workers = page.evaluate("window.neeco.drawing.workers.length")
        first = statistics.median(times)
        print(f"\nfirst picture after {first:.2f} s")
        print(f"{in_page:.1f} pictures a second with {workers} workers, native {native:.1f}")
        browser.close()


if __name__ == "__main__":
    main()
