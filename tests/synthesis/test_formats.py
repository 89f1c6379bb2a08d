"""Further formats, read back by the tools they are for or held against the rules they publish."""

from __future__ import annotations

import importlib.util
import io
import json
import shutil
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from ball_world import RADIUS, at, ball_scene, run_of
from PIL import Image
from rod_world import CAMERA, FakeRun

from neeco.base.errors import NeecoError
from neeco.geometry.projection import project
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings

FORMATS = ("webdataset", "bop", "imagefolder", "coco", "yolo")
READ_BACK = Path(__file__).parents[2] / "benchmarks" / "read_back.py"
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


def test_every_format_is_read_back_as_it_was_written(made: Path, tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("read_back", READ_BACK)
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    lines, good = script.read_back(made)
    assert good, lines
    assert sum("not installed" not in line for line in lines) >= 4

    damaged = shutil.copytree(made, tmp_path / "damaged")
    for file, old, new in (("coco/parts.json", '"id": 2', '"id": 3'), ("yolo/labels/train/000000.txt", " 0.", " 1.")):
        (damaged / file).write_text((damaged / file).read_text().replace(old, new))
    lines, good = script.read_back(damaged)
    assert not good
    assert [line.split()[:2] for line in lines if "WRONG" in line] == [["coco", "pycocotools"], ["yolo", "its"]]


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
                assert info["px_count_all"] >= whole.sum() >= info["px_count_visib"] == visible.sum()
                assert info["visib_fract"] == visible.sum() / info["px_count_all"]
                x, y, width, height = info["bbox_obj"]
                if x > 0 and y > 0 and x + width < 63 and y + height < 47:  # else the image cuts it
                    assert info["px_count_all"] == whole.sum()
                    assert info["bbox_obj"] == toolkit_box(whole)
                assert info["bbox_visib"] == (toolkit_box(visible) if visible.any() else [-1] * 4)
                middle = np.array(pose["cam_t_m2c"])  # the ball's: its silhouette is round it
                at = project(middle, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
                if x > 4 and x + width < 60 and y > 4 and y + height < 44:
                    assert at == pytest.approx((x + width / 2, y + height / 2), abs=1.5)
                    assert width == pytest.approx(2 * RADIUS / middle[2] * CAMERA.fx, abs=3)
                    seen += 1
    assert seen >= 4


def toolkit_box(mask: np.ndarray) -> list[int]:
    """x, y, width and height as bop_toolkit's misc.calc_2d_bbox has them: the last column less the first."""
    rows, columns = np.nonzero(mask)
    return [int(columns.min()), int(rows.min()), int(np.ptp(columns)), int(np.ptp(rows))]


def test_bop_counts_what_lies_beyond_the_border(tmp_path: Path) -> None:
    """A ball in the middle of the image, and as far away with its middle on the right border, in a corner, and out of
    sight behind the border."""
    places = [(0.0, 0.0), (32.0, 0.0), (-32.0, -24.0), (46.0, 0.0)]  # px from the middle, at 50 mm
    poses = [(50 * u / CAMERA.fx, 50 * v / CAMERA.fy, 50.0) for u, v in places]
    states = tmp_path / "states.jsonl"
    lines = [{"instruments": [{"name": "ball", "pose": at(*pose).tolist(), "joints": {}}]} for pose in poses]
    states.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    run = run_of(ball_scene("ball", [poses[0]]), tmp_path / "run")
    settings = Settings(count=4, states=str(states), tissue_check=False, min_share=0.0, max_unobserved=1.0)
    synthesize(run, tmp_path / "set", settings, ("bop",))  # type: ignore[arg-type]
    text = (tmp_path / "set/bop/train/000000/scene_gt_info.json").read_text()
    middle, right, corner, beyond = (infos[0] for _, infos in sorted(json.loads(text).items()))
    assert middle["visib_fract"] == 1.0
    area, (x, y, width, height) = middle["px_count_all"], middle["bbox_obj"]
    for info, share, (u, v) in ((right, 1 / 2, places[1]), (corner, 1 / 4, places[2])):
        assert info["px_count_all"] == pytest.approx(area, rel=0.2)  # seen aslant it is a little larger
        assert info["visib_fract"] == info["px_count_visib"] / info["px_count_all"] == pytest.approx(share, abs=0.07)
        assert info["px_count_valid"] == info["px_count_visib"]
        assert info["bbox_obj"] == pytest.approx([x + u, y + v, width, height], abs=2)
    assert right["bbox_visib"][0] + right["bbox_visib"][2] == 63
    assert corner["bbox_visib"][:2] == [0, 0]
    assert beyond["px_count_all"] == pytest.approx(area, rel=0.4)
    assert (beyond["px_count_visib"], beyond["visib_fract"]) == (0, 0.0)
    assert beyond["bbox_obj"] == beyond["bbox_visib"] == [-1] * 4


def test_imagefolder_has_a_line_for_every_image_and_mask(made: Path) -> None:
    found = 0
    for split in ("train", "validation"):
        folder = made / "imagefolder" / split
        for text in (folder / "metadata.jsonl").read_text().splitlines():
            line = json.loads(text)
            mask = pixels(folder / line["mask_file_name"]) > 0
            assert pixels(folder / line["file_name"]).shape == (48, 64, 3)
            for plane, of in (("parts", "parts"), ("ignore", "ignore"), ("depth", "depth")):
                original = made / of / line["file_name"]
                assert (folder / line[f"{plane}_file_name"]).read_bytes() == original.read_bytes()
            objects = line["objects"]
            assert len({len(values) for values in objects.values()}) == 1
            assert mask.sum() == sum(objects["area"])
            for (x, y, width, height), name in zip(objects["bbox"], objects["name"], strict=True):
                assert name == ("near", "far")[objects["category"][objects["name"].index(name)]]
                assert mask[y : y + height, x : x + width].any()
            found += 1
    assert found == COUNT


@pytest.mark.parametrize(
    ("names", "classes"),
    [(("near=grasper",), ["grasper", "far"]), (("near=grasper", "far=grasper"), ["grasper"])],
)
def test_every_format_has_the_given_names_of_classes(names, classes, runs, tmp_path):
    settings = Settings(count=2, tissue_tolerance_mm=2.0, class_names=names)
    synthesize(runs[0], tmp_path, settings, FORMATS, instrument_runs=runs[1:])  # type: ignore[arg-type]
    coco = json.loads((tmp_path / "coco/instances.json").read_text())
    assert [item["name"] for item in coco["categories"]] == classes
    parts = json.loads((tmp_path / "coco/parts.json").read_text())
    assert [item["supercategory"] for item in parts["categories"]] == classes
    for document in (coco, parts):
        assert {item["category_id"] for item in document["annotations"]} == set(range(1, len(classes) + 1))
    for variant, ending in (("", ""), ("segment", ""), ("obb", ""), ("parts", "/instrument")):
        data = yaml.safe_load((tmp_path / "yolo" / variant / "data.yaml").read_text())
        assert [name.removesuffix(ending) for name in data["names"].values()] == classes
        rows = (tmp_path / "yolo" / variant / "labels/train/000000.txt").read_text().splitlines()
        assert {int(row.split()[0]) for row in rows} == set(range(len(classes)))
        assert len(rows) == 2
    assert list(json.loads((tmp_path / "bop/objects.json").read_text()).values()) == classes
    truth = json.loads((tmp_path / "bop/train/000000/scene_gt.json").read_text())
    assert {item["obj_id"] for item in truth["0"]} == set(range(1, len(classes) + 1))
    line = json.loads((tmp_path / "imagefolder/train/metadata.jsonl").read_text().splitlines()[0])
    assert set(line["objects"]["name"]) == set(classes)
    with tarfile.open(tmp_path / "webdataset/train-000000.tar") as tar:
        stored = json.load(tar.extractfile("000000.json"))  # type: ignore[arg-type]
    assert {label["name"] for label in stored["labels"]} == set(classes)
    assert json.loads((tmp_path / "dataset.json").read_text())["classes"]["near"] == "grasper"
    assert "--class-names near=grasper" in (tmp_path / "README.md").read_text()
    assert [item["name"] for item in json.loads((tmp_path / "states.jsonl").read_text().splitlines()[0])["labels"]] == [
        "near",
        "far",
    ]


@pytest.mark.parametrize("names", [("nobody=a",), ("near",), ("near=",), ("near=a", "near=b")])
def test_names_of_classes_that_fit_no_instrument_are_refused(names, runs, tmp_path):
    settings = Settings(count=2, tissue_tolerance_mm=2.0, class_names=names)
    with pytest.raises(NeecoError, match=r"--class-names: .* expected INSTRUMENT=CLASS, once for each of near, far"):
        synthesize(runs[0], tmp_path / "set", settings, FORMATS, instrument_runs=runs[1:])  # type: ignore[arg-type]
    assert not (tmp_path / "set").exists()


def test_formats_and_images_can_be_added_later_and_reach_every_format_begun(made, runs, tmp_path):
    output, settings = tmp_path / "set", Settings(count=COUNT, tissue_tolerance_mm=2.0)
    synthesize(runs[0], output, replace(settings, count=2), ("coco",), instrument_runs=runs[1:])
    again = synthesize(runs[0], output, settings, FORMATS[:3], resume=True, instrument_runs=runs[1:])
    assert again.made_now == COUNT - 2
    assert len(json.loads((output / "coco/instances.json").read_text())["images"]) == COUNT
    assert synthesize(runs[0], output, settings, FORMATS, resume=True, instrument_runs=runs[1:]).made_now == 0
    assert json.loads((output / "dataset.json").read_text())["formats"] == list(FORMATS)
    for name in FORMATS:
        files = [path.relative_to(made) for path in (made / name).rglob("*") if path.is_file()]
        assert files
        assert all((made / file).read_bytes() == (output / file).read_bytes() for file in files)
