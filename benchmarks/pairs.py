"""The next operation of a random world: its instrument before the tissue, lamps, camera and path of another world.

    python benchmarks/pairs.py FIRST SECOND FOLDER

FIRST, SECOND: seeds of worlds (`worlds.py` draws and trains the first). FOLDER becomes a capture of 46 frames with
truth, by a moving scope; FOLDER/plates are 24 images without the instrument. Then:

    neeco adapt RUN_OF_FIRST FOLDER --backgrounds FOLDER/plates --output SET
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from rendered.draws import World, draw_world
from rendered.exposure import meter
from rendered.frames import Renderer, Settings
from rendered.render import draw, view_of
from rendered.world_capture import visible_scene, write_world

OF_INSTRUMENT = ("kind", "radius", "finish", "gloss", "rings", "jaws", "moving_jaws", "joints", "size", "links")
FRAMES, PLATES = 30, 24
AWAY_MM = 2000.0  # where the instrument is while plates are rendered


def next_world(first: int, second: int) -> World:
    """The world of `second` with the instrument of `first`, exact states and a moving scope."""
    instrument = {name: getattr(draw_world(first), name) for name in OF_INSTRUMENT}
    exact = {"states": "exact", "wrong": 0.0, "stated": False, "base": 0.0, "frame_off": 0.0}
    return replace(draw_world(second), **instrument, **exact, scope="moving", frames=FRAMES, scale=1.0)


def write_plates(world: World, folder: Path) -> None:
    """Render images without the instrument, at other moments than the frames."""
    place = world.place()
    spec, shots, trajectory = visible_scene(world, place)
    gains = np.array(world.processor.gains)
    if world.automatic:
        times = np.array([shot.time for shot in shots])
        gains = gains * np.array(meter(place, replace(trajectory, times=times)).of(0))
    renderer = Renderer(spec, Settings(world.lens, processor=world.processor), folder, place, {})
    free = sorted({*range(len(trajectory.times))} - {shot.number for shot in shots})
    folder.mkdir(exist_ok=True)
    for place_in_list in np.linspace(0, len(free) - 1, PLATES).round().astype(int):
        number = free[place_in_list]
        moment = trajectory.at(float(trajectory.times[number]))
        away = moment.scene_from_mechanical.copy()
        away[2, 3] += AWAY_MM
        red, green, blue = map(float, gains)
        color = draw(place, view_of(replace(moment, scene_from_mechanical=away)), (red, green, blue)).color
        pixels = renderer.stored(color, np.random.default_rng((1, number)))
        Image.fromarray(pixels).save(folder / f"{number:06d}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int)
    parser.add_argument("second", type=int)
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    world = next_world(arguments.first, arguments.second)
    write_world(world, arguments.folder)
    write_plates(world, arguments.folder / "plates")


if __name__ == "__main__":
    main()
