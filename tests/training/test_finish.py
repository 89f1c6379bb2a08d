"""After learning: joints are judged by what their readings explain, wrists found by colour, shafts prolonged; what is
hidden in nearly every frame, or detached from the rest of an instrument, is dropped."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from ball_world import RADIUS, ball_scene
from capture_files import PIVOT_MM, WRIST_MM, grasper_body, write_grasper
from rod_world import WALL_MM

from neeco.capture import read_capture
from neeco.capture.model import Camera, InstrumentState, State
from neeco.methods.kinematic import wrist
from neeco.methods.kinematic.articulation import LINK_LOGITS
from neeco.methods.kinematic.finish import (
    JudgedFrame,
    conclude,
    drop_detached,
    drop_occluded,
    extend_shaft,
)
from neeco.methods.kinematic.hinges import Hinges
from neeco.methods.kinematic.wrist import WristSettings, measure_radius, place_wrists, refine_wrists
from neeco.raster import rasterize
from neeco.scene.canonical import CanonicalGaussians, join_bodies, seed_gaussians
from neeco.scene.drawable import Recorded
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.method_registry import make_deformation
from neeco.scene.training_views import TrainingViews
from neeco.training.config import TrainConfig
from neeco.training.session import GaussianSession


@pytest.fixture
def session(tmp_path: Path) -> GaussianSession:
    """The grasper's capture with the scene that it was drawn from: nothing is left to learn."""
    capture = read_capture(write_grasper(tmp_path / "capture", frames=18))
    frames = capture.split("train")
    points = capture.points
    wall = seed_gaussians(
        torch.from_numpy(points.positions), torch.from_numpy(points.colors), torch.full((900,), 3.5), opacity=0.95
    )
    body, colors = grasper_body(0.0)
    grasper = seed_gaussians(body, colors, torch.full((len(body),), 1.3), opacity=0.95)
    logits = torch.zeros(len(body), 3)
    logits[:-30, 0] = logits[-30:-15, 1] = logits[-15:, 2] = 30.0
    canonical = join_bodies(
        [wall.with_extras(**{LINK_LOGITS: torch.zeros(900, 3)}), grasper.with_extras(**{LINK_LOGITS: logits})]
    )
    states, cameras = tuple(f.state for f in frames), tuple(f.camera for f in frames)
    recorded = Recorded(tuple(f.name for f in frames), ("train",) * len(frames), states, cameras)
    deformation = make_deformation("kinematic", capture.instruments)
    scene = GaussianScene(
        "kinematic", canonical, deformation, capture.instruments, recorded, torch.tensor([0.0, 0.0, 100.0])
    )
    hinges = deformation.articulations[0]
    with torch.no_grad():
        hinges.hinge_depth.fill_(PIVOT_MM)
        hinges.wrist_start.fill_(-20.0)
        hinges.radius.fill_(3.0)
    session = GaussianSession(scene, TrainingViews.read(frames), TrainConfig(method="kinematic"), print)
    session.iteration = session.length.iterations
    scene.requires_grad_(False)
    return session


def hinges_of(session: GaussianSession) -> Hinges:
    return session.scene.deformation.articulations[0]


def verdict(session: GaussianSession) -> dict:
    conclude(session, session.scene.deformation)
    return session.scene.diagnostics["joints"]["grasper.jaw_angle"]


def test_a_true_hinge_is_found(session: GaussianSession) -> None:
    told = verdict(session)
    assert told["found"] is True
    assert told["explained"] > 0.8
    assert told["pivot_mm"] == pytest.approx([0, 0, PIVOT_MM], abs=1e-3)
    assert told["axis"] == pytest.approx([1, 0, 0], abs=1e-4)
    assert told["verdict"].startswith("found: the reading explains")


def test_tips_are_where_the_jaws_end(session: GaussianSession) -> None:
    conclude(session, session.scene.deformation)
    points = session.scene.canonical.means[session.scene.canonical.body(1)]
    for part, jaw in ((0, points[-30:-15]), (1, points[-15:])):
        end = jaw[(jaw - torch.tensor([0.0, 0.0, PIVOT_MM])).norm(dim=1).argmax()]
        assert float((hinges_of(session).tips[1 + part] - end).norm()) < 1.0
    with torch.no_grad():
        session.scene.canonical.opacity_logits[session.scene.canonical.body(1)][-15:] = -4.0
    conclude(session, session.scene.deformation)
    assert bool(hinges_of(session).tips[1].isfinite().all())
    assert bool(hinges_of(session).tips[2].isnan().all())


