"""The kernels of the triton backend: Triton, for CUDA devices, and on the CPU under Triton's interpreter for tests.

Stages: project (`project.py`), lists per tile (`binning.py`), blend (`composite.py`), and the gradients of blending and
of projecting. `raster/triton_backend.py` chains them. Training has two more, the loss and Adam (`photometric.py`).
Importing a module here imports the package `triton`; `ready.py` does not.
"""
