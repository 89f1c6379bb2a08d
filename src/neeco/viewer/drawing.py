"""One run's part of a browser's window: its picture, and what is to be said about it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from neeco.raster.devices import readable_failures
from neeco.raster.types import Camera
from neeco.viewer.source import Loaded
from neeco.viewer.status import Shown
from neeco.viewer.steering import Wishes, counterpart, steered_state
from neeco.viewer.studio import Studio
from neeco.viewer.views import DIFFERENCE, IMAGE, Picture, difference, dimmed, picture, views_of
from neeco.viewer.window import carried_over, stands_at

ONLY_RECORDED = "difference: only of a recorded state seen by its camera; press “go to this frame's camera”"


@dataclass(frozen=True)
class Drawn:
    """A run's part of the window."""

    shown: Shown
    picture: Picture
    frame: int | None  # whose state and camera these are just as recorded
    said: str = ""


def draw_run(studio: Studio, number: int, wishes: Wishes, camera: Camera, stood_at: int, view: str) -> Drawn:
    """Draw run `number` as the wishes, made for the first run, say and `camera` sees it. Raises NeecoError.

    A run of another capture has a world of its own: there the camera has gone, from the frame that belongs to
    `stood_at`, the way that `camera` went from that frame.
    """
    loaded = studio.loaded[number]
    wishes, camera = _there(studio, loaded, wishes, camera, stood_at)
    state = steered_state(loaded.recorded.states, loaded.shafts, wishes)
    frame = wishes.recorded_frame
    seen = frame is not None and stands_at(camera, loaded.recorded.cameras[frame], loaded.distance)
    said = ""
    with loaded.scene.torch_threads(), readable_failures():
        if view == DIFFERENCE and frame is not None and seen and loaded.frames:
            photograph = studio.photograph(number, loaded, frame)
            shown = difference(loaded.scene, state, loaded.recorded.cameras[frame], photograph, camera)
        elif view == DIFFERENCE:
            shown, said = dimmed(picture(loaded.scene, state, camera, IMAGE)), ONLY_RECORDED
        elif view not in views_of(loaded.scene, bool(loaded.frames)):
            shown = dimmed(picture(loaded.scene, state, camera, IMAGE))
            said = f"{view}: a scene of method {loaded.scene.method} has none"
        else:
            shown = picture(loaded.scene, state, camera, view, loaded.labels)
    trouble = studio.sources[number].trouble or loaded.trouble
    shows = Shown(loaded, wishes.frame, frame is not None, trouble=trouble)
    return Drawn(shows, shown, frame if seen else None, said or shown.said)


def _there(studio: Studio, loaded: Loaded, wishes: Wishes, camera: Camera, stood_at: int) -> tuple[Wishes, Camera]:
    """Wishes and camera, made for the first run, for another."""
    first = studio.loaded[0]
    frames = len(first.recorded.states), len(loaded.recorded.states)
    wishes = replace(wishes, frame=counterpart(wishes.frame, *frames))
    if loaded.world == first.world:
        return wishes, camera
    # a place in the first run's world means nothing in this one
    unplaced = {name: replace(item, pose=None) for name, item in wishes.instruments.items()}
    start = loaded.recorded.cameras[int(counterpart(stood_at, *frames))]
    scale = loaded.distance / first.distance
    return replace(wishes, instruments=unplaced), carried_over(camera, first.recorded.cameras[stood_at], start, scale)


def scored(studio: Studio, number: int, drawn: Drawn) -> Shown:
    """What is shown of run `number`, with its score where there is one. Raises NeecoError."""
    if drawn.frame is None:
        return drawn.shown
    loaded = drawn.shown.loaded
    with loaded.scene.torch_threads():
        return replace(drawn.shown, score=studio.score(number, loaded, drawn.frame))
