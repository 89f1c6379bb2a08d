import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from folder_contents import contents
from hypothesis import given
from hypothesis.extra.numpy import array_shapes, arrays
from PIL import Image
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO

from neeco.base.errors import NeecoError
from neeco.base.files import LOCK, TEMPORARY
from neeco.capture.writer import state_to_json
from neeco.labels.settings import LABELS
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.generator import SampleGenerator, draw_encoded
from neeco.synthesis.rendered_views import render, split_views, state_views
from neeco.synthesis.settings import Settings
from neeco.synthesis.writers import WrittenImages, load_record
from neeco.synthesis.writers.coco import Coco, run_lengths

COUNT = 6
SETTINGS = Settings(count=COUNT, seed=3, tissue_tolerance_mm=2.0)


@pytest.fixture(scope="module")
def made(run, tmp_path_factory):
    """A data set of six images."""
    output = tmp_path_factory.mktemp("made") / "dataset"
    summary = synthesize(run, output, SETTINGS)
    assert summary.images == COUNT
    return output


def pixels(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def states_file(path, states) -> str:
    path.write_text("".join(json.dumps(state_to_json(state)) + "\n" for state in states))
    return str(path)


def test_the_folder_is_laid_out_as_promised(made):
    assert {path.name for path in made.iterdir()} == {
        ".records", "images", "masks", "soft", "ignore", "parts", "depth", "silhouettes", "coco", "yolo", "imagefolder",
        "states.jsonl", "dataset.json", "preview.png", "README.md",
    }  # fmt: skip
    image, mask, parts = (pixels(made / folder / "000002.png") for folder in ("images", "masks", "parts"))
    assert image.shape == (48, 64, 3)
    assert set(np.unique(mask)) == {0, 255}
    assert ((parts > 0) == (mask == 255)).all()
    assert set(np.unique(parts)) == {0, 1, 2}


def test_soft_and_ignore_lie_beside_the_mask(made):
    info = json.loads((made / "dataset.json").read_text())
    mask, soft, ignore = (pixels(made / folder / "000002.png") for folder in ("masks", "soft", "ignore"))
    assert soft.dtype == ignore.dtype == np.uint8
    share = soft * info["soft"]["share_per_count"]
    rounded = np.abs(share - LABELS.threshold) <= info["soft"]["share_per_count"]
    assert ((share > LABELS.threshold) == (mask > 0))[~rounded].all()
    assert {0, 255} < set(np.unique(soft))
    assert set(np.unique(ignore)) == {0, info["ignore"]["ignored"]}
    unclear = (share > info["ignore"]["clear_shares"][0]) & (share < info["ignore"]["clear_shares"][1])
    assert unclear[ignore > 0].mean() > 0.3 > 3 * unclear.mean()
    assert (mask[ignore > 0] > 0).any()
    assert (mask[ignore > 0] == 0).any()


def test_depth_is_stored_in_twentieths_of_a_millimetre(made):
    depth, mask = pixels(made / "depth" / "000001.png"), pixels(made / "masks" / "000001.png")
    assert depth.dtype == np.uint16
    info = json.loads((made / "dataset.json").read_text())
    millimetres = depth * info["depth"]["mm_per_count"]
    assert np.median(millimetres[mask == 0]) == pytest.approx(100, abs=1)
    assert 60 < np.median(millimetres[mask > 0]) < 80


def test_the_data_set_says_how_it_was_made(made, run):
    info = json.loads((made / "dataset.json").read_text())
    assert info["complete"] is True
    assert info["images"] == COUNT
    assert info["settings"]["seed"] == 3
    assert info["settings"]["states"] == "interpolate"
    assert info["scene"] == str(run.path)
    assert [(entry["id"], entry["part"]) for entry in info["ids"]] == [(0, "tissue"), (1, "shaft"), (2, "jaw")]


def test_coco_is_read_by_pycocotools_and_its_polygons_are_the_masks(made):
    coco = COCO(str(made / "coco" / "instances.json"))
    assert len(coco.imgs) == COUNT
    for annotation in coco.loadAnns(coco.getAnnIds()):
        file_name = coco.imgs[annotation["image_id"]]["file_name"]
        mask, drawn = pixels(made / "masks" / file_name) > 0, coco.annToMask(annotation) > 0
        assert (mask == drawn).all()
        assert annotation["area"] == mask.sum()
        x, y, width, height = annotation["bbox"]
        assert mask[y : y + height, x : x + width].sum() == mask.sum()
        assert len(annotation["keypoints"]) == 15
    category = coco.cats[1]
    assert category["name"] == "rod"
    assert category["keypoints"] == ["shaft_far", "shaft_near", "hinge", "tip_left", "tip_right"]


def test_coco_lies_as_its_readers_expect_a_split(made):
    """Datumaro, CVAT: ROOT/annotations/instances_SPLIT.json and ROOT/images; the others are told both."""
    numbers = []
    for split, count in (("train", COUNT - 1), ("val", 1)):
        coco = COCO(str(made / "coco" / "annotations" / f"instances_{split}.json"))
        assert len(coco.imgs) == len(coco.anns) == count
        numbers += coco.imgs
        for image in coco.imgs.values():
            file = made / "coco" / "images" / image["file_name"]
            assert not file.is_symlink()
            assert file.read_bytes() == (made / "images" / file.name).read_bytes()
            assert image["split"] == split
    assert sorted(numbers) == sorted(COCO(str(made / "coco" / "instances.json")).imgs)


def test_ids_of_parts_do_not_depend_on_which_are_seen(made, tmp_path):
    """They are those of dataset.json and parts/, in COCO, too."""
    info = json.loads((made / "dataset.json").read_text())
    ids = {item["id"]: f"{item['instrument']}/{item['part']}" for item in info["ids"][1:]}
    records = [load_record(made, 0)]
    records[0]["labels"][0]["parts"].pop("shaft")
    records[0]["labels"][0]["instrument"] = "rod"
    for folder in ("images", "parts"):
        shutil.copytree(made / folder, tmp_path / folder)
    names = (("rod", "shaft"), ("rod", "jaw"))
    nothing = {"keypoint_names": (), "bones": (), "scene": None, "labeller": SimpleNamespace(names=names)}
    Coco().write(WrittenImages(root=tmp_path, records=records, part_names=names, **nothing))
    for file in (made / "coco/parts.json", made / "coco/annotations/parts_val.json", tmp_path / "coco/parts.json"):
        assert {number: category["name"] for number, category in COCO(str(file)).cats.items()} == ids
    (annotation,) = COCO(str(tmp_path / "coco/parts.json")).anns.values()
    assert ids[annotation["category_id"]] == "rod/jaw"


@pytest.mark.parametrize("file", ["parts.json", "rle/parts.json"])
def test_coco_parts_cover_the_part_ids(made, file):
    coco = COCO(str(made / "coco" / file))
    names = {number: category["name"] for number, category in coco.cats.items()}
    assert set(names.values()) == {"rod/shaft", "rod/jaw"}
    for annotation in coco.loadAnns(coco.getAnnIds()):
        parts = pixels(made / "parts" / coco.imgs[annotation["image_id"]]["file_name"])
        number = {"rod/shaft": 1, "rod/jaw": 2}[names[annotation["category_id"]]]
        assert annotation["area"] == (parts == number).sum()
        assert np.array_equal(coco.annToMask(annotation) > 0, parts == number)
        assert int(coco_mask.area(coco.annToRLE(annotation))) == annotation["area"]


@pytest.mark.parametrize(("variant", "numbers"), [("", 4), ("segment", None), ("pose", 4 + 15), ("obb", 8)])
def test_yolo_labels_lie_where_tools_look_and_stay_in_range(made, variant, numbers):
    folder = made / "yolo" / variant
    data = yaml.safe_load((folder / "data.yaml").read_text())
    assert data["names"] == {0: "rod"}
    images = [path for split in ("train", "val") for path in sorted((folder / data[split]).glob("*.png"))]
    assert len(images) == COUNT
    for image in images:
        assert not image.is_symlink()
        assert image.read_bytes() == (made / "images" / image.name).read_bytes()
        before, _, after = str(image).rpartition("/images/")
        label = f"{before}/labels/{after}".replace(".png", ".txt")
        with open(label) as stream:
            (row,) = stream.read().splitlines()
        category, *values = row.split()
        assert category == "0"
        assert numbers in (None, len(values))
        coordinates = np.array(values, dtype=float)
        if variant == "pose":
            assert set(coordinates[6::3]) <= {0, 1, 2}
            coordinates = np.concatenate([coordinates[4::3], coordinates[5::3]])
        if variant == "obb":  # whose corners may lie outside: their box counts
            low, high = coordinates.reshape(4, 2).min(0), coordinates.reshape(4, 2).max(0)
            coordinates = np.concatenate([(low + high) / 2, (high - low) / 1.01])
        assert (coordinates >= 0).all()
        assert (coordinates <= 1).all()


def test_yolo_has_the_parts_as_classes(made):
    data = yaml.safe_load((made / "yolo/parts/data.yaml").read_text())
    assert data["names"] == {0: "rod/shaft", 1: "rod/jaw"}
    drawn = 0
    for split in ("train", "val"):
        for label in sorted((made / "yolo/parts/labels" / split).glob("*.txt")):
            ids = pixels(made / "parts" / f"{label.stem}.png")
            rows = {int(row.split()[0]): np.array(row.split()[1:], float) for row in label.read_text().splitlines()}
            assert {category + 1 for category in rows} == set(np.unique(ids)) - {0}
            for category, points in rows.items():
                x, y = (points.reshape(-1, 2) * (64, 48)).T
                area = abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2
                assert area == pytest.approx((ids == category + 1).sum(), rel=0.15)
                drawn += 1
    assert drawn > COUNT


def test_a_yolo_box_is_the_extreme_pixels(made):
    values = np.array((made / "yolo/labels/train/000000.txt").read_text().split()[1:], dtype=float)
    mask = pixels(made / "masks" / "000000.png") > 0
    columns, rows = np.flatnonzero(mask.any(0)), np.flatnonzero(mask.any(1))
    left, right = (values[0] - values[2] / 2) * 64, (values[0] + values[2] / 2) * 64
    top, bottom = (values[1] - values[3] / 2) * 48, (values[1] + values[3] / 2) * 48
    assert (left, right, top, bottom) == pytest.approx((columns[0], columns[-1] + 1, rows[0], rows[-1] + 1), abs=0.01)


def test_pose_labels_swap_left_and_right_when_mirrored(made):
    data = yaml.safe_load((made / "yolo/pose/data.yaml").read_text())
    assert data["flip_idx"] == [0, 1, 2, 4, 3]
    assert data["kpt_shape"] == [5, 3]


def test_states_jsonl_draws_the_same_images_again(made, run, tmp_path):
    again = tmp_path / "again"
    synthesize(run, again, replace(SETTINGS, count=2, states=str(made / "states.jsonl")))
    for k in range(2):
        first, second = pixels(made / f"images/{k:06d}.png"), pixels(again / f"images/{k:06d}.png")
        assert np.abs(first.astype(int) - second).max() <= 1


def test_an_image_depends_on_seed_and_index_only(made, run, tmp_path):
    generator = SampleGenerator.of(run.scene, SETTINGS)
    for index in (4, 1):  # out of order, the others never drawn
        draw_encoded(generator, index).write(tmp_path)
        for folder in ("images", "parts", "depth"):
            name = f"{folder}/{index:06d}.png"
            assert (tmp_path / name).read_bytes() == (made / name).read_bytes()
    draw_encoded(replace(generator, settings=replace(SETTINGS, seed=4)), 1).write(tmp_path)
    assert (tmp_path / "images/000001.png").read_bytes() != (made / "images/000001.png").read_bytes()


def test_interrupted_and_resumed_is_the_same_data_set(made, run, tmp_path):
    output = tmp_path / "dataset"

    def interrupt(done):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        synthesize(run, output, SETTINGS, on_progress=interrupt)
    info = json.loads((output / "dataset.json").read_text())
    assert (info["complete"], info["images"]) == (False, 3)
    (output / "images/000001.png").write_bytes(b"cut short")
    (output / f"masks/{TEMPORARY}abc.png").write_bytes(b"left over from a kill")
    summary = synthesize(run, output, SETTINGS, resume=True)
    assert summary.made_now == COUNT - 2
    assert contents(output) == contents(made)


def test_a_data_set_that_was_not_begun_is_not_resumed(run, tmp_path):
    with pytest.raises(NeecoError, match="none: nothing was begun there; leave out --resume, or correct the path"):
        synthesize(run, tmp_path / "none", SETTINGS, resume=True)
    assert not (tmp_path / "none").exists()


def test_a_data_set_killed_before_its_first_whole_file_begins_again(made, run, tmp_path):
    (tmp_path / "set").mkdir()
    for name in (LOCK, f"{TEMPORARY}abc.json"):
        (tmp_path / "set" / name).touch()
    synthesize(run, tmp_path / "set", SETTINGS)
    assert contents(tmp_path / "set") == contents(made)


def test_a_data_set_can_grow(made, run, tmp_path):
    output = tmp_path / "dataset"
    synthesize(run, output, replace(SETTINGS, count=2))
    assert synthesize(run, output, SETTINGS, resume=True).made_now == COUNT - 2
    assert contents(output / "images") == contents(made / "images")


def test_a_folder_that_is_not_empty_is_left_alone(run, tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    for resume in (False, True):
        with pytest.raises(NeecoError, match="not empty"):
            synthesize(run, tmp_path, SETTINGS, resume=resume)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_given_states_that_are_refused_are_skipped_and_counted_by_reason(run, tmp_path, state):
    given = states_file(tmp_path / "states.jsonl", [state(), state(x=200.0), state(x=3.0), state(z=130.0)])
    summary = synthesize(run, tmp_path / "dataset", replace(SETTINGS, count=4, states=given, max_attempts=2))
    assert summary.skipped == [1, 3]
    assert sorted(path.name for path in (tmp_path / "dataset/images").iterdir()) == ["000000.png", "000002.png"]
    assert summary.refused == {"leaves the image": 2, "enters the tissue": 2}
    assert json.loads((tmp_path / "dataset/dataset.json").read_text())["refused"] == summary.refused


@pytest.mark.parametrize(
    "how", [{"states": "extrapolate"}, {"states": "grid"}, {"views": "orbit"}, {"views": "perturbed"}]
)
def test_every_sampler_makes_a_data_set(run, tmp_path, how):
    summary = synthesize(run, tmp_path / "dataset", replace(SETTINGS, count=2, **how), formats=("coco",))
    assert summary.images + len(summary.skipped) == 2
    assert not (tmp_path / "dataset/yolo").exists()


def test_threshold_labels_make_a_data_set_of_one_part(run, tmp_path):
    synthesize(run, tmp_path / "dataset", Settings(count=1, labels="threshold", tissue_check=False))
    info = json.loads((tmp_path / "dataset/dataset.json").read_text())
    assert info["ids"][1:] == [{"id": 1, "instrument": "rod", "part": "instrument"}]
    assert info["delta_thresholds"]["means"] > 0


def test_render_writes_image_part_ids_and_mask_for_every_view(run, tmp_path, state):
    given = states_file(tmp_path / "states.jsonl", [state(), state(x=200.0)])
    render(run.scene, state_views(run.scene, given), tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "parts.json",
        *(f"00000{k}{end}" for k in (0, 1) for end in (".png", "_parts.png", "_mask.png")),
    }
    named = json.loads((tmp_path / "out/parts.json").read_text())["ids"]
    assert [(entry["id"], entry["part"]) for entry in named] == [
        (0, "tissue"),
        *((index + 1, part) for index, (_, part) in enumerate(run.scene.label_names)),
    ]
    parts, mask = pixels(tmp_path / "out/000000_parts.png"), pixels(tmp_path / "out/000000_mask.png")
    assert set(np.unique(parts)) == {0, 1, 2}
    assert ((parts > 0) * 255 == mask).all()
    assert not pixels(tmp_path / "out/000001_mask.png").any()  # outside the image: rendered all the same


def test_render_names_views_after_files_and_splits_that_exist(scene, camera, state, tmp_path):
    from neeco.capture.model import Capture, Frame, PointCloud

    empty = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    files = ("left/000001.png", "right/000001.png", "left/000002.png")
    frames = tuple(Frame(tmp_path / file, camera, state(), "test") for file in files)

    class WithCapture:
        def capture(self):
            return Capture(tmp_path, frames, scene.instruments, empty)

    assert [view.name for view in split_views(WithCapture(), "test")] == ["left_000001", "right_000001", "000002"]
    with pytest.raises(NeecoError, match="'unseen' has no frames; the capture has test"):
        split_views(WithCapture(), "unseen")


@pytest.mark.parametrize(
    "damage", ["soft", "ignore", {"image": "../../secret.png"}, {"labels": [3]}, {"split": "\x1b[31m"}], ids=str
)
def test_an_image_without_one_of_its_files_or_with_a_changed_record_is_drawn_again(made, run, tmp_path, damage):
    output = shutil.copytree(made, tmp_path / "dataset")
    if isinstance(damage, str):
        (output / damage / "000001.png").unlink()
    else:
        file = output / ".records" / "000002.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | damage))
    assert synthesize(run, output, SETTINGS, resume=True).made_now == 1
    assert contents(output) == contents(made)


@pytest.mark.parametrize(
    ("other", "field"),
    [
        ({"seed": 9}, "settings.seed"),
        ({"states": "extrapolate"}, "settings.states"),
        ({"labels": "threshold"}, "settings.labels"),
        ({}, r"ignore: begun with .*0\.3.* now .*0\.5.*; use a new folder"),
    ],
)
def test_a_data_set_is_not_continued_with_other_settings_or_another_band(made, run, tmp_path, other, field):
    output = shutil.copytree(made, tmp_path / "dataset")
    if not other:  # as a version with another band wrote it
        info = json.loads((output / "dataset.json").read_text())
        info["ignore"]["clear_shares"] = [0.3, 0.8]
        (output / "dataset.json").write_text(json.dumps(info))
    before = contents(output)
    with pytest.raises(NeecoError, match=field):
        synthesize(run, output, replace(SETTINGS, **other), resume=True)
    with pytest.raises(NeecoError, match="--resume"):
        synthesize(run, output, SETTINGS)
    assert contents(output) == before


@given(arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=9)))
def test_run_lengths_are_the_mask(mask: np.ndarray) -> None:
    runs = run_lengths(mask)
    packed = coco_mask.frPyObjects(runs, *runs["size"])
    assert np.array_equal(coco_mask.decode(packed) > 0, mask)
