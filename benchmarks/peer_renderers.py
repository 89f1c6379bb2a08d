"""One of the other renderers, drawing random poses of a mesh with masks and depth, for peers.py.

    python benchmarks/peer_renderers.py pyrender --count 50 --size 320x256

Needs NumPy and the renderer alone. Prints one line of JSON: images a second, the share of the image that is
instrument, and how the images were made. Exit status 3 where the renderer is not installed. The scene is a tube with
two jaws over a bumpy sheet, 22,000 triangles, lit from the camera: for speed at the coverage of `liver`, not for looks.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

MISSING = 3  # exit status
FOCAL = 1.1  # of the image's width
DEPTH_MM = 120.0  # of the tissue
SAMPLES = 5  # per pixel of the path tracers, denoised where the renderer can
TISSUE_CELLS = 100
Mesh = tuple[np.ndarray, np.ndarray]  # vertices [V, 3] mm, triangles [T, 3]
Draw = Callable[[np.ndarray], np.ndarray | None]  # pose -> mask of the instrument, where it is in memory


def tissue() -> Mesh:
    """A bumpy sheet across the view; camera frame, OpenCV axes."""
    ticks = np.linspace(-100, 100, TISSUE_CELLS + 1)
    x, y = np.meshgrid(ticks, ticks)
    z = DEPTH_MM + 4 * np.sin(x / 9) * np.cos(y / 7)
    corner = np.arange(TISSUE_CELLS * (TISSUE_CELLS + 1)).reshape(TISSUE_CELLS, -1)[:, :-1].ravel()
    row = TISSUE_CELLS + 1
    quads = np.stack([corner, corner + 1, corner + row + 1, corner + row], 1)
    return np.stack([x, y, z], -1).reshape(-1, 3), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def tube(radius: float, start: np.ndarray, end: np.ndarray, sides: int = 48, rings: int = 12) -> Mesh:
    """A tube that narrows to a third towards its end."""
    turn = 2 * np.pi * np.arange(sides) / sides
    along = np.linspace(0, 1, rings + 1)[:, None, None]
    axis = (end - start) / np.linalg.norm(end - start)
    aside = np.cross(axis, [0.0, 1.0, 0.0])
    aside /= np.linalg.norm(aside)
    circle = np.cos(turn)[:, None] * aside + np.sin(turn)[:, None] * np.cross(axis, aside)
    vertices = start + along * (end - start) + radius * (1 - along * 2 / 3) * circle
    index = np.arange(rings * sides).reshape(rings, sides)
    beside = np.roll(index, -1, axis=1)
    triangles = [np.stack([index, beside, beside + sides], -1), np.stack([index, beside + sides, index + sides], -1)]
    return vertices.reshape(-1, 3), np.concatenate(triangles).reshape(-1, 3)


def instrument() -> Mesh:
    """A shaft and two jaws; its tip is at the origin, the shaft leads to the camera's right."""
    parts = [tube(10.0, np.array([90.0, 10.0, -40.0]), np.array([8.0, 1.0, -4.0]))]
    parts += [tube(6.0, np.array([9.0, 1.0, -4.0]), np.array([-6.0, side * 7.0, 2.0]), rings=8) for side in (-1, 1)]
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    return np.concatenate([part[0] for part in parts]), np.concatenate(
        [part[1] + start for part, start in zip(parts, starts, strict=True)]
    )


