#!/usr/bin/env bash
# @playcanvas/splat-transform 2.7.1 and 3.7.0 (npm): one SPZ file becomes PLY files that stand half a turn apart.
#
# SPZ's documentation fixes its axes (right, up, back); PLY files of Gaussians are right, down, front by custom.
# Expected: every version of a converter writes the same PLY of one SPZ. Seen: 2.7.1 turns the scene by 180 degrees
# about x on the way, so that the PLY overlays those of training code; 3.7.0 copies the numbers as they are, and the
# scene stands on its head beside the PLY that the SPZ was made of. Neither says so.
# Exit status 0: as described. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
# SPZ version 3, by its published layout: one opaque grey Gaussian at (1, 2, 3), unrotated
python3 - <<'PY'
import gzip, struct
header = struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 0, 12, 0, 0)
position = b"".join((value << 12).to_bytes(3, "little") for value in (1, 2, 3))
rotation = struct.pack("<I", 3 << 30)  # the largest component is the fourth, the others are 0
body = position + bytes([255]) + bytes([128] * 3) + bytes([160] * 3) + rotation
open("one.spz", "wb").write(gzip.compress(header + body, mtime=0))
PY
convert() { node_modules/.bin/splat-transform -w one.spz "$1" > log 2>&1 || { cat log; exit 1; }; }
npm install --silent --no-fund --no-audit @playcanvas/splat-transform@2.7.1
convert 2.7.1.ply
npm install --silent --no-fund --no-audit @playcanvas/splat-transform@3.7.0
convert 3.7.0.ply
python3 - <<'PY'
import struct, sys
found = {}
for version in ("2.7.1", "3.7.0"):
    data = open(f"{version}.ply", "rb").read()
    start = data.index(b"end_header\n") + 11
    names = [line.split()[2] for line in data[:start].decode().splitlines() if line.startswith("property float")]
    values = dict(zip(names, struct.unpack_from(f"<{len(names)}f", data, start)))
    found[version] = [round(values[axis], 3) for axis in "xyz"]
    print(version, found[version])
same = found == {"2.7.1": [1.0, -2.0, -3.0], "3.7.0": [1.0, 2.0, 3.0]}
print("as described" if same else "it has changed")
sys.exit(not same)
PY
# Output of 2026-11-30:
#   2.7.1 [1.0, -2.0, -3.0]
#   3.7.0 [1.0, 2.0, 3.0]
#   as described
