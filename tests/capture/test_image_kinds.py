"""Only PNG and JPEG are opened as images, whatever their names say."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from image_files import read_image
from PIL import Image, ImageFile

from neeco.base.errors import NeecoError
from neeco.capture.images import has_alpha, image_size, open_image, read_mask
from neeco.ingest.readers.video import open_images
from neeco.synthesis.card import preview_figure

PREVIEWED = {"index": 0, "split": "train", "width": 4, "height": 4, "labels": [], "instruments": []}
READERS: list[Callable[[Path], object]] = [
    open_image,
    image_size,
    has_alpha,
    read_image,
    read_mask,
    lambda path: preview_figure(path.parent, [PREVIEWED | {"image": path.name}], []),
]


@pytest.fixture
def calls() -> Iterator[list[str]]:
    """The calls of a decoder that does nothing but to log them, in place of those that start other programs."""
    found: list[str] = []

    class StandIn(ImageFile.ImageFile):
        format = "STANDIN"

        def _open(self) -> None:
            found.append("opened")
            self._size, self._mode = (4, 4), "RGB"

    def accept(start: bytes) -> bool:
        return start.startswith(b"STANDIN")

    Image.init()
    Image.register_open(StandIn.format, StandIn, accept)
    yield found
    Image.ID.remove(StandIn.format)
    del Image.OPEN[StandIn.format]


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("kind", ["STANDIN", "GIF", "BMP", "TIFF", "WEBP", "PPM"])
def test_other_kinds_under_the_name_of_a_png_reach_no_decoder(kind, read, tmp_path, calls):
    path = tmp_path / "a.png"
    if kind == "STANDIN":
        path.write_bytes(b"STANDIN" + bytes(100))
    else:
        Image.new("RGB", (4, 4)).save(path, kind)
    with pytest.raises(NeecoError, match=r"a\.png: not an image file that is read; expected PNG or JPEG"):
        read(path)
    assert calls == []


def test_a_jpeg_that_is_named_png_is_read(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png", "JPEG")
    assert read_image(tmp_path / "a.png").shape == (4, 4, 3)


def test_a_folder_of_a_recording_may_hold_further_kinds_under_their_own_names(tmp_path: Path, calls: list[str]) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (6, 8, 3), np.uint8)
    for number, (name, kind) in enumerate({"bmp": "BMP", "tif": "TIFF", "webp": "WEBP", "png": "PNG"}.items()):
        Image.fromarray(pixels).save(tmp_path / f"{number}.{name}", kind)
    Image.fromarray(pixels).save(tmp_path / "4.png", "GIF")
    source = open_images(tmp_path, fps=10)
    assert len(source.times) == 4
    assert source.notes == (f"{tmp_path.name}: 1 images cannot be read and are left out (4.png)",)
    (tmp_path / "2.webp").write_bytes(b"STANDIN" + bytes(100))
    with pytest.raises(NeecoError, match="can no longer be read"):
        list(source.read([2]))
    assert calls == []
