"""Launches the kernels that pose bodies, and their gradient's: the native `Posing`, for CUDA devices."""

from collections.abc import Sequence

import torch
import triton
from torch import Tensor

from neeco.raster.triton.posing import BODY, HINGE, pose_kernel
from neeco.raster.triton.posing_backward import pose_backward_kernel, pose_sums_kernel
from neeco.raster.triton.ready import working_on

BLOCK = 128  # Gaussians per program


class Posing:
    """Bodies that follow each other in the rows, `counts` long; where a body's numbers are None it stands still. All
    tensors are float32, contiguous and on one device."""

    def __init__(
        self,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        logits: Tensor | None,
        counts: Sequence[int],
        numbers: Sequence[Tensor | None],
        rolls: Sequence[float],
    ) -> None:
        self.given = (means, quats, log_scales, logits)
        self.columns = 0 if logits is None else logits.shape[1]
        starts = [sum(counts[:body]) for body in range(len(counts))]
        self.bodies = list(zip(starts, counts, numbers, rolls, strict=True))

    def forward(self, means: Tensor, quats: Tensor, scales: Tensor, frames: Tensor) -> None:
        """Write what is posed."""
        with working_on(means.device):
            for start, count, numbers, roll in self.bodies:
                if count:
                    pose_kernel[(triton.cdiv(count, BLOCK),)](
                        *self.given, numbers, roll, means, quats, scales, frames, start, count,
                        **self._how(numbers, roll),
                    )  # fmt: skip

    def backward(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        to_means: Tensor,
        to_quats: Tensor,
        to_log_scales: Tensor,
        to_logits: Tensor | None,
        to_numbers: Sequence[Tensor | None],
    ) -> None:
        """Write gradients of what was given, zeros before, from those of means, quats and scales."""
        with working_on(means.device):
            for (start, count, numbers, roll), to in zip(self.bodies, to_numbers, strict=True):
                if not count:
                    continue
                programs = triton.cdiv(count, BLOCK)
                sums = None if numbers is None else torch.zeros(programs, len(numbers), device=means.device)
                pose_backward_kernel[(programs,)](
                    *self.given, numbers, roll, means, quats, scales, to_means, to_quats, to_log_scales, to_logits,
                    sums, start, count, **self._how(numbers, roll),
                )  # fmt: skip
                if numbers is not None:
                    width = len(numbers)
                    pose_sums_kernel[(1,)](
                        sums,
                        numbers,
                        to,
                        programs,
                        WIDTH=width,
                        PADDED=triton.next_power_of_2(width),
                        num_warps=1,
                        enable_fp_fusion=True,
                    )

    def _how(self, numbers: Tensor | None, roll: float) -> dict[str, int | bool]:
        joints = 0 if numbers is None else (len(numbers) - BODY.value) // HINGE.value
        return {
            "SPINS": numbers is not None and roll != 0,
            "JOINTS": joints,
            "LOGITS": self.columns,
            "BLOCK": BLOCK,
            "num_warps": 4,
            "enable_fp_fusion": True,
        }
