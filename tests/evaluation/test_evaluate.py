"""A whole evaluation of a world whose recorded images the scene itself drew."""

import json
import shutil
from collections import defaultdict
from dataclasses import replace

import pytest
import torch
from torch.overrides import TorchFunctionMode

from neeco.base.errors import NeecoError
from neeco.capture.images import write_labels
from neeco.capture.writer import write_capture
from neeco.cli import main
from neeco.evaluation import evaluate, image_metrics
from neeco.evaluation.evaluate import evaluate_run
from neeco.training.config import training_config
from neeco.training.run import open_run
from neeco.training.train import train


def make_run(world, folder, splits=("train", "train", "test", "unseen"), **options):
    capture = world.make_capture(folder / "capture", world.TinyScene(), splits, truth=options.pop("truth", True))
    return world.TinyRun(folder, world.TinyScene(**options), capture)


def evaluated(run, *splits, **options):
    return evaluate_run(run, run.capture(), *splits, **options)


def test_a_scene_scored_on_its_own_drawings_is_nearly_perfect(world, tmp_path):
    run = make_run(world, tmp_path)
    seen = []
    evaluation = evaluated(run, progress=lambda *event: seen.append(event))
    assert all(done == total for done, total in {what: count for what, *count in seen}.values())  # the last of each
    numbers = evaluation["given"]["test"]
    assert set(evaluation["given"]) == {"test", "unseen"}
    assert numbers["psnr"] > 45  # 8 bit rounding
    assert numbers["ssim"] > 0.99
    assert numbers["psnr_instrument"] > 45
    assert numbers["mask_iou"] == 1.0
    assert numbers["part_iou"]["shaft"] == 1.0
    assert numbers["part_iou"]["wrist"] is None
    assert numbers["covered_fraction"] > 0.9
    assert numbers["fps"] > 0
    assert numbers["num_gaussians"] == 108
    assert numbers["frames"] == 1
    assert numbers["lpips"] is None
    assert any("lpips" in note and "no weights" in note for note in evaluation["notes"])
    assert evaluation["per_frame"]["given"]["test"][0]["frame"] == "002"
    assert ("test", 1, 1) in seen
    assert json.loads((tmp_path / "evaluation.json").read_text()) == evaluation
    assert "aligned" not in evaluation


def test_labels_that_held_out_images_contradict_are_doubtful(world, tmp_path):
    scene = world.TinyScene()
    capture = world.make_capture(tmp_path, scene, ("train",) * 6 + ("test",) * 3, depth=24.0)
    frames = [
        world.moved(frame, world.translation(y=2.0), world.translation()) if frame.split == "test" else frame
        for frame in capture.frames
    ]
    run = world.TinyRun(tmp_path, scene, replace(capture, frames=tuple(frames)), doubts=("few frames",))
    evaluation = evaluated(run)
    numbers = evaluation["given"]["test"]
    assert numbers["mask_iou"] < 0.2
    assert numbers["estimated_iou"] == pytest.approx(numbers["mask_iou"], abs=0.15)  # so small an image is mostly edges
    first, second = evaluation["doubts"]
    assert first == "few frames"
    assert second.startswith("test: labels cover")


def test_aligned_scores_forgive_the_tracker_and_given_scores_do_not(world, tmp_path):
    run = make_run(world, tmp_path, ("train", "test"))
    wrong = world.moved(run.recorded.frames[1], world.translation(0.9, 0.6), world.translation())
    run.recorded = replace(run.recorded, frames=(run.recorded.frames[0], wrong))
    evaluation = evaluated(run, align=True)
    given, aligned = evaluation["given"]["test"], evaluation["aligned"]["test"]
    assert aligned["psnr_instrument"] > given["psnr_instrument"] + 3
    assert aligned["mask_iou"] >= given["mask_iou"]
    row = evaluation["per_frame"]["aligned"]["test"][0]
    assert 0.4 < row["moved"]["bar"]["mm"] < 2
    assert set(row["moved"]) == {"bar", "camera"}


def test_without_truth_the_mask_numbers_are_null_and_a_note_says_so(world, tmp_path):
    evaluation = evaluated(make_run(world, tmp_path, truth=False), ["train", "test"])
    numbers = evaluation["given"]["test"]
    assert numbers["mask_iou"] is None
    assert numbers["psnr_instrument"] is None
    assert numbers["mask_frames"] == 0
    (note,) = [note for note in evaluation["notes"] if "no frame has a true or reference mask" in note]
    assert note.startswith("train, test: psnr_instrument, mask_iou, part_iou: null")


def test_reference_masks_of_some_frames_are_used_and_counted(world, tmp_path):
    run = make_run(world, tmp_path, ("train", "test", "test"), truth=False)
    mask = torch.zeros(world.HEIGHT, world.WIDTH, dtype=torch.uint8)
    mask[:10] = 255
    write_labels(run.recorded.root / "reference_masks" / "001.png", mask)
    evaluation = evaluated(run, ["test"])
    numbers = evaluation["given"]["test"]
    assert numbers["mask_frames"] == 1
    assert 0 <= numbers["mask_iou"] < 1
    assert numbers["part_iou"]["shaft"] is None
    assert any("1 of 2 frames" in note for note in evaluation["notes"])


