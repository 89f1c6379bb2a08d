#!/usr/bin/env bash
# PyAV 18.1.0 (libavformat 62.12): frames of an AVI whose H.264 has B-frames are decoded in the right order, 0 1 2 3 ...,
# but their `pts` fall within every group: 1 4 3 5 2 8 7 9 6 ... Who sorts frames by time, or takes the frame nearest to
# a time, gets other frames than a player shows. ASF does the same; MP4 and Matroska of the same stream do not.
# Why: AVI and ASF hold no presentation times, so a frame's pts is the time at which its packet was to be decoded.
# No error, no warning. libx264 uses B-frames unless told otherwise, so `ffmpeg -c:v libx264 out.avi` makes such files.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check av==18.1.0 numpy==2.4.6
venv/bin/python - <<'PYTHON'
import av
import numpy as np


def write(name):
    """Write 30 frames at 25 frames/s; frame i is a plain grey of level 10 + 7 i, pts i."""
    with av.open(name, "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(30):
            pixels = np.full((48, 64, 3), 10 + 7 * number, np.uint8)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def read(name):
    """Return the numbers of the frames in the order of decoding, and their pts in frames."""
    with av.open(name) as container:
        frames = list(container.decode(video=0))
    numbers = [round((frame.to_ndarray(format="rgb24")[24, 32, 0] - 10) / 7) for frame in frames]
    return numbers, [round(float(frame.pts * frame.time_base) * 25) for frame in frames]


print("PyAV", av.__version__, "libavformat", av.library_versions["libavformat"])
fell = {}
for ending in ("avi", "asf", "mp4", "mkv"):
    write(f"x.{ending}")
    numbers, times = read(f"x.{ending}")
    print(f"{ending}: decoded {numbers[:9]} ..., pts {times[:9]} ...")
    assert numbers == list(range(30)), "frames are not decoded in their order"
    fell[ending] = times != sorted(times)
assert fell == {"avi": True, "asf": True, "mp4": False, "mkv": False}, f"behaviour has changed: {fell}"
PYTHON
echo "still so"
# Output of 2026-11-28, Python 3.11 on x86-64:
#   PyAV 18.1.0 libavformat (62, 12, 102)
#   avi: decoded [0, 1, 2, 3, 4, 5, 6, 7, 8] ..., pts [1, 4, 3, 5, 2, 8, 7, 9, 6] ...
#   asf: decoded [0, 1, 2, 3, 4, 5, 6, 7, 8] ..., pts [1, 4, 3, 5, 2, 8, 7, 9, 6] ...
#   mp4: decoded [0, 1, 2, 3, 4, 5, 6, 7, 8] ..., pts [0, 1, 2, 3, 4, 5, 6, 7, 8] ...
#   mkv: decoded [0, 1, 2, 3, 4, 5, 6, 7, 8] ..., pts [0, 1, 2, 3, 4, 5, 6, 7, 8] ...
#   still so
