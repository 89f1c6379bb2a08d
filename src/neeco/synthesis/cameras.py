"""The cameras that render images: the recorded ones at the requested size, with the recording's lens on request."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from neeco.base.errors import NeecoError
from neeco.geometry.camera import Camera
from neeco.geometry.lens import Lens
from neeco.scene.drawable import Recorded
from neeco.synthesis.settings import RECORDED_SIZE, ImageSettings, SizeSettings


@dataclass(frozen=True)
class DrawnCameras:
    """Maps cameras with recorded intrinsics to those that render. `lens`: the recording's, where distortion is
    wanted."""

    size: SizeSettings
    lens: Lens | None = None

    @classmethod
    def of(cls, images: ImageSettings, recorded: Recorded, cameras: Iterable[Camera]) -> DrawnCameras:
        """Return the cameras that `images` request. Raises NeecoError for invalid settings, a recording without a lens,
        and a camera among `cameras` whose images have another shape."""
        images.check()
        if images.lens and recorded.lens is None:
            raise NeecoError(
                "--lens: the scene's capture does not tell of its lens; ingest the recording again and train on it, or "
                "leave --lens out"
            )
        found = cls(images, recorded.lens if images.lens else None)
        for camera in cameras:
            found(camera)
        return found

    def __call__(self, camera: Camera) -> Camera:
        """The camera in the place of `camera`, a pinhole."""
        seen = camera if self.lens is None else self.lens.distorted_camera(camera)
        size = self.size.of(seen.width, seen.height)
        return seen if size == (seen.width, seen.height) else seen.resized(*size)


RECORDED_CAMERAS = DrawnCameras(RECORDED_SIZE)
