"""The lens block of a capture's transforms.json (and of a scene's header), which `Lens.to_json` writes."""

from __future__ import annotations

from neeco.capture.documents import Node
from neeco.errors import NeecoError
from neeco.geometry.camera import COEFFICIENTS
from neeco.geometry.lens import BORDER, COEFFICIENT_NAMES, INTRINSICS, Border, Lens
from neeco.plausible import focal_fault, size_fault

MOST_PX = 65_536.0  # no image is as large
MOST_BENT = 1e6  # nor any coefficient of a lens


def parse_lens(node: Node) -> Lens | None:
    """The lens that a node describes; None, and reported, where that is none."""
    if not node.is_object():
        return None
    size = [node.child(key).integer(least=1) for key in ("w", "h")]
    focal = [node.child(key).number(above=0, below=MOST_PX) for key in INTRINSICS[:2]]
    center = [node.child(key).number(above=-MOST_PX, below=MOST_PX) for key in INTRINSICS[2:]]
    border = _border(node.child("border")) if node.has("border") else None
    distortion = _distortion(node)
    width, height = size
    fl_x, fl_y, cx, cy = *focal, *center
    if width is None or height is None or fl_x is None or fl_y is None or cx is None or cy is None:
        return None
    if distortion is None or (border is None and node.has("border")):
        return None
    if (fault := size_fault(width, height) or focal_fault(fl_x, fl_y, width, height)) is not None:
        node.error(*fault)
        return None
    lens = Lens(fl_x, fl_y, cx, cy, distortion, (width, height), border)
    try:
        lens.pinhole((width, height))
    except NeecoError as error:
        node.error_from(NeecoError(str(error).removeprefix("lens: ")))
        return None
    return lens


def _distortion(node: Node) -> tuple[float, ...] | None:
    """The coefficients up to the last that is given, as many as one of OpenCV's models has."""
    given = [node.has(name) for name in COEFFICIENT_NAMES]
    last = len(given) - given[::-1].index(True) if any(given) else 0
    names = COEFFICIENT_NAMES[: min(count for count in COEFFICIENTS if count >= last)]
    read = [node.child(name).number(above=-MOST_BENT, below=MOST_BENT) if node.has(name) else 0.0 for name in names]
    known = tuple(value for value in read if value is not None)
    return known if len(known) == len(read) else None


def _border(node: Node) -> Border | None:
    if not node.is_object():
        return None
    x, y = (node.child(key).number(above=-MOST_PX, below=MOST_PX) for key in BORDER[:2])
    radius = node.child(BORDER[2]).number(above=1, below=MOST_PX)
    return None if x is None or y is None or radius is None else (x, y, radius)