def pose(rng: np.random.Generator) -> np.ndarray:
    """A random camera_from_instrument [4, 4], mm, above the tissue."""
    turn = rng.uniform(-0.6, 0.6)
    found = np.eye(4)
    found[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    found[:3, 3] = *rng.uniform(-15, 15, 2), DEPTH_MM - rng.uniform(12, 25)
    return found


GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


def with_pyrender(width: int, height: int) -> tuple[Draw, str]:
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    import pyrender

    renderer = pyrender.OffscreenRenderer(width, height)
    scene = pyrender.Scene(ambient_light=[0.2] * 3)
    camera = pyrender.IntrinsicsCamera(FOCAL * width, FOCAL * width, width / 2, height / 2, znear=1.0, zfar=1000.0)
    scene.add(camera)
    scene.add(pyrender.DirectionalLight(intensity=3.0))

    def node(mesh: Mesh, color: list[float]) -> Any:
        material = pyrender.MetallicRoughnessMaterial(baseColorFactor=color, doubleSided=True)
        vertices = mesh[0].astype(np.float32)
        primitive = pyrender.Primitive(vertices, normals(mesh).astype(np.float32), indices=mesh[1], material=material)
        return scene.add(pyrender.Mesh([primitive]), pose=GL_FROM_CV)

    below, above = node(tissue(), [0.7, 0.3, 0.3, 1.0]), node(instrument(), [0.7, 0.7, 0.7, 1.0])

    def draw(camera_from_instrument: np.ndarray) -> np.ndarray | None:
        scene.set_pose(above, GL_FROM_CV @ camera_from_instrument)
        renderer.render(scene)  # image and depth
        colors = {below: (0, 0, 0), above: (255, 0, 0)}
        mask, _ = renderer.render(scene, flags=pyrender.RenderFlags.SEG, seg_node_map=colors)
        return mask[..., 0] > 0

    return draw, "OpenGL, rasterised; a second pass for the mask"


def normals(mesh: Mesh) -> np.ndarray:
    """Unit normals [V, 3] of the vertices."""
    vertices, triangles = mesh
    a, b, c = vertices[triangles.T]
    found = np.zeros_like(vertices)
    for corner in triangles.T:
        np.add.at(found, corner, np.cross(b - a, c - a))
    return found / np.linalg.norm(found, axis=1, keepdims=True).clip(1e-9)


def with_pybullet(width: int, height: int) -> tuple[Draw, str]:
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)

    def body(mesh: Mesh, color: list[float], folder: str) -> int:
        path = Path(folder) / "mesh.obj"
        lines = [f"v {x} {y} {z}" for x, y, z in mesh[0]] + [f"f {a} {b} {c}" for a, b, c in mesh[1] + 1]
        path.write_text("\n".join(lines) + "\n")
        shape = pybullet.createVisualShape(pybullet.GEOM_MESH, fileName=str(path), rgbaColor=color)
        return pybullet.createMultiBody(baseVisualShapeIndex=shape)

    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as two:
        body(tissue(), [0.7, 0.3, 0.3, 1.0], one)
        above = body(instrument(), [0.7, 0.7, 0.7, 1.0], two)
    view = pybullet.computeViewMatrix([0, 0, 0], [0, 0, 1], [0, -1, 0])
    field = float(np.degrees(2 * np.arctan(height / (2 * FOCAL * width))))
    projection = pybullet.computeProjectionMatrixFOV(field, width / height, 1.0, 1000.0)

    def draw(camera_from_instrument: np.ndarray) -> np.ndarray | None:
        half = float(np.arctan2(camera_from_instrument[1, 0], camera_from_instrument[0, 0])) / 2
        place = camera_from_instrument[:3, 3].tolist()
        pybullet.resetBasePositionAndOrientation(above, place, [0, 0, np.sin(half), np.cos(half)])
        found = pybullet.getCameraImage(
            width, height, view, projection, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=client
        )
        _, _, mask = (np.reshape(image, (height, width, -1)) for image in found[2:5])  # after image and depth
        return mask[..., 0] == above

    return draw, "TinyRenderer, rasterised by the CPU"


def with_mitsuba(width: int, height: int) -> tuple[Draw, str]:
    import mitsuba

    mitsuba.set_variant("scalar_rgb")

    def shape(mesh: Mesh, color: list[float], name: str) -> Any:
        bsdf = mitsuba.load_dict(
            {"type": "twosided", "b": {"type": "diffuse", "reflectance": {"type": "rgb", "value": color}}}
        )
        properties = mitsuba.Properties()
        properties["bsdf"] = bsdf
        made = mitsuba.Mesh(name, len(mesh[0]), len(mesh[1]), props=properties)
        parameters = mitsuba.traverse(made)
        parameters["vertex_positions"] = mesh[0].astype(np.float32).ravel()
        parameters["faces"] = mesh[1].astype(np.uint32).ravel()
        parameters.update()
        return made

    field = float(np.degrees(2 * np.arctan(1 / (2 * FOCAL))))
    camera = mitsuba.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, -1, 0])
    below, (vertices, triangles) = shape(tissue(), [0.7, 0.3, 0.3], "tissue"), instrument()
    fixed = {
        "type": "scene",
        "integrator": {"type": "aov", "aovs": "d:depth,i:shape_index", "path": {"type": "path", "max_depth": 3}},
        "light": {"type": "point", "position": [0, 0, 0], "intensity": {"type": "rgb", "value": 2e4}},
        "sensor": {
            "type": "perspective",
            "fov": field,
            "to_world": camera,
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": SAMPLES},
        },
    }

    def draw(camera_from_instrument: np.ndarray) -> np.ndarray | None:
        moved = vertices @ camera_from_instrument[:3, :3].T + camera_from_instrument[:3, 3]
        above = shape((moved, triangles), [0.7, 0.7, 0.7], "instrument")
        scene = mitsuba.load_dict({**fixed, "a_tissue": below, "b_instrument": above})
        found = np.array(mitsuba.render(scene))
        return found[..., -1] > found[..., -1].min() + 0.5  # the last channel is the shape's index

    return draw, f"path tracing, {SAMPLES} samples, not denoised"


