"""`neeco export`: a scene in one state, for other viewers of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast, get_args

import tyro

from neeco.base.errors import NeecoError
from neeco.base.settings import Device

Format = Literal["ply", "spz", "usdc", "glb"]


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Write a run's scene for other viewers, with the light of one camera: in one state, or animated (glb, usdc)."""

    run: tyro.conf.Positional[Path]
    """Run folder written by `neeco train`."""
    format: Format | None = None
    """ply; spz: a tenth of the size; glb (glTF); usdc (OpenUSD, extra usd). Default: by --output's suffix, else ply."""
    output: Path | None = None
    """File to write, .ply, .spz, .usdc or .glb. Default: scene.ply (or as --format) in the run folder."""
    frame: int = 0
    """Index of the training frame whose state and light are used."""
    states: Path | None = None
    """Use the first state of this states.jsonl (glb, usdc: all) instead, with its camera's light if it has one."""
    spz_version: Literal[3, 4] = 4
    """Version of SPZ: 4, or 3 for viewers without support for it."""
    unit: Literal["m", "cm", "mm"] = "m"
    """Unit of lengths in glb: m, as in glTF, or a smaller one for viewers with a distant near plane."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Write the file and print a summary of its content."""
    from neeco.base.files import write_atomically
    from neeco.cli._output import require_ending
    from neeco.raster.devices import device_of
    from neeco.training.run import open_gaussian_run
    from neeco.viewer import scene_files

    format = arguments.format or "ply"
    if arguments.output is not None:
        endings = [f".{ending}" for ending in (get_args(Format) if arguments.format is None else (format,))]
        require_ending("--output", arguments.output, *endings)
        if arguments.format is None and arguments.output.suffix:
            format = cast(Format, arguments.output.suffix[1:].lower())
    if arguments.spz_version != 4 and format != "spz":
        raise NeecoError("--spz-version: applies to spz only; remove it")
    if arguments.unit != "m" and format != "glb":
        raise NeecoError("--unit: applies to glb only; remove it")
    if format == "usdc":
        scene_files.require_usd()
    with open_gaussian_run(arguments.run, "export", device_of(arguments.device)) as trained:
        scene, frames = trained.scene, len(trained.scene.recorded.states)
        if not 0 <= arguments.frame < frames:
            raise NeecoError(f"--frame: must be from 0 to {frames - 1}, the training frames (got {arguments.frame})")
        state, camera = scene_files.exported_state(scene, arguments.frame, arguments.states)
        output = arguments.output or arguments.run / f"scene.{format}"
        if format == "glb" or format == "usdc":
            moving = scene_files.moving_scene(
                scene, scene_files.exported_states(scene, state, arguments.states), camera
            )
            if format == "glb":
                scene_files.write_glb(moving, camera, output, arguments.unit)
            else:
                scene_files.write_usd(moving, output)
            note = f"{len(moving.times)} states; {moving.blended:.0%} of the instruments' Gaussians blend links"
        else:
            note = "without joints and labels"
            splats = scene_files.splats_of(scene, state, camera)
            ply = format == "ply"
            data = scene_files.ply_bytes(splats) if ply else scene_files.spz_bytes(splats, arguments.spz_version)
            write_atomically(output, lambda temporary: temporary.write_bytes(data))
    print(f"{output}: {scene.num_gaussians:,} Gaussians, {output.stat().st_size / 1e6:.1f} MB, {note}")
    return 0