def test_a_scene_without_labels_has_no_mask_numbers(world, tmp_path):
    evaluation = evaluated(make_run(world, tmp_path, labelled=False), ["test"])
    assert evaluation["given"]["test"]["mask_iou"] is None
    assert evaluation["given"]["test"]["psnr_instrument"] is not None
    assert any("has no labels" in note for note in evaluation["notes"])


def test_ignored_pixels_do_not_count(world, tmp_path):
    run = make_run(world, tmp_path, ("train", "test"))
    frame = run.recorded.frames[1]
    state = replace(
        frame.state, instruments={"bar": replace(frame.state.instruments["bar"], pose=world.translation(z=-50))}
    )  # the bar is behind the camera now: only where it was in the recorded image is the drawing wrong
    ignore = torch.full((world.HEIGHT, world.WIDTH), 255, dtype=torch.uint8)
    recorded = frame.load_image()
    empty = world.rasterize(run.scene.at(state), frame.camera).color
    ignore[(recorded - empty).abs().amax(-1) > 0.004] = 0
    path = tmp_path / "ignore.png"
    write_labels(path, ignore)
    open_frame, masked_frame = replace(frame, state=state), replace(frame, state=state, mask_path=path)
    scores = []
    for candidate in (open_frame, masked_frame):
        run.recorded = replace(run.recorded, frames=(run.recorded.frames[0], candidate))
        scores.append(evaluated(run, ["test"])["given"]["test"])
    assert scores[0]["psnr"] < 30
    assert scores[1]["psnr"] > 45
    assert scores[1]["ssim"] > 0.99 > scores[0]["ssim"]


def test_an_unknown_split_is_refused_naming_those_there_are(world, tmp_path):
    run = make_run(world, tmp_path)
    with pytest.raises(NeecoError, match="no split 'tset'; it has train, test, unseen"):
        evaluated(run, ["tset"])
    only_training = make_run(world, tmp_path / "other", ("train",))
    with pytest.raises(NeecoError, match="all frames are training frames"):
        evaluated(only_training)


@pytest.fixture(scope="module")
def trained(world, tmp_path_factory):
    """A run of five steps on disk."""
    folder = tmp_path_factory.mktemp("trained")
    capture = world.make_capture(folder / "capture", world.TinyScene(), ("train",) * 4 + ("test",))
    write_capture(capture, folder / "capture")
    return train(folder / "capture", folder / "run", training_config("3dgs", {"iterations": 5}))


class Threads(TorchFunctionMode):
    """Notes how many threads torch has when its functions are called, by their names."""

    def __init__(self) -> None:
        super().__init__()
        self.seen = defaultdict(set)

    def __torch_function__(self, function, types, args=(), kwargs=None):
        if function is not torch.get_num_threads:
            self.seen[getattr(function, "__name__", "")].add(torch.get_num_threads())
        return function(*args, **kwargs or {})


def test_drawing_takes_one_thread_of_torch_and_lpips_those_it_found(trained):
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        network = image_metrics.Lpips((image_metrics.Convolution(1, 1, 0, None, True),), one_by_one_filter())
        with Threads() as threads, open_run(trained) as run:
            evaluate_run(run, run.capture(), ("test",), networks={"alexnet": network})
        assert threads.seen["exp"] == {1}  # of the Gaussians' sizes
        assert threads.seen["relu"] == {3}  # of the network
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def one_by_one_filter():
    return {
        "features.0.weight": torch.ones(1, 3, 1, 1),
        "features.0.bias": torch.zeros(1),
        "linear.0.weight": torch.ones(1),
    }


@pytest.mark.parametrize("place", ["taken/scores.json", "folder"])
def test_numbers_that_could_not_be_written_are_told_before_scoring(trained, tmp_path, capsys, place):
    run = shutil.copytree(trained, tmp_path / "run", ignore=shutil.ignore_patterns("evaluation.json"))
    (tmp_path / "taken").write_text("a file, not a folder")
    (tmp_path / "folder").mkdir()
    assert main(["evaluate", str(run), "--json", str(tmp_path / place)]) == 1
    assert not (run / "evaluation.json").exists()
    told = capsys.readouterr()
    assert len(told.err.strip().splitlines()) == 1
    assert str(tmp_path / place).split("/scores")[0] in told.err


def test_numbers_are_also_written_where_asked(trained, tmp_path):
    assert main(["evaluate", str(trained), "--json", str(tmp_path / "new" / "scores.json")]) == 0
    assert (tmp_path / "new" / "scores.json").read_text() == (trained / "evaluation.json").read_text()
    assert "images not used in training. " in (trained / "report.html").read_text()


def test_the_device_is_waited_for_before_a_clock_is_read(world, tmp_path, monkeypatch):
    waited = []
    monkeypatch.setattr(evaluate, "synchronise", waited.append)
    evaluated(make_run(world, tmp_path), ["test"])
    assert waited == [torch.device("cpu")] * (evaluate.SETTINGS.timed + 2)
