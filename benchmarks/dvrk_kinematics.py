"""State the links of the da Vinci arms of a capture whose poses are those of `measured_cp`, as the dVRK logs them.

The wrist's joints are recorded as wrist_pitch_rad and wrist_yaw_rad; how far the jaws are open is not, and is found
from the images.

    python benchmarks/dvrk_kinematics.py CAPTURE OUTPUT TOOL.json [--transforms transforms_registered.json]

TOOL.json: the instrument's file in the dVRK's share/tool, such as LARGE_NEEDLE_DRIVER_400006.json.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace
from pathlib import Path

from neeco.capture import read_capture, write_capture
from neeco.capture.checks.truth import REFERENCE_FOLDER
from neeco.capture.readers import read_dvrk_tool

JAW_LIMITS = (0.0, 1.2)  # rad


def main() -> None:
    """Read, state the links, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("tool", type=Path)
    parser.add_argument("--transforms", default="transforms.json")
    given = parser.parse_args()
    tree = read_dvrk_tool(given.tool, {"wrist_pitch": "wrist_pitch_rad", "wrist_yaw": "wrist_yaw_rad"})
    capture = read_capture(given.capture, given.transforms)
    missing = dict.fromkeys(set(tree.readings) - set(capture.instruments[0].joints), JAW_LIMITS)
    instruments = tuple(
        replace(item, joints={**item.joints, **missing}, kinematics=tree, unrecorded=tuple(missing))
        for item in capture.instruments
    )
    write_capture(replace(capture, instruments=instruments), given.output)
    references = given.capture / REFERENCE_FOLDER
    if references.is_dir():  # hand-made masks that `neeco evaluate` scores against
        shutil.copytree(references, given.output / REFERENCE_FOLDER, dirs_exist_ok=True)


if __name__ == "__main__":
    main()
