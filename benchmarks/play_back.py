"""A moving scene opened by an engine that others wrote: PlayCanvas in Chromium.

    python benchmarks/play_back.py RUN [--out DIR]      # needs npm, the packages of the extra dev, /usr/bin/chromium

Installs the engine in a temporary folder, exports RUN as glTF, plays it to its first and middle state, and prints the
PSNR of the engine's pictures against our own rendering without shadows (dB). `--out`: the pictures, the engine's beside
ours.
"""

from __future__ import annotations

import argparse
import base64
import functools
import http.server
import io
import math
import subprocess
import tempfile
import threading
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import torch
from PIL import Image
from playwright.sync_api import sync_playwright

from neeco.evaluation.image_metrics import psnr, to_uint8
from neeco.training.run import open_gaussian_run
from neeco.viewer.scene_files import exported_states, moving_scene, write_glb

ENGINE = "playcanvas@2.23.3"
SETTLE_MS = 6000  # until the engine has sorted the Gaussians of a new state
CHROMIUM = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PAGE = """<!doctype html><body style="margin:0"><canvas id="canvas"></canvas><script type="module">
import * as pc from './node_modules/playcanvas/build/playcanvas.mjs';
const query = new URLSearchParams(location.search), number = name => Number(query.get(name));
const canvas = document.getElementById('canvas'), app = new pc.Application(
  canvas, {graphicsDeviceOptions: {antialias: false, preserveDrawingBuffer: true}});
app.setCanvasFillMode(pc.FILLMODE_NONE, number('width'), number('height'));
app.setCanvasResolution(pc.RESOLUTION_FIXED, number('width'), number('height'));
app.start();
const asset = new pc.Asset('scene', 'container', {url: 'scene.glb'});
app.assets.add(asset);
asset.on('error', error => window.failed = String(error));
asset.ready(() => {
  const scene = asset.resource.instantiateRenderEntity({}), eye = scene.findByName('laparoscope');
  app.root.addChild(scene);
  if (eye.camera) eye.camera.enabled = false;
  const camera = new pc.Entity();
  camera.addComponent('camera', {clearColor: new pc.Color(0, 0, 0, 1), nearClip: 0.001, farClip: 10, fov: number('fov'),
    aspectRatioMode: pc.ASPECT_MANUAL, aspectRatio: number('aspect')});
  camera.setPosition(eye.getPosition());
  camera.setRotation(eye.getRotation());
  app.root.addChild(camera);
  scene.addComponent('anim', {activate: true, speed: 0});
  scene.anim.assignAnimation('states', asset.resource.animations[0].resource);
  window.show = time => {
    scene.anim.baseLayer.play('states');
    scene.anim.baseLayer.activeStateCurrentTime = time;
  };
  window.ready = true;
});
app.assets.load(asset);
</script></body>"""


def pictures_of(folder: Path, query: str, times: list[float]) -> list[np.ndarray]:
    """What the engine shows [H, W, 3] at these times of the animation."""
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    pictures = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=CHROMIUM)
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{server.server_port}/page.html?{query}")
        page.wait_for_function("window.ready || window.failed", timeout=120_000)
        if failed := page.evaluate("window.failed"):
            raise SystemExit(f"{ENGINE}: {failed}")
        for time in times:
            page.evaluate(f"show({time})")
            page.wait_for_timeout(SETTLE_MS)
            data = page.evaluate("document.getElementById('canvas').toDataURL('image/png')").split(",")[1]
            pictures.append(np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")))
        browser.close()
    server.shutdown()
    return pictures


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    with open_gaussian_run(arguments.run, "export") as run, tempfile.TemporaryDirectory() as scratch:
        scene, folder = run.scene, Path(scratch)
        states = exported_states(scene, scene.recorded.states[0], None)
        recorded = scene.recorded.cameras[0]
        camera = replace(recorded, cx=recorded.width / 2, cy=recorded.height / 2)  # glTF has no other
        moving = moving_scene(scene, states, camera)
        write_glb(moving, camera, folder / "scene.glb")
        subprocess.run(["npm", "install", "--silent", "--prefix", scratch, ENGINE], check=True)
        (folder / "page.html").write_text(PAGE)
        aspect = camera.width * camera.fy / (camera.height * camera.fx)
        fov = 2 * math.degrees(math.atan(camera.height / (2 * camera.fy)))
        query = urlencode({"width": camera.width, "height": camera.height, "fov": fov, "aspect": aspect})
        chosen = [0, len(states) // 2]
        scene.shadow_strengths.zero_()
        for number, picture in zip(
            chosen, pictures_of(folder, query, [float(moving.times[k]) for k in chosen]), strict=True
        ):
            own = scene.render(states[number], camera).color.clamp(0, 1)
            print(f"state {number}: {psnr(torch.from_numpy(picture / 255).float(), own):.1f} dB")
            if arguments.out:
                arguments.out.mkdir(parents=True, exist_ok=True)
                both = np.concatenate([picture, to_uint8(255 * own.numpy())], 1)
                Image.fromarray(both).save(arguments.out / f"state-{number}.png")


if __name__ == "__main__":
    main()