def with_blender(width: int, height: int) -> tuple[Draw, str]:
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene, layer = bpy.context.scene, bpy.context.view_layer
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", SAMPLES, True
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.render.use_persistent_data = True
    threads = os.environ.get("OMP_NUM_THREADS")
    if threads:
        scene.render.threads_mode, scene.render.threads = "FIXED", int(threads)
    layer.use_pass_z = layer.use_pass_object_index = True
    if hasattr(scene.render.image_settings, "media_type"):
        scene.render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    scene.render.image_settings.file_format = "OPEN_EXR_MULTILAYER"

    def add(name: str, mesh: Mesh, color: list[float], number: int) -> Any:
        data = bpy.data.meshes.new(name)
        data.from_pydata(mesh[0].tolist(), [], mesh[1].tolist())
        material = bpy.data.materials.new(name)
        material.diffuse_color = color
        data.materials.append(material)
        made = bpy.data.objects.new(name, data)
        made.pass_index = number
        scene.collection.objects.link(made)
        return made

    add("tissue", tissue(), [0.7, 0.3, 0.3, 1.0], 1)
    above = add("instrument", instrument(), [0.7, 0.7, 0.7, 1.0], 2)
    lens = bpy.data.cameras.new("camera")
    lens.sensor_width, lens.lens, lens.clip_end = 36.0, 36.0 * FOCAL, 1000.0
    scene.camera = bpy.data.objects.new("camera", lens)
    scene.camera.matrix_world = GL_FROM_CV.tolist()
    lamp = bpy.data.lights.new("lamp", "POINT")
    lamp.energy = 2e6
    for thing in (scene.camera, bpy.data.objects.new("lamp", lamp)):
        scene.collection.objects.link(thing)
    folder = Path(tempfile.mkdtemp())

    def draw(camera_from_instrument: np.ndarray) -> np.ndarray | None:
        from mathutils import Matrix

        above.matrix_world = Matrix(camera_from_instrument.tolist())
        scene.render.filepath = str(folder / "image.exr")
        bpy.ops.render.render(write_still=True)
        return None  # colour, depth and index are in the file

    return draw, f"Cycles, {SAMPLES} samples, denoised; image, depth and index into one EXR file"


RENDERERS: dict[str, Callable[[int, int], tuple[Draw, str]]] = {
    "pyrender": with_pyrender,
    "pybullet": with_pybullet,
    "mitsuba": with_mitsuba,
    "blender": with_blender,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("renderer", choices=RENDERERS)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--size", default="320x256")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    out = os.dup(1)
    os.dup2(2, 1)  # renderers print, too
    try:
        draw, how = RENDERERS[args.renderer](width, height)
    except ImportError as error:
        print(f"{args.renderer}: not installed in this Python ({error})", file=sys.stderr)
        return MISSING
    rng = np.random.default_rng(0)
    draw(pose(rng))
    covered, wall, cpu = [], time.perf_counter(), time.process_time()
    for _ in range(args.count):
        mask = draw(pose(rng))
        covered += [] if mask is None else [mask.mean()]
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    found = {"renderer": args.renderer, "how": how, "images_per_second": args.count / wall}
    found |= {"cpu_s_per_image": cpu / args.count, "instrument_share": float(np.mean(covered)) if covered else None}
    os.write(out, (json.dumps(found) + "\n").encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
