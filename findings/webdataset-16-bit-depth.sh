#!/usr/bin/env bash
# webdataset 1.0.2 (Pillow 13.0.0): every image decoder turns a depth map of 16 bits into one constant, 255 (1.0 as
# float), wherever its counts exceed 255: "l8", "l", "rgb8", "rgb", "pil" and "pill" alike. The PNG in the shard is
# intact: Pillow itself reads its counts, 1000 to 5095. No error, no warning: a network learns depth from a white image.
# Why: the decoder converts each image to "L" or "RGB", and Pillow's conversion from 16 bits clips at 255 in place of
# scaling. Decode such members yourself: `.decode(wds.handle_extension("depth.png", function))`, before other handlers.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check webdataset==1.0.2 pillow==13.0.0 numpy==2.4.6 \
    braceexpand==0.1.7 PyYAML==6.0.4
venv/bin/python - <<'PYTHON'
import io
import tarfile
from importlib.metadata import version

import numpy as np
import webdataset
from PIL import Image

depth = np.arange(1000, 1000 + 64 * 64, dtype=np.uint16).reshape(64, 64)
png = io.BytesIO()
Image.fromarray(depth).save(png, "png")
with tarfile.open("shard.tar", "w") as shard:
    member = tarfile.TarInfo("000000.depth.png")
    member.size = len(png.getvalue())
    shard.addfile(member, io.BytesIO(png.getvalue()))


def sample(*handlers):
    return next(iter(webdataset.WebDataset("shard.tar", shardshuffle=False).decode(*handlers)))["depth.png"]


def own(data):
    return np.asarray(Image.open(io.BytesIO(data)))


print("webdataset", version("webdataset"), "Pillow", version("pillow"))
assert (own(png.getvalue()) == depth).all()
for decoder in ("l8", "l", "rgb8", "rgb", "pil", "pill"):
    pixels = np.asarray(sample(decoder))
    print(f"{decoder}: {pixels.dtype} {pixels.shape}, {pixels.min()} to {pixels.max()}")
    assert pixels.min() == pixels.max() == (1.0 if pixels.dtype == np.float32 else 255), "behaviour has changed"
pixels = sample(webdataset.handle_extension("depth.png", own), "rgb8")
print(f"own handler: {pixels.dtype} {pixels.shape}, {pixels.min()} to {pixels.max()}")
assert (pixels == depth).all()
PYTHON
echo "still so"
# Output of 2026-11-28, Python 3.11 on x86-64:
#   webdataset 1.0.2 Pillow 13.0.0
#   l8: uint8 (64, 64), 255 to 255
#   l: float32 (64, 64), 1.0 to 1.0
#   rgb8: uint8 (64, 64, 3), 255 to 255
#   rgb: float32 (64, 64, 3), 1.0 to 1.0
#   pil: uint8 (64, 64, 3), 255 to 255
#   pill: uint8 (64, 64), 255 to 255
#   own handler: uint16 (64, 64), 1000 to 5095
#   still so
