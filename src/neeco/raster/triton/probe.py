"""A minimal kernel, to test whether kernels run."""

import torch
import triton
import triton.language as tl


@triton.jit
def probe_kernel(out):
    tl.store(out, 1.0)


def launch(device: torch.device) -> None:
    """Compile the kernel and run it on a CUDA device."""
    with torch.cuda.device(device):
        probe_kernel[(1,)](torch.empty(1, device=device), num_warps=1, enable_fp_fusion=True)
