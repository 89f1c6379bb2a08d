#!/usr/bin/env bash
# safetensors 0.8.0: the same tensors with the same metadata do not give the same file. The order of the entries of
# `metadata` is drawn anew by every process (a hash map of Rust), whatever PYTHONHASHSEED is, so bytes and checksums
# of the file differ; without metadata, or with one entry, they are equal. `save_model` writes one entry for each name
# that shares a tensor (tied weights), so models with two of them are not reproducible either. Reading is not affected.
# Work around: one metadata entry that holds all others as JSON text.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check safetensors==0.8.0 numpy==2.4.6
cat > write.py <<'PYTHON'
import hashlib
import json
import sys

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file

metadata = {f"key{number}": str(number) for number in range(int(sys.argv[1]))}
if sys.argv[2] == "joined":
    metadata = {"all": json.dumps(metadata)}
save_file({"a": np.arange(3.0)}, "a.safetensors", metadata=metadata or None)
with safe_open("a.safetensors", "numpy") as stream:
    assert (stream.metadata() or {}) == metadata
print(hashlib.sha256(open("a.safetensors", "rb").read()).hexdigest())
PYTHON
# eight processes each: how many different files
different() {
  for _ in 1 2 3 4 5 6 7 8; do PYTHONHASHSEED=0 venv/bin/python write.py "$@"; done | sort -u | wc -l
}
none=$(different 0 each); one=$(different 1 each); twelve=$(different 12 each); joined=$(different 12 joined)
echo "safetensors 0.8.0, different files of eight: no metadata $none, 1 entry $one, 12 entries $twelve, joined $joined"
[ "$none" = 1 ] && [ "$one" = 1 ] && [ "$joined" = 1 ] || { echo "files without or with one entry differ" >&2; exit 1; }
[ "$twelve" -gt 1 ] || { echo "behaviour has changed: metadata has one order" >&2; exit 1; }
# Output of 2026-11-28:
# safetensors 0.8.0, different files of eight: no metadata 1, 1 entry 1, 12 entries 8, joined 1
