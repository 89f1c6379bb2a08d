"""An instrument is found in video from its shaft's diameter, or what to film is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from ingest.shaft_world import FOCAL, HEAD, HEIGHT, INTRINSICS, RADIUS, RATE, WIDTH, ShaftWorld

from neeco.base.errors import NeecoError
from neeco.capture import errors_only, read_capture
from neeco.capture.checks import check_capture
from neeco.capture.images import write_image
from neeco.capture.model import State
from neeco.geometry.lines import unit
from neeco.ingest.pipeline import ingest
from neeco.ingest.posing.posed_capture import HandPose, PosedCapture
from neeco.ingest.recording.model import read_recording
from neeco.ingest.request import IngestRequest
from neeco.ingest.result import assess_ingest
from neeco.ingest.shaft.axis import axis_between, contour_normals, image_lines
from neeco.ingest.shaft.from_video import find_shaft
from neeco.ingest.sources import sources_of
from neeco.ingest.timing.episodes import with_roll


@pytest.fixture(scope="module")
def world():
    return ShaftWorld()


def truth(world):
    """Ends [F, 3] mm and directions [F, 3] of the shaft in the cameras' frames."""
    lines = [world.line(frame) for frame in range(world.frames)]
    return np.array([end for end, _ in lines]), np.array([direction for _, direction in lines])


def errors(world, axes):
    """Degrees [F] between axes, mm [F] across them, and mm [F] along, less the median: the origin lies where it may."""
    ends, directions = truth(world)
    gap = axes.points - ends
    along = (gap * directions).sum(1)
    angles = np.degrees(np.arccos(np.clip((axes.directions * directions).sum(1), -1, 1)))
    return angles, np.linalg.norm(gap - along[:, None] * directions, axis=1), np.abs(along - np.median(along))


def test_two_edges_and_a_diameter_give_the_axis_of_one_image():
    point, direction = np.array([4.0, -3.0, 70.0]), unit(np.array([-0.7, 0.4, 0.5]))
    lines = image_lines(contour_normals(point, direction, RADIUS), INTRINSICS)
    pixel = point[:2] * FOCAL / point[2] + [WIDTH / 2, HEIGHT / 2]
    ahead = point + direction
    along = ahead[:2] * FOCAL / ahead[2] + [WIDTH / 2, HEIGHT / 2] - pixel
    found, axis = axis_between(lines, pixel, along, RADIUS, INTRINSICS)
    assert axis == pytest.approx(direction, abs=1e-9)
    assert np.cross(found - point, direction) == pytest.approx(np.zeros(3), abs=1e-6)


@pytest.mark.parametrize("trocar", [None, False])
def test_the_shaft_is_found_in_a_moving_scopes_images(world, found, trocar):
    if trocar is False:
        found = find_shaft(world.images, world.masks, world.scene(), trocar=trocar)
    angles, across, along = errors(world, found.axes)
    assert np.median(angles) < 0.5
    assert np.median(across) < 0.4
    assert np.median(along) < 0.4
    assert found.known.all()
    assert not any("same colour" in note for note in found.notes)
    assert found.working_length == pytest.approx(HEAD, abs=1.5)
    assert (found.axes.trocar is None) == (trocar is False)
    # errors are of the size that is stated
    stated = np.array([np.hypot(*item.rotation_deg[:2]) for item in found.uncertainties])
    assert np.mean(angles < 2 * stated) > 0.8
    assert all(item.rotation_deg[2] == 180 for item in found.uncertainties)


def test_poses_have_z_along_the_shaft_and_turn_least(world, found):
    cameras = np.stack([world.camera(frame) for frame in range(world.frames)])
    _, directions = truth(world)
    z = np.einsum("fij,fj->fi", cameras[:, :3, :3], directions)
    assert np.median(np.abs(found.poses[:, :3, 2] - z)) < 0.01
    determinants = np.linalg.det(found.poses[:, :3, :3])
    assert determinants == pytest.approx(np.ones(world.frames))
    turns = np.einsum("fji,fjk->fik", found.poses[:-1, :3, :3], found.poses[1:, :3, :3])
    spin = np.degrees(np.arctan2(turns[:, 1, 0] - turns[:, 0, 1], turns[:, 0, 0] + turns[:, 1, 1]))
    assert np.abs(spin).max() < 0.5
    rolled = with_roll(found.poses, np.full(world.frames, 0.5))
    assert rolled[:, :3, 2:] == pytest.approx(found.poses[:, :3, 2:])
    assert (rolled[:, :3, 0] * found.poses[:, :3, 1]).sum(1) == pytest.approx(np.full(world.frames, np.sin(0.5)))


