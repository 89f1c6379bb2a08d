"""`dfine`: a small D-FINE (Peng et al., "D-FINE: redefine regression task in DETRs as fine-grained distribution
refinement", ICLR 2025), as implemented in transformers."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from neeco.base.errors import install_hint
from neeco.studies.downstream.model import TorchModel
from neeco.studies.downstream.results import Detections, Prediction
from neeco.studies.downstream.training_data import Batch

STRIDES = (16, 32)  # px, strides of the backbone's last two stages, the detection levels


class DFine(TorchModel):
    """Detects a box for each class of each instrument."""

    model = "dfine"
    predicts = "boxes"
    image_size = 160
    multiple = 32
    steps = 3200
    batch = 2  # small, because more steps on the same number of images learn more
    learning_rate = 8e-4
    stages = (64, 256, 512, 1024)  # channels of the backbone's stages
    width = 128  # channels of encoder and decoder
    queries = 20  # boxes per image

    @classmethod
    def missing_requirement(cls) -> str | None:
        absent = [name for name in ("transformers", "pycocotools") if importlib.util.find_spec(name) is None]
        return f"needs {' and '.join(absent)}; {install_hint('downstream')}" if absent else None

    @classmethod
    def is_too_small(cls, size: tuple[int, int]) -> bool:
        """Queries are initialised at the cells of the two levels, which must be at least as many."""
        return sum((size[0] // stride) * (size[1] // stride) for stride in STRIDES) < cls.queries

    def build(self, classes: int) -> nn.Module:
        from transformers import DFineConfig, DFineForObjectDetection
        from transformers.models.hgnet_v2 import HGNetV2Config

        backbone = HGNetV2Config(  # type: ignore[call-arg]
            stem_channels=[3, 16, 16],
            stage_in_channels=[16, *self.stages[:3]],
            stage_mid_channels=[16, 32, 64, 128],
            stage_out_channels=list(self.stages),
            stage_num_blocks=[1, 1, 2, 1],
            stage_numb_of_layers=[3, 3, 3, 3],
            stage_downsample=[False, True, True, True],
            stage_light_block=[False, False, True, True],
            stage_kernel_size=[3, 3, 5, 5],
            out_features=["stage3", "stage4"],
            hidden_sizes=list(self.stages),
            depths=[3, 4, 6, 3],
            embedding_size=32,
            use_learnable_affine_block=True,
        )
        config = DFineConfig(  # type: ignore[call-arg]
            backbone_config=backbone,
            freeze_backbone_batch_norms=False,
            num_labels=classes,
            encoder_in_channels=list(self.stages[2:]),
            feat_strides=list(STRIDES),
            num_feature_levels=2,
            encode_proj_layers=[1],
            encoder_hidden_dim=self.width,
            d_model=self.width,
            decoder_in_channels=[self.width, self.width],
            encoder_ffn_dim=4 * self.width,
            decoder_ffn_dim=4 * self.width,
            decoder_layers=3,
            num_queries=self.queries,
            decoder_n_points=[6, 6],
            num_denoising=20,
            hidden_expansion=0.34,
            depth_mult=0.5,
        )
        return DFineForObjectDetection(config)

    def loss(self, module: Any, batch: Batch) -> Tensor:
        device = batch.images.device
        labels = [  # in the format of transformers
            {
                "class_labels": torch.from_numpy(classes - 1).to(device),
                "boxes": torch.from_numpy(boxes.astype(np.float32)).to(device),
            }
            for boxes, classes in batch.boxes()
        ]
        return module(pixel_values=batch.images, labels=labels).loss

    def predictions(self, module: Any, images: Tensor, sizes: Sequence[tuple[int, int]]) -> list[Prediction]:
        output = module(pixel_values=images)
        scores = output.logits.sigmoid().float().cpu().numpy()  # [B, Q, C]
        boxes = output.pred_boxes.float().cpu().numpy()  # [B, Q, 4] centre and size in [0, 1]
        detections: list[Prediction] = []
        for score, box, (height, width) in zip(scores, boxes, sizes, strict=True):
            corners = np.concatenate([box[:, :2] - box[:, 2:] / 2, box[:, :2] + box[:, 2:] / 2], 1)
            corners = corners.clip(0, 1) * np.array([width, height, width, height])
            queries, classes = np.unravel_index(np.argsort(-score, axis=None, kind="stable"), score.shape)
            detections.append(Detections(corners[queries].astype(np.float64), classes + 1, score[queries, classes]))
        return detections