@pytest.mark.parametrize("wrong", ["across", "still"])
def test_a_hinge_in_the_wrong_place_is_reported(wrong: str, session: GaussianSession) -> None:
    with torch.no_grad():
        if wrong == "across":
            hinges_of(session).hinge_angle.fill_(math.pi / 2)
        else:
            hinges_of(session).scale.fill_(0.0)
    told = verdict(session)
    assert told["found"] is False
    assert "NOT found" in told["verdict"]


def test_no_joint_is_judged_after_few_iterations(session: GaussianSession) -> None:
    told: list[str] = []
    session.report, session.iteration = told.append, 500
    with torch.no_grad():
        hinges_of(session).scale.fill_(0.0)
    judged = verdict(session)
    assert judged["found"] is None
    assert judged["verdict"].startswith("not judged: 500 iterations are too few, usual are ")
    assert told == []


def test_a_joint_that_no_log_has_is_not_sent_to_its_log(session: GaussianSession) -> None:
    (grasper,) = session.scene.instruments
    session.scene.instruments = (replace(grasper, unrecorded=("jaw_angle",)),)
    with torch.no_grad():
        hinges_of(session).scale.fill_(0.0)
    told = verdict(session)["verdict"]
    assert told.startswith("NOT found: no log has it")
    assert "check the joint's log" not in told


def test_an_instrument_of_which_nothing_was_learned_is_told_of(session: GaussianSession) -> None:
    told: list[str] = []
    session.report = told.append
    conclude(session, session.scene.deformation)
    assert told == []
    body = session.scene.canonical.body(1)
    assert session.scene.diagnostics["instruments"]["grasper"]["solid_gaussians"] == body.stop - body.start
    canonical = session.scene.canonical.map(lambda tensor: tensor.detach().clone())
    canonical.opacity_logits[canonical.body(1)] = -5.0
    session.scene.canonical = canonical
    conclude(session, session.scene.deformation)
    assert [line.startswith("warning: grasper: joint jaw_angle NOT found") for line in told] == [True, False]
    assert told[1].startswith("warning: grasper: hardly anything was learned of it (0 solid Gaussians)")


def test_masked_pixels_do_not_judge_a_hinge(session: GaussianSession) -> None:
    before = verdict(session)["explained"]
    for image in session.views.images:
        image[:, :40] = 255  # a text overlay, say
    spoilt = verdict(session)["explained"]
    masks = tuple(torch.arange(80).expand(64, 80) >= 40 for _ in session.views.images)
    session.views = replace(session.views, masks=masks)
    assert verdict(session)["explained"] > 0.7 > spoilt
    assert before > 0.7


def test_the_wrist_begins_where_the_colour_changes(session: GaussianSession) -> None:
    place_wrists(session, session.scene.deformation)
    assert float(hinges_of(session).wrist_start) == pytest.approx(WRIST_MM, abs=2.5)
    conclude(session, session.scene.deformation)
    assert float(hinges_of(session).wrist_start) == pytest.approx(WRIST_MM, abs=2.5)


def test_a_wrist_found_again_moves_unless_spinning_then_costs_more(session, monkeypatch):
    monkeypatch.setattr(wrist, "WRIST", WristSettings(spin_angle=math.pi / 4))  # the rings have eight Gaussians each
    hinges = hinges_of(session)
    hinges.wrist_start.fill_(3.0)
    refine_wrists(session, session.scene.deformation)
    assert float(hinges.wrist_start) == pytest.approx(WRIST_MM + 0.75, abs=1.0)
    with torch.no_grad():  # a shaft that is flat from -10 mm on, but coloured as before: the border is no wrist
        flat = session.scene.canonical.means[session.scene.canonical.body(1)]
        flat[flat[:, 2] > -10] *= torch.tensor([3.0, 0.05, 1.0])
    images = tuple(
        (rasterize(session.scene.at(frame.state), frame.camera).color * 255).round().to(torch.uint8)
        for frame in session.views.frames
    )
    session.views = replace(session.views, images=images)
    hinges.wrist_start.fill_(-12.0)
    refine_wrists(session, session.scene.deformation)
    assert float(hinges.wrist_start) < -8


