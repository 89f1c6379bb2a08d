#!/usr/bin/env bash
# safetensors 0.8.0: safetensors.numpy.save_file scrambles an array in Fortran order, such as a transpose `a.T`. The
# file has the right shape and the right numbers at wrong places; `save` does the same. safetensors 0.7.0 writes such
# arrays correctly, 0.8.0 does so with np.ascontiguousarray(array). No error, no warning on writing or on reading.
# Why: since 0.8.0 the buffer is written in memory order; readers assume C order. The docstring asks for "contiguous"
# tensors and does not say C order; save_file of safetensors.torch raises ValueError for a transpose.
# Reported upstream by others: github.com/safetensors/safetensors/issues/825.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
cat > check.py <<'PYTHON'
import sys

import numpy as np
import safetensors
from safetensors.numpy import load, load_file, save, save_file

array = np.arange(6.0).reshape(2, 3)
arrays = {
    "C order": array,
    "transpose": array.T,
    "Fortran order": np.asfortranarray(array),
    "transpose, made contiguous": np.ascontiguousarray(array.T),
}
print("safetensors", safetensors.__version__, "NumPy", np.__version__)
equal = {}
for name, values in arrays.items():
    save_file({"a": values}, "a.safetensors")
    read = load_file("a.safetensors")["a"]
    assert read.shape == values.shape
    assert (load(save({"a": values}))["a"] == read).all()
    equal[name] = bool((read == values).all())
    print(f"{name}: wrote {values.tolist()}, read {read.tolist()}")
wrong = {"transpose", "Fortran order"} if sys.argv[1] == "scrambled" else set()
assert equal == {name: name not in wrong for name in arrays}, f"behaviour has changed: {equal}"
PYTHON
venv/bin/pip install --quiet --disable-pip-version-check safetensors==0.7.0 numpy==2.4.6
venv/bin/python check.py correct
venv/bin/pip install --quiet --disable-pip-version-check safetensors==0.8.0 numpy==2.4.6
venv/bin/python check.py scrambled
echo "still so"
# Output of 2026-11-28, Python 3.11 on x86-64:
#   safetensors 0.7.0 NumPy 2.4.6
#   C order: wrote [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]], read [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
#   transpose: wrote [[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]], read [[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]]
#   Fortran order: wrote [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]], read [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
#   transpose, made contiguous: wrote [[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]], read [[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]]
#   safetensors 0.8.0 NumPy 2.4.6
#   C order: wrote [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]], read [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
#   transpose: wrote [[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]], read [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]
#   Fortran order: wrote [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]], read [[0.0, 3.0, 1.0], [4.0, 2.0, 5.0]]
#   transpose, made contiguous: wrote [[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]], read [[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]]
#   still so
