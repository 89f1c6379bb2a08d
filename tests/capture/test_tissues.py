"""A capture has one tissue; one that lists several is refused in a line, by every reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from capture_folders import Folder

from neeco.base.errors import NeecoError
from neeco.capture import check_capture, read_capture
from neeco.ingest.convert import convert_folder

ADVICE = "make one capture for each tissue, train each, and mix with `neeco synthesize --tissue RUN`"


@pytest.mark.parametrize("read", [read_capture, lambda path: convert_folder(path, path.parent / "converted")])
def test_a_capture_of_several_tissues_is_refused_in_one_line(folder: Folder, read: Callable[[Path], Any]) -> None:
    def name_tissues(document: dict[str, Any]) -> None:
        document["tissues"] = [{"name": "bowel", "ply_file_path": document.pop("ply_file_path")}, {"name": "stomach"}]
        for number, frame in enumerate(document["frames"]):
            frame["tissue"] = ("bowel", "stomach")[number % 2]

    folder.edit(name_tissues)
    assert [str(problem) for problem in check_capture(folder.root)] == [
        f"transforms.json: tissues: a capture has one tissue; {ADVICE}"
    ]
    with pytest.raises(NeecoError) as caught:
        read(folder.root)
    assert str(caught.value) == f"{folder.root}: transforms.json: tissues: a capture has one tissue; {ADVICE}"