def test_the_shafts_radius_is_measured_where_there_is_enough_of_it(session: GaussianSession) -> None:
    hinges = hinges_of(session)
    measure_radius(session.scene.canonical, 0, hinges)
    assert float(hinges.radius) == pytest.approx(2.0, abs=0.1)
    hinges.radius.fill_(100.0)
    measure_radius(session.scene.canonical, 0, hinges)
    assert float(hinges.radius) == 100.0


def test_on_an_instrument_of_one_colour_the_wrist_begins_where_it_is_no_longer_round(session: GaussianSession) -> None:
    """From -10 mm on the shaft becomes a flat blade, which shows when it is spun."""
    canonical = session.scene.canonical.map(lambda tensor: tensor.detach().clone())
    rows = canonical.body(1)
    canonical.sh_dc[rows] = 1.0
    flat = torch.zeros(len(canonical), dtype=torch.bool)
    flat[rows] = canonical.means[rows][:, 2] > -10
    canonical.means[flat] *= torch.tensor([3.0, 0.05, 1.0])
    session.scene.canonical = canonical
    images = tuple(
        (rasterize(session.scene.at(frame.state), frame.camera).color * 255).round().to(torch.uint8)
        for frame in session.views.frames
    )
    session.views = replace(session.views, images=images)
    place_wrists(session, session.scene.deformation)
    assert float(hinges_of(session).wrist_start) == pytest.approx(-10, abs=4)


def test_the_extent_is_where_the_solid_is(session: GaussianSession) -> None:
    conclude(session, session.scene.deformation)
    rear, tip = hinges_of(session).extent.tolist()
    assert rear == pytest.approx(-30, abs=3)
    assert tip == pytest.approx(20, abs=3)