def test_a_fixed_trocar_tells_the_cameras_scale():
    world = ShaftWorld(frames=36, reach=5.0)
    found = find_shaft(world.images, world.masks, world.scene(unit_mm=1.3), trocar=True)
    assert found.axes.scale == pytest.approx(1.3, rel=0.15)
    unknown = find_shaft(world.images, world.masks, world.scene(unit_mm=1.3), trocar=False)
    assert unknown.axes.scale == 1
    assert unknown.axes.scale_sd is None
    assert any("scale is a guess" in note for note in unknown.notes)


def test_a_shaft_that_passes_no_fixed_point_is_noticed(world):
    scene = world.scene()
    moved = scene.world_from_camera.copy()
    moved[:, 0, 3] += 15 * np.sin(3 * world.times)  # to a world in which the trocar swings
    found = find_shaft(world.images, world.masks, replace(scene, world_from_camera=moved))
    assert found.axes.trocar is None
    assert any("no fixed trocar" in note for note in found.notes)


def test_where_colours_do_not_tell_the_end_the_tip_does():
    world = ShaftWorld(even=True)
    found = find_shaft(world.images, world.masks, world.scene(), HEAD, trocar=True)
    assert any("same colour" in note for note in found.notes)
    angles, across, along = errors(world, found.axes)
    assert np.median(angles) < 1
    assert np.median(across) < 0.5
    assert np.median(along) < 1


def test_a_thinner_part_of_the_shafts_colour_is_not_taken_for_shaft():
    world = ShaftWorld(wrist=9.0)
    found = find_shaft(world.images, world.masks, world.scene(), trocar=True)
    angles, _, _ = errors(world, found.axes)
    assert np.median(angles) < 1.5
    ends, directions = truth(world)
    assert abs(np.median(((found.axes.points - ends) * directions).sum(1))) < 5  # at the shaft's end, not the wrist's


def test_what_cannot_work_is_refused_with_what_to_film(world):
    scene = world.scene()
    with pytest.raises(NeecoError, match="moves before the tissue in 0 of 24 frames"):
        find_shaft(world.images, np.zeros_like(world.masks), scene)
    two = world.masks.copy()
    two |= two[:, ::-1, ::-1]
    with pytest.raises(NeecoError, match="film one at a time"):
        find_shaft(world.images, two, scene)
    ends, _ = truth(world)
    near = world.masks.copy()
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    for frame in range(world.frames):  # the scope stands so near that the shaft hardly shows
        end = ends[frame, :2] * FOCAL / ends[frame, 2] + [WIDTH / 2, HEIGHT / 2]
        near[frame] &= (u < end[0] + 3) & (v < end[1] + 3)
    with pytest.raises(NeecoError, match="hold the scope back"):
        find_shaft(world.images, near, scene)


@pytest.fixture(scope="module")
def found(world):
    """The shaft of `world`, of whose trocar nothing is said."""
    return find_shaft(world.images, world.masks, world.scene(), trocar=None)


@pytest.fixture(scope="module")
def still_world():
    return ShaftWorld(still=True, frames=24)


@pytest.fixture
def recorded(still_world, tmp_path):
    """A still scope's recording: folder of images and recording.yaml with changes."""
    world = still_world
    for number, image in enumerate(world.images):
        write_image(tmp_path / "images" / f"{number:03d}.png", torch.from_numpy(image.astype(np.float32) / 255))
    rows = [f"{time:.4f},{0.2 * time:.4f}" for time in np.arange(-0.2, 3, 0.02)]
    (tmp_path / "roll.csv").write_text("\n".join(["t_s,roll_rad", *rows]) + "\n")

    def write(**changes):
        item = {"name": "grasper", "from_video": {"shaft_diameter_mm": 2 * RADIUS}} | changes
        document = {
            "images": {"folder": "images", "fps": RATE},
            "intrinsics": list(INTRINSICS),
            "instruments": [{key: value for key, value in item.items() if value is not None}],
        }
        path = tmp_path / "recording.yaml"
        path.write_text(yaml.safe_dump(document))
        return path

    return world, write


