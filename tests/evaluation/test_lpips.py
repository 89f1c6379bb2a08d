"""LPIPS: its published check values where the weights are at hand; its errors everywhere."""

import os
from pathlib import Path

import pytest
import torch
from image_files import read_image
from safetensors.torch import save_file

from neeco.base.errors import NeecoError
from neeco.evaluation.image_metrics import NETWORKS, Lpips, find_lpips, load_lpips

WEIGHTS = os.environ.get("NEECO_LPIPS_WEIGHTS", "")
needs_weights = pytest.mark.skipif(not WEIGHTS, reason="NEECO_LPIPS_WEIGHTS names no weights")


@needs_weights
@pytest.mark.parametrize(
    ("network", "other", "expected"),
    [("alexnet", "p0", 0.7219), ("alexnet", "p1", 0.1376), ("vgg16", "p0", 0.5686), ("vgg16", "p1", 0.4217)],
)
def test_the_authors_example_images_have_the_authors_distances(network, other, expected):
    folder = Path(WEIGHTS)
    images = [read_image(folder / f"ex_{name}.png") for name in ("ref", other)]
    assert distance(find_lpips(folder)[network], images[1], images[0]) == pytest.approx(expected, abs=1e-4)


def distance(network: Lpips, image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    if mask is not None:
        image = torch.where(mask[..., None], image, target)
    return network.between(network.features(image), network.features(target), mask)


def random_alexnet() -> Lpips:
    random = torch.Generator().manual_seed(0)
    weights, channels = {}, 3
    for index, layer in enumerate(NETWORKS["alexnet"]):
        shape = (8, channels, layer.kernel, layer.kernel)
        weights[f"features.{index}.weight"] = torch.randn(shape, generator=random) * 0.1
        weights[f"features.{index}.bias"] = torch.randn(8, generator=random) * 0.1
        weights[f"linear.{index}.weight"] = torch.rand(8, generator=random)
        channels = 8
    return Lpips(NETWORKS["alexnet"], weights)


def test_a_full_mask_changes_nothing_and_ignored_pixels_do_not_count():
    network, random = random_alexnet(), torch.Generator().manual_seed(1)
    target = torch.rand(64, 64, 3, generator=random)
    image = torch.rand(64, 64, 3, generator=random)
    everywhere = torch.ones(64, 64, dtype=torch.bool)
    # a mean and a weighted mean of at most 15 x 15 cells: each sum of n float32 is right to n * 6e-8
    assert distance(network, image, target, everywhere) == pytest.approx(distance(network, image, target), rel=5e-5)
    left = everywhere.clone()
    left[:, 32:] = False
    changed = image.clone()
    changed[:, 32:] = 0
    assert distance(network, changed, target, left) == distance(network, image, target, left)
    assert distance(network, target, target) == 0.0


def test_no_folder_means_no_networks_but_a_wrong_folder_is_an_error(tmp_path, environment):
    assert find_lpips(None) == {}
    with pytest.raises(NeecoError, match="no such folder"):
        find_lpips(tmp_path / "nowhere")
    with pytest.raises(NeecoError, match="holds neither"):
        find_lpips(tmp_path)
    environment["NEECO_LPIPS_WEIGHTS"] = str(tmp_path / "nowhere")
    with pytest.raises(NeecoError, match="NEECO_LPIPS_WEIGHTS"):
        find_lpips(None)


def test_damaged_or_foreign_weights_are_refused(tmp_path):
    path = tmp_path / "alexnet.safetensors"
    path.write_bytes(b"not tensors")
    with pytest.raises(NeecoError, match="not a readable safetensors"):
        load_lpips(path, "alexnet")
    save_file({"features.0.weight": torch.zeros(4, 3, 3, 3)}, path)
    with pytest.raises(NeecoError, match=r"features\.0"):
        load_lpips(path, "alexnet")