def shaft_of(length: float, joints: tuple[str, ...] = ("jaw",)) -> tuple[CanonicalGaussians, Hinges]:
    """Ten tissue Gaussians, a tube of radius 2 mm along z from -length to 0, and ten Gaussians of another body."""
    along = torch.arange(-length, 0, 0.5).repeat_interleave(4)
    around = torch.tensor([0.0, 1.0, 2.0, 3.0]).repeat(len(along) // 4) * (math.pi / 2)
    tube = torch.stack([2 * around.cos(), 2 * around.sin(), along], -1)
    bodies = [torch.zeros(10, 3), tube, torch.ones(10, 3)]
    canonical = join_bodies(
        [seed_gaussians(p, torch.full((len(p), 3), 0.4), torch.ones(len(p)), opacity=0.9) for p in bodies]
    )
    hinges = Hinges(joints)
    with torch.no_grad():
        hinges.hinge_depth.fill_(2.0)
        hinges.extent.copy_(torch.tensor([-length, 0.0]))
        hinges.wrist_start.fill_(0.0)
    return canonical, hinges


def recorded_at(shift_mm: float) -> Recorded:
    """A recording with each camera looking across the shaft, whose rear leaves the image at `shift_mm`."""
    camera = Camera(torch.eye(4, dtype=torch.float64), 100.0, 100.0, 50.0, 50.0, 100, 100)
    pose = torch.eye(4, dtype=torch.float64)
    # the shaft's z along the image's x; its origin so that z = shift_mm falls on the left border at 100 mm depth
    pose[:3, :3] = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    pose[:3, 3] = torch.tensor([-50.0 - shift_mm, 0.0, 100.0])
    state = State({"tool": InstrumentState(pose, {"jaw": 0.1})})
    return Recorded(("a",) * 4, ("train",) * 4, (state,) * 4, (camera,) * 4)


def test_a_shaft_cut_by_the_image_is_prolonged_by_copies_of_what_was_seen() -> None:
    canonical, hinges = shaft_of(40)
    longer = extend_shaft(canonical, 1, "tool", hinges, recorded_at(-20.0), 60.0)
    assert longer.counts[0] == longer.counts[2] == 10
    assert torch.equal(longer.means[longer.body(0)], canonical.means[:10])
    assert torch.equal(longer.means[longer.body(2)], canonical.means[-10:])
    tube = longer.means[longer.body(1)]
    assert float(tube[:, 2].min()) < -70  # 20 mm seen and about 60 more
    assert float(tube[:, :2].norm(dim=1).sub(2).abs().max()) < 1e-4  # straight on
    gaps = tube[:, 2].unique().diff()
    assert float(gaps.max()) < 1.01  # and without a gap


def test_a_straight_instrument_is_prolonged_as_one_with_joints_is() -> None:
    canonical, straight = shaft_of(40, joints=())
    longer = extend_shaft(canonical, 1, "tool", straight, recorded_at(-20.0), 60.0)
    assert float(longer.means[longer.body(1)][:, 2].min()) < -70


def test_what_a_single_frame_saw_of_a_shaft_is_not_copied() -> None:
    canonical, hinges = shaft_of(40)
    near, far = recorded_at(-20.0), recorded_at(-35.0)
    states = (*near.states * 3, far.states[0])  # one of 13 frames shows more of the shaft
    few = Recorded(("a",) * 13, ("train",) * 13, states, (near.cameras[0],) * 13)
    stray = canonical.means[:, 2] < -30
    stray[: canonical.body(1).start] = stray[canonical.body(1).stop :] = False
    canonical.means[stray] *= torch.tensor([3.0, 3.0, 1.0])
    tube = extend_shaft(canonical, 1, "tool", hinges, few, 60.0).means[canonical.body(1).start : -10]
    assert float(tube[:, 2].min()) < -70
    assert float(tube[:, :2].norm(dim=1).max()) == pytest.approx(2, abs=1e-4)


def test_a_shaft_whose_end_was_seen_stays_as_it_is() -> None:
    canonical, hinges = shaft_of(40)
    same = extend_shaft(canonical, 1, "tool", hinges, recorded_at(-60.0), 60.0)
    assert same is canonical


@pytest.mark.parametrize("certainty", [1.0, 0.1, -1.0])
def test_images_tell_whether_a_shaft_whose_end_is_in_view_goes_on(certainty: float) -> None:
    canonical, hinges = shaft_of(40)
    recorded = recorded_at(-60.0)
    pixels = np.full((100, 100), certainty)
    judged = [JudgedFrame(0, recorded.states[0], recorded.cameras[0], pixels, pixels, pixels)] * 4
    longer = extend_shaft(canonical, 1, "tool", hinges, recorded, 60.0, judged=judged)
    assert (longer is not canonical) == (certainty == 1)


def test_a_shaft_that_is_cut_before_its_wrist_is_prolonged_all_the_same() -> None:
    canonical, hinges = shaft_of(40)
    with torch.no_grad():
        hinges.wrist_start.fill_(-45.0)  # the rear of what was learned is taken for the wrist
    longer = extend_shaft(canonical, 1, "tool", hinges, recorded_at(-20.0), 60.0)
    assert float(longer.means[longer.body(1)][:, 2].min()) < -70


def test_frames_in_which_the_instrument_rests_do_not_make_the_end_of_what_was_learned_the_real_one() -> None:
    canonical, hinges = shaft_of(40)
    moving = [recorded_at(shift) for shift in (-20.0, -23.0, -26.0, -29.0, -14.0, -11.0, -17.0, -8.0)]
    resting = recorded_at(-60.0)  # the end of what was learned is in view, in half of the frames
    states = (*(one.states[0] for one in moving), *[resting.states[0]] * 8)
    recorded = Recorded(("a",) * 16, ("train",) * 16, states, (resting.cameras[0],) * 16)
    longer = extend_shaft(canonical, 1, "tool", hinges, recorded, 60.0)
    assert float(longer.means[longer.body(1)][:, 2].min()) < -70


def links_near_the_hinge(share: float) -> list[int]:
    """The link that holds the most of a Gaussian beside the hinge, of one between the prongs and of one far beyond,
    once learned: the first two were learned as jaw 1, the last one as the shaft that might be jaw 2."""
    _, hinges = shaft_of(40)
    hinges.requires_grad_(False)
    hinges.hinge_angle.fill_(0.3)
    hinges.share.fill_(share)
    hinges.radius.fill_(3.0)
    pivot, axis = hinges.hinge(0)
    _, direction = hinges.shaft()
    places = torch.stack([pivot + 2.5 * axis, pivot + 0.5 * axis, pivot + 6.0 * direction])
    logits = torch.tensor([[0.0, 25.0, 0.0, 7.0], [0.0, 25.0, 0.0, 7.0], [25.0, 0.0, 1.0, 7.0]])
    settled = hinges.settled(places, logits)
    assert torch.equal(settled[:, 3], logits[:, 3])  # of another instrument's further links
    return hinges.link_weights(places, settled).argmax(1).tolist()


def test_only_what_holds_the_jaws_is_beside_the_hinge_and_only_jaws_are_beyond() -> None:
    assert links_near_the_hinge(share=0.6) == [0, 1, 2]


def test_beyond_the_hinge_a_jaw_that_stands_still_is_left_as_it_was_learned() -> None:
    assert links_near_the_hinge(share=1.0) == [0, 1, 0]


PLACES = [(0.0, 0.0, 60.0), (10.0, 5.0, 65.0), (-12.0, 3.0, 70.0), (4.0, -6.0, 55.0), (0.0, 9.0, 62.0)]


def test_a_ball_before_the_wall_keeps_its_inside_and_its_back() -> None:
    scene = ball_scene("ball", PLACES)
    kept = drop_occluded(scene)
    assert kept.counts == scene.canonical.counts
    assert torch.equal(kept.means, scene.canonical.means)


def test_what_lies_behind_the_wall_is_dropped_and_what_comes_out_in_some_frames_is_not() -> None:
    scene = ball_scene("ball", PLACES)
    canonical = scene.canonical
    ball = canonical.body(1)
    deep = torch.zeros(len(canonical), dtype=torch.bool)
    deep[ball.start : ball.start + 200] = True  # beside the ball, and behind the wall in every frame
    between = torch.zeros_like(deep)
    between[ball.start + 200 : ball.start + 300] = True  # behind the wall in the three frames that are farthest away
    means = canonical.means.clone()
    means[deep] += torch.tensor([30.0, 0.0, 90.0])
    means[between] = torch.stack(
        [torch.linspace(-1, 1, 100), torch.full((100,), RADIUS + 3.0), torch.full((100,), WALL_MM - 61.0)], 1
    )
    scene.canonical = canonical.map(lambda tensor: means if tensor is canonical.means else tensor)
    kept = drop_occluded(scene)
    left = kept.means[kept.body(1)]
    far = left[:, 2] > 50
    assert int(far.sum()) < 60  # those that stand behind other hidden ones even when the ball is drawn alone
    assert torch.equal(left[~far], means[ball][~deep[ball]])


def test_without_frames_nothing_is_dropped() -> None:
    scene = ball_scene("ball", [])
    assert drop_occluded(scene).counts == scene.canonical.counts


def unconfirmed(canonical: CanonicalGaussians) -> torch.Tensor:
    """No image shows any Gaussian on an instrument for certain."""
    return torch.zeros(len(canonical))


@pytest.mark.parametrize("share", [0.02, 0.3])
def test_a_cloud_apart_from_the_ball_is_dropped_however_dense_unless_images_confirm_it(share: float) -> None:
    canonical = ball_scene("ball", PLACES).canonical
    ball = canonical.body(1)
    cloud = torch.zeros(len(canonical), dtype=torch.bool)
    cloud[ball.start : ball.start + round(share * (ball.stop - ball.start))] = True
    means = canonical.means + cloud[:, None] * torch.tensor([2 * RADIUS + 4.0, 0.0, 0.0])
    moved = canonical.map(lambda tensor: means if tensor is canonical.means else tensor)
    assert torch.equal(drop_detached(moved, unconfirmed(canonical)).means, canonical.means[~cloud])
    confirmed = unconfirmed(canonical)
    confirmed[cloud] = 0.6  # most images that show the cloud show an instrument there
    assert drop_detached(moved, confirmed).counts == canonical.counts


def test_what_touches_the_ball_stays_and_so_does_what_is_transparent_within_it() -> None:
    canonical = ball_scene("ball", PLACES).canonical
    ball = canonical.body(1)
    means, opacities = canonical.means.clone(), canonical.opacity_logits.clone()
    means[ball.start : ball.start + 700] += torch.tensor([2 * RADIUS + 0.5, 0.0, 0.0])  # another ball, beside it
    opacities[ball.start : ball.start + 100] = -6.0
    changed = {id(canonical.means): means, id(canonical.opacity_logits): opacities}
    touching = canonical.map(lambda tensor: changed.get(id(tensor), tensor))
    assert drop_detached(touching, unconfirmed(canonical)).counts == canonical.counts


def test_an_instrument_of_which_nothing_is_solid_stays_as_it_is() -> None:
    canonical = ball_scene("ball", PLACES).canonical
    faint = torch.full_like(canonical.opacity_logits, -6.0)
    transparent = canonical.map(lambda tensor: faint if tensor is canonical.opacity_logits else tensor)
    assert drop_detached(transparent, unconfirmed(canonical)).counts == canonical.counts
