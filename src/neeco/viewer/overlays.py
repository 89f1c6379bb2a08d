"""What viser draws over the picture for one browser: recorded cameras, sparse points, gizmos."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from neeco.capture.model import evenly_spaced
from neeco.labels.drawing import to_numpy
from neeco.viewer.source import Loaded
from neeco.viewer.window import DISTANCE_UNITS, field_of_view, pose_of, wxyz_of

if TYPE_CHECKING:
    import viser

MOST_FRUSTA, MOST_POINTS = 24, 20_000
FRUSTUM_UNITS, GIZMO_UNITS, POINT_UNITS = 0.06 * DISTANCE_UNITS, 0.2 * DISTANCE_UNITS, 0.005 * DISTANCE_UNITS
COLOR = (255, 200, 0)


class Overlays:
    """Nodes are named by number: names of a run go into no path."""

    def __init__(
        self,
        client: viser.ClientHandle,
        loaded: Loaded,
        unit: float,
        clicked: Callable[[int], None],
        dragged: Callable[[], None],
    ) -> None:
        """clicked: told the frame whose camera was clicked on; dragged: called when a gizmo moved."""
        self._scene, self._unit, self._dragged = client.scene, unit, dragged
        self.cameras = self._scene.add_frame("/cameras", show_axes=False, visible=False)
        for frame in _apart(loaded):
            camera = loaded.recorded.cameras[frame]
            pose = to_numpy(camera.world_from_camera)
            frustum = self._scene.add_camera_frustum(
                f"/cameras/{frame}",
                fov=field_of_view(camera),
                aspect=camera.width / camera.height,
                scale=FRUSTUM_UNITS,
                thickness=1.5,
                thickness_units="screen",
                color=COLOR,
                wxyz=wxyz_of(pose),
                position=pose[:3, 3] * unit,
            )
            frustum.on_click(partial(_frame_clicked, clicked, frame))
        self.points = self._points(loaded)
        self._gizmos: dict[str, Any] = {}

    @property
    def shown(self) -> bool:
        """Is there anything that the picture's depth must hide or show?"""
        return bool(self.cameras.visible or (self.points is not None and self.points.visible) or self._gizmos)

    def show(self, cameras: bool, points: bool) -> None:
        """Which of them are to be seen."""
        for node, seen in ((self.cameras, cameras), (self.points, points)):
            if node is not None and node.visible != seen:
                node.visible = seen

    def grip(self, name: str, number: int, pose: np.ndarray) -> None:
        """Show the gizmo of an instrument that stands at `pose` [4, 4] mm."""
        gizmo = self._scene.add_transform_controls(
            f"/gizmos/{number}",
            scale=GIZMO_UNITS,
            wxyz=wxyz_of(pose),
            position=pose[:3, 3] * self._unit,
            depth_test=False,
        )
        gizmo.on_update(lambda _: self._dragged())
        self._gizmos[name] = gizmo

    def release(self, name: str) -> None:
        """Take an instrument's gizmo away."""
        gizmo = self._gizmos.pop(name, None)
        if gizmo is not None:
            gizmo.remove()

    def pose(self, name: str) -> np.ndarray | None:
        """Where an instrument's gizmo stands [4, 4] mm; None: it has none."""
        gizmo = self._gizmos.get(name)
        return None if gizmo is None else pose_of(gizmo.wxyz, gizmo.position, self._unit)

    def _points(self, loaded: Loaded) -> Any:
        if loaded.capture is None or not len(loaded.capture.points.positions):
            return None
        points = loaded.capture.points
        chosen = evenly_spaced(len(points.positions), MOST_POINTS)
        return self._scene.add_point_cloud(
            "/points",
            (points.positions[chosen] * self._unit).astype(np.float32),
            points.colors[chosen].astype(np.float32),
            point_size=POINT_UNITS,
            point_shape="circle",
            precision="float32",
            visible=False,
        )


def _frame_clicked(clicked: Callable[[int], None], frame: int, _: object) -> None:
    clicked(frame)


def _apart(loaded: Loaded) -> list[int]:
    """Frames whose cameras are shown: some from everywhere, none twice in one place."""
    chosen: dict[bytes, int] = {}
    for frame in evenly_spaced(len(loaded.recorded.cameras), MOST_FRUSTA):
        pose = to_numpy(loaded.recorded.cameras[frame].world_from_camera)
        chosen.setdefault(pose.round(3).tobytes(), frame)
    return list(chosen.values())
