"""Several recordings of one instrument become one capture: one timeline, clocks of their own, whole ones to test."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from ingest.still_world import FRAMES, RATE, Theatre

from neeco.base.errors import NeecoError
from neeco.capture import Capture, read_capture
from neeco.capture.checks import inspect_capture
from neeco.cli.ingest import Ingest, run
from neeco.ingest.pipeline import assign_splits, ingest
from neeco.ingest.readers.interpolate import poses_at
from neeco.ingest.recording.model import Recording, VideoFile, read_recording
from neeco.ingest.sources import sources_of
from neeco.ingest.timing.episodes import EPISODES
from neeco.ingest.timing.reading import episode_names, read_episodes, separate

BEGINS = (0.0, 2.0, 4.5)  # s of the bar's motion


def silent(what: str, done: int, total: int) -> None:
    pass


def still_recordings(folder: Path, seeds: tuple[int, ...] = (1, 1, 1), **changes: object) -> list[Path]:
    """recording.yaml of three recordings of one bar; the clock of each is ahead by another second more."""
    paths = []
    for number, (begins, seed) in enumerate(zip(BEGINS[: len(seeds)], seeds, strict=True)):
        theatre = Theatre(folder / f"take {number}", begins, seed)
        theatre.folder.mkdir()
        path = theatre.write(**{"sync": {"em": float(number)}} | changes)
        log = theatre.folder / "bar.csv"
        header, *rows = log.read_text().splitlines()
        moved = [f"{float(row.split(',')[0]) + number:.5f},{row.split(',', 1)[1]}" for row in rows]
        log.write_text("\n".join([header, *moved]) + "\n")
        paths.append(path)
    return paths


def change(path: Path, **changes: object) -> None:
    """Other keys in a recording.yaml."""
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | changes))


def ingested(paths: list[Path], output: Path) -> Capture:
    return read_capture(ingest([read_recording(path) for path in paths], output, silent).capture)


def test_recordings_of_a_still_scope_become_one_capture_with_every_pose_in_its_place(tmp_path: Path) -> None:
    result = ingest([read_recording(path) for path in still_recordings(tmp_path, (1, 1))], tmp_path / "capture", silent)
    assert f"episode take_1: {FRAMES} of {FRAMES} frames kept" in result.lines()
    capture = read_capture(result.capture)
    assert capture.still
    assert capture.registered
    theatre = Theatre(tmp_path)
    length = (FRAMES - 1) / RATE + EPISODES.pause_s
    seen = set()
    for frame in capture.frames:
        episode, number = int(frame.name[5]), int(frame.name[-6:])
        assert frame.name == f"take_{episode}_{number:06d}"
        assert frame.state.time == pytest.approx(episode * length + number / RATE)
        place = frame.state.instruments["bar"].pose[:3, 3].numpy()
        assert np.abs(place - theatre.place(BEGINS[episode] + number / RATE)).max() < 0.05
        assert frame.split == ("test" if episode == 1 else "train")  # it never turns: nothing is unseen
        seen.add(episode)
    assert seen == {0, 1}
    assert not inspect_capture(tmp_path / "capture").problems


def test_the_recording_names_whole_episodes_to_test(tmp_path: Path) -> None:
    splits = {"test_episodes": ["take_0"], "unseen_episodes": ["take_1"]}
    data = read_episodes([read_recording(path) for path in still_recordings(tmp_path, splits=splits)])
    frames, rule = np.arange(len(data.times)), data.recording.splits
    assert rule is not None
    names, words = assign_splits(frames, np.tile(np.eye(4), (len(frames), 1, 1)), {}, rule, data.ranges)
    assert names.tolist() == ["test"] * FRAMES + ["unseen"] * FRAMES + ["train"] * FRAMES
    assert words == "test: the recording take_0; unseen: the recording take_1"


@pytest.mark.slow
def test_the_right_camera_of_every_recording_is_one_view_more(tmp_path: Path) -> None:
    stereo = {"images": {"folder": "right", "fps": RATE}, "calibration": "stereo.yaml"}
    capture = ingested(still_recordings(tmp_path, (1, 1), stereo=stereo), tmp_path / "capture")
    right = [frame.name for frame in capture.frames if frame.name.endswith("_right")]
    assert {name[:6] for name in right} == {"take_0"}  # take_1 is there to test
    left = {frame.name: frame.state for frame in capture.frames}
    for frame in capture.frames:
        if frame.name.endswith("_right"):
            assert frame.state.time == left[frame.name.removesuffix("_right")].time


def test_another_tissue_is_refused_by_name(tmp_path: Path) -> None:
    paths = still_recordings(tmp_path, (1, 7))
    with pytest.raises(NeecoError, match=r"take 1/recording\.yaml: take_1 shows another place than take_0: \d+%"):
        ingested(paths, tmp_path / "capture")
    assert not (tmp_path / "capture").exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"intrinsics": [151, 151, 80, 64]}, "intrinsics: differ from what"),
        ({"instruments": [{"name": "rod", "poses": {"file": "bar.csv", "frame": "camera"}}]}, "instruments: differs"),
        ({"instruments": [{"name": "bar", "poses": {"file": "bar.csv", "frame": "base"}}]}, "bar: poses are in"),
        ({"instruments": [{"name": "bar", "poses": {"file": "bar.csv", "frame": "camera"},
                           "joints": {"jaw": {"file": "bar.csv", "columns": {"value": "qx"},
                                              "units": {"angle": "rad"}}}}]}, "bar: joints: differs"),
        ({"camera": "moving"}, "camera: differs from that"),
        ({"splits": {"test_every": 3}}, "splits: differs from that"),
        ({"tissue": "bowel"}, "tissue: a capture has one tissue; leave the key out, or make one capture"),
    ],
)  # fmt: skip
def test_what_one_capture_cannot_hold_is_refused_in_one_line(tmp_path, changes, words):
    paths = still_recordings(tmp_path, (1, 1))
    change(paths[1], **changes)
    with pytest.raises(NeecoError) as error:
        read_episodes([read_recording(path) for path in paths])
    assert words in str(error.value)
    assert str(error.value).startswith(str(paths[1]))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("splits", "words"),
    [
        ({"test_episodes": ["take_9"]}, "no episode is called 'take_9'; they are take_0, take_1"),
        ({"test": [3]}, "splits: test and unseen count one video's frames"),
    ],
)
def test_splits_name_what_there_is(tmp_path, splits, words):
    with pytest.raises(NeecoError, match=words):
        read_episodes([read_recording(path) for path in still_recordings(tmp_path, (1, 1), splits=splits)])


def test_names_come_from_files_or_from_their_folders_and_differ() -> None:
    def named(*paths: str) -> tuple[str, ...]:
        return episode_names([Recording(path=Path(path), video=VideoFile(Path())) for path in paths])

    assert named("a/one.yaml", "a/two.yaml") == ("one", "two")
    assert named("/day 1/recording.yaml", "/day2/recording.yaml") == ("day_1", "day2")
    assert named("/x/a/r.yaml", "/y/a/r.yaml", "/z/a/r.yaml") == ("a", "a_2", "a_3")


def test_logs_on_the_joint_timeline_say_what_each_says_on_its_own(tmp_path: Path) -> None:
    data = read_episodes([read_recording(path) for path in still_recordings(tmp_path)])
    log = data.joint_log(lambda part: part.poses["bar"])
    times = data.times
    np.testing.assert_allclose(
        poses_at(log, times, 0.0)[0], np.concatenate([
            poses_at(part.poses["bar"], part.times + number, 0.0)[0] for number, part in enumerate(data.parts)
        ]), atol=1e-9,
    )  # fmt: skip
    between = times[FRAMES - 1] + EPISODES.pause_s / 2
    assert not poses_at(log, np.array([between]))[1].any()


def test_recordings_of_a_moving_scope_are_registered_together_each_by_its_own_clock(recorded, tmp_path: Path) -> None:
    path = recorded.folder / "recording.yaml"
    text = path.read_text().replace("sync: sync.json\n", "sync: {jaw_angle: -0.01}\n")
    path.write_text(text.replace("registration_steps: 1", "registration_steps: 8"))
    one, length = recorded.cameras, recorded.frames / 25
    recorded.cameras = lambda times: one(np.mod(times + 1e-9, length))  # the second shows the same again
    result = ingest([read_recording(path)] * 2, tmp_path / "capture", silent)
    assert {name: clock.seconds for name, clock in result.clocks.items() if name.startswith("em")} == {
        "em of rec": pytest.approx(recorded.offset, abs=0.01), "em of rec_2": pytest.approx(recorded.offset, abs=0.01),
    }  # fmt: skip
    assert result.registration is not None
    assert np.sqrt(np.mean(result.registration.position_residual**2)) < 0.5
    assert result.registration.scale == pytest.approx(1 / recorded.scale, rel=0.01)


def test_a_recording_that_does_not_join_the_others_is_named(recorded, tmp_path: Path) -> None:
    recorded.mapped = lambda number: number < recorded.frames
    path = recorded.folder / "recording.yaml"
    with pytest.raises(NeecoError, match=r"recording\.yaml: rec_2 stands alone: 0 of its frames"):
        ingest([read_recording(path)] * 2, tmp_path / "capture", silent)


def test_several_recordings_are_given_on_the_command_line(tmp_path: Path) -> None:
    paths = still_recordings(tmp_path, (1, 1))
    assert [recording.path for recording in sources_of(Ingest(source=tuple(paths)), Path("out"))[1]] == paths
    for sources, words in [
        ((paths[0], tmp_path), "is a folder; of several recordings give each recording.yaml"),
        ((paths[0], paths[1].parent), "holds a recording; give the file"),
    ]:
        with pytest.raises(NeecoError, match=words):
            run(Ingest(source=sources, output=tmp_path / "capture"))
    with pytest.raises(NeecoError, match="--init: looks at one folder or file"):
        run(Ingest(source=tuple(paths), init=True))


@pytest.mark.parametrize(("option", "given"), [("json", Path("numbers.json")), ("strict", True)])
def test_options_of_a_verdict_are_refused_with_a_folder_to_convert(tmp_path: Path, option: str, given: object) -> None:
    (tmp_path / "other").mkdir()
    with pytest.raises(NeecoError, match=rf"other: --{option} does not apply to a converted folder; remove it"):
        run(Ingest(source=(tmp_path / "other",), output=tmp_path / "capture", **{option: given}))
    assert not (tmp_path / "capture").exists()


class TestEpisodesOfADataSet:
    """`episodes` in a recording.yaml of a LeRobot data set."""

    @pytest.fixture
    def written(self, tmp_path: Path) -> Path:
        lerobot = pytest.importorskip("lerobot_world")
        rows = np.column_stack([np.arange(36.0).reshape(12, 3), np.tile([1.0, 0, 0, 0], (12, 1))])
        states = [{"observation.state": rows}] * 3
        lerobot.write_data_set(tmp_path / "set", "v3.0", states)
        columns = {"position": [f"observation.state[{i}]" for i in range(3)]}
        columns["quaternion_wxyz"] = [f"observation.state[{i}]" for i in range(3, 7)]
        pose = {"file": "set", "stream": "observation.state", "frame": "camera", "columns": columns}
        pose["units"] = {"length": "mm"}
        document = {
            "video": {"file": "set", "stream": f"episode 0/{lerobot.CAMERA}"},
            "instruments": [{"name": "psm1", "poses": pose}],
            "episodes": [2, "0-1"],
        }
        path = tmp_path / "recording.yaml"
        path.write_text(yaml.safe_dump(document))
        return path

    def test_each_is_a_recording_with_its_streams(self, written: Path) -> None:
        found = separate([read_recording(written)])
        assert [item.episode for item in found] == ["episode_2", "episode_0", "episode_1"]
        for item in found:
            number = item.episode[-1]
            assert item.stream == f"episode {number}/observation.images.endoscope.left"
            assert item.instruments[0].poses is not None
            assert item.instruments[0].poses.stream == f"episode {number}/observation.state"

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"episodes": [1, 1]}, "episodes: 1 is listed twice"),
            ({"episodes": ["0-9999999"]}, "episodes: 10000000 are too many"),
            ({"episodes": ["last"]}, "episodes: 'last' is no range"),
        ],
    )
    def test_wrong_lists_are_refused(self, written: Path, changes: dict[str, object], words: str) -> None:
        change(written, **changes)
        with pytest.raises(NeecoError, match=words):
            read_recording(written)

    def test_an_episode_that_is_not_there_is_named(self, written: Path) -> None:
        change(written, episodes=[0, 7])
        with pytest.raises(NeecoError, match="has no episode 7; choose one of episodes 0 to 2"):
            read_episodes(separate([read_recording(written)]))

    def test_files_that_hold_one_recording_have_no_episodes(self, tmp_path: Path) -> None:
        (path,) = still_recordings(tmp_path, (1,), episodes=[0, 1])
        with pytest.raises(NeecoError, match=r"episodes: no file named here holds several"):
            separate([read_recording(path)])
