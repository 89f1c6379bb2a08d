"""Further formats, read back by the tools they are for or held against the rules they publish."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from ball_world import RADIUS, ball_scene, run_of
from PIL import Image
from rod_world import CAMERA, FakeRun

from neeco.raster.pinhole import project
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings

FORMATS = ("webdataset", "bop", "imagefolder")
COUNT = 6


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[FakeRun]:
    folder = tmp_path_factory.mktemp("runs")
    places = {"own": (0, 0, 50), "near": (-5, 0, 55), "far": (5, 1, 75)}
    return [run_of(ball_scene(name, [place, (place[0], 3, place[2])]), folder / name) for name, place in places.items()]


@pytest.fixture(scope="module")
def made(runs: list[FakeRun], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six images of two balls."""
    output = tmp_path_factory.mktemp("made") / "dataset"
    synthesize(runs[0], output, Settings(count=COUNT, tissue_tolerance_mm=2.0), FORMATS, instrument_runs=runs[1:])  # type: ignore[arg-type]
    return output


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def test_webdataset_reads_its_shards(made: Path) -> None:
    wds = pytest.importorskip("webdataset")
    assert {path.name for path in (made / "webdataset").iterdir()} == {"train-000000.tar", "val-000000.tar"}
    read = {}
    for split, count in (("train", 5), ("val", 1)):
        shards = wds.WebDataset(str(made / f"webdataset/{split}-000000.tar"), shardshuffle=False)
        samples = list(shards)
        assert len(samples) == count
        read |= {sample["__key__"]: sample for sample in samples}
    for key, sample in read.items():
        image = np.array(Image.open(io.BytesIO(sample["png"])))
        assert np.array_equal(image, pixels(made / f"images/{key}.png"))
        for ending, folder in (("mask.png", "masks"), ("depth.png", "depth")):
            assert np.array_equal(
                np.array(Image.open(io.BytesIO(sample[ending]))), pixels(made / f"{folder}/{key}.png")
            )
        record = json.loads(sample["json"])
        assert record["image"] == f"images/{key}.png"
        assert len(record["labels"]) == 2


def test_bop_keeps_to_its_published_rules(made: Path) -> None:
    assert json.loads((made / "bop/objects.json").read_text()) == {"1": "near", "2": "far"}
    seen = 0
    for split in ("train", "val"):
        scene = made / "bop" / split / "000000"
        cameras, poses, infos = (
            json.loads((scene / f"{name}.json").read_text()) for name in ("scene_camera", "scene_gt", "scene_gt_info")
        )
        assert cameras.keys() == poses.keys() == infos.keys()
        for key, camera in cameras.items():
            name = f"{int(key):06d}"
            assert np.array_equal(pixels(scene / f"rgb/{name}.png"), pixels(made / f"images/{name}.png"))
            depth = pixels(scene / f"depth/{name}.png") * camera["depth_scale"]  # mm
            assert depth.max() == pytest.approx(100.0, abs=3.0)
            assert camera["cam_K"] == [60.0, 0.0, 32.0, 0.0, 60.0, 24.0, 0.0, 0.0, 1.0]
            assert np.allclose(np.reshape(camera["cam_R_w2c"], (3, 3)), np.eye(3))
            for place, (pose, info) in enumerate(zip(poses[key], infos[key], strict=True)):
                assert pose["obj_id"] in (1, 2)
                whole, visible = (
                    pixels(scene / f"{kind}/{name}_{place:06d}.png") > 0 for kind in ("mask", "mask_visib")
                )
                assert not bool((visible & ~whole).any())
                assert info["px_count_all"] == whole.sum() >= info["px_count_visib"] == visible.sum()
                assert info["visib_fract"] == pytest.approx(visible.sum() / whole.sum(), abs=1e-5)
                x, y, width, height = info["bbox_obj"]
                rows, columns = np.nonzero(whole)
                assert (x, y, x + width - 1, y + height - 1) == (
                    columns.min(), rows.min(), columns.max(), rows.max(),
                )  # fmt: skip
                middle = np.array(pose["cam_t_m2c"])  # the ball's: its silhouette is round it
                at = project(middle, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
                if x > 4 and x + width < 60 and y > 4 and y + height < 44:
                    assert at == pytest.approx((x + width / 2, y + height / 2), abs=1.5)
                    assert width == pytest.approx(2 * RADIUS / middle[2] * CAMERA.fx, abs=3)
                    seen += 1
    assert seen >= 4


def test_imagefolder_has_a_line_for_every_image_and_mask(made: Path) -> None:
    found = 0
    for split in ("train", "validation"):
        folder = made / "imagefolder" / split
        for text in (folder / "metadata.jsonl").read_text().splitlines():
            line = json.loads(text)
            mask = pixels(folder / line["mask_file_name"]) > 0
            assert pixels(folder / line["file_name"]).shape == (48, 64, 3)
            objects = line["objects"]
            assert len({len(values) for values in objects.values()}) == 1
            assert mask.sum() == sum(objects["area"])
            for (x, y, width, height), name in zip(objects["bbox"], objects["name"], strict=True):
                assert name == ("near", "far")[objects["category"][objects["name"].index(name)]]
                assert mask[y : y + height, x : x + width].any()
            found += 1
    assert found == COUNT


def test_a_format_can_be_added_later(made: Path, runs: list[FakeRun], tmp_path: Path) -> None:
    output = tmp_path / "set"
    settings = Settings(count=COUNT, tissue_tolerance_mm=2.0)
    synthesize(runs[0], output, settings, ("coco",), instrument_runs=runs[1:])  # type: ignore[arg-type]
    again = synthesize(runs[0], output, settings, FORMATS, resume=True, instrument_runs=runs[1:])  # type: ignore[arg-type]
    assert again.made_now == 0
    for name in FORMATS:
        files = [path.relative_to(made) for path in (made / name).rglob("*") if path.is_file()]
        assert files
        assert all((made / file).read_bytes() == (output / file).read_bytes() for file in files)