def test_a_video_and_a_ruler_become_a_capture(recorded, tmp_path):
    world, write = recorded
    result = ingest(read_recording(write(roll="roll.csv")), tmp_path / "capture", lambda what, done, total: None)
    assert result.still
    capture = read_capture(result.capture)
    (instrument,) = capture.instruments
    assert instrument.from_video is not None
    assert instrument.from_video.shaft_diameter_mm == 2 * RADIUS
    assert instrument.from_video.working_length_mm == pytest.approx(HEAD, abs=2)
    assert not errors_only(check_capture(result.capture))
    _, directions = truth(world)
    for frame in capture.frames:
        state = frame.state.instruments["grasper"]
        true = directions[round(frame.state.time * RATE)]
        assert np.degrees(np.arccos(np.clip(state.pose[:3, 2].numpy() @ true, -1, 1))) < 3
        assert state.uncertainty is not None
        assert state.uncertainty.rotation_deg[2] < 20
    assert any("two diameters of its shaft" in note for note in result.notes)
    assert result.in_video == ("grasper",)
    assert not any("roll is not known" in doubt for doubt in assess_ingest(result, capture).warnings)
    state = capture.frames[0].state.instruments["grasper"]
    unknown = replace(state, uncertainty=replace(state.uncertainty, rotation_deg=(1.0, 1.0, 180.0)))
    first = replace(capture.frames[0], state=State({"grasper": unknown}))
    unsure = replace(capture, frames=(first, *capture.frames[1:]))
    assert any("roll is not known" in doubt for doubt in assess_ingest(result, unsure).warnings)


def test_without_a_logged_roll_it_can_be_posed_by_hand(recorded, tmp_path):
    _, write = recorded
    result = ingest(read_recording(write()), tmp_path / "capture", lambda what, done, total: None)
    assert not errors_only(check_capture(result.capture))
    posed = PosedCapture(result.capture)
    first = posed.solve()["grasper"].suggestions(1)[0].frame
    answer = HandPose(posed.frames[first], "grasper", 40.0, dict.fromkeys(posed.measured["grasper"].joints, 20.0))
    solved = posed.solve([answer])["grasper"]
    assert np.degrees(solved.rolls.values[first]) == pytest.approx(40.0, abs=1)
    assert 0 < np.degrees(solved.rolls.deviations).max() < 120


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"from_video": {"shaft_diameter_mm": 0}}, "shaft_diameter_mm: 0 is out of range"),
        ({"from_video": {"working_length_mm": 20}}, "shaft_diameter_mm: missing"),
        ({"from_video": {"shaft_diameter_mm": 5, "fixed_trocar": "yes"}}, "fixed_trocar: .* is not true or false"),
        ({"from_video": {"shaft_diameter_mm": 5, "length": 3}}, "length"),
        ({"poses": "roll.csv"}, "poses are logged"),
        ({"from_video": None, "roll": "roll.csv"}, "roll: belongs to an instrument from_video"),
    ],
)
def test_what_a_recording_says_wrong_of_its_shaft_is_refused(tmp_path, changes, words):
    (tmp_path / "images").mkdir()
    (tmp_path / "roll.csv").write_text("t_s,roll_rad\n0,0\n")
    item = {"name": "grasper", "from_video": {"shaft_diameter_mm": 5}} | changes
    document = {"images": {"folder": "images", "fps": RATE}, "instruments": [{k: v for k, v in item.items() if v}]}
    (tmp_path / "recording.yaml").write_text(yaml.safe_dump(document))
    with pytest.raises(NeecoError, match=words):
        read_recording(tmp_path / "recording.yaml")


def test_the_command_line_takes_a_diameter_instead_of_a_tracker(tmp_path):
    (tmp_path / "v.mp4").write_bytes(b"")
    (tmp_path / "log.csv").write_text("t_s,a_rad\n0,0\n")
    video, log = tmp_path / "v.mp4", tmp_path / "log.csv"
    (recording,) = sources_of(IngestRequest(video=video, joint=(("jaw", log, None),), shaft_diameter=5), Path("out"))[1]
    (item,) = recording.instruments
    assert item.from_video is not None
    assert item.placed
    assert list(item.joints) == ["jaw"]
    with pytest.raises(NeecoError, match="--shaft-diameter: -1 is out of range"):
        sources_of(IngestRequest(video=video, shaft_diameter=-1), Path("out"))[1]
    with pytest.raises(NeecoError, match="--shaft-diameter: poses are logged"):
        sources_of(IngestRequest(video=video, instrument=log, shaft_diameter=5), Path("out"))[1]
