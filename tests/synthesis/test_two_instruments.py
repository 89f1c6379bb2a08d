"""Two instruments, one before the other: who hides whom must show in the labels."""

import numpy as np
import pytest
import torch
from rod_world import CAMERA

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.labels.annotation import annotate
from neeco.labels.drawing import draw_layers
from neeco.labels.labellers import CompositedLabels, ThresholdLabels
from neeco.labels.settings import LABELS
from neeco.scene import CanonicalGaussians, GaussianScene, Recorded
from neeco.scene.deformation import UNPERTURBED, Deformation, Posed
from neeco.synthesis.samplers import InterpolatedStates

WALL, BAR = 300, 40


class TwoBars(Deformation):
    """Rigid bars `upright` and `level`, each in its own frame."""

    label_names = (("upright", "instrument"), ("level", "instrument"))

    def pose(self, canonical, state, perturbation=UNPERTURBED):
        means = canonical.means.clone()
        for k, name in enumerate(("upright", "level")):
            rows = canonical.body(k + 1)
            means[rows] = means[rows] + state.instruments[name].pose[:3, 3].float()
        return Posed(means, canonical.quats, canonical.log_scales.exp())

    def label_channels(self, canonical):
        return torch.nn.functional.one_hot(canonical.bodies, 3)[:, 1:].float()


def at(upright_z: float, level_z: float) -> State:
    poses = {}
    for name, z in (("upright", upright_z), ("level", level_z)):
        pose = torch.eye(4, dtype=torch.float64)
        pose[2, 3] = z
        poses[name] = InstrumentState(pose)
    return State(poses)


@pytest.fixture(scope="module")
def bars(request) -> GaussianScene:
    wall = [(x, y, 100.0) for x in np.linspace(-70, 70, 20) for y in np.linspace(-50, 50, 15)]
    upright = [(0.0, y, 0.0) for y in np.linspace(-15, 15, BAR)]
    level = [(x, 0.0, 0.0) for x in np.linspace(-15, 15, BAR)]
    means = torch.tensor([*wall, *upright, *level], dtype=torch.float32)
    size = torch.tensor([4.5] * WALL + [2.0] * 2 * BAR)
    canonical = CanonicalGaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1),
        log_scales=size.log()[:, None].repeat(1, 3),
        opacity_logits=torch.full((len(means),), 4.0),
        sh_dc=torch.ones(len(means), 1, 3),
        sh_rest=torch.zeros(len(means), 15, 3),
        counts=(WALL, BAR, BAR),
    )
    states = (at(60, 70), at(70, 60))
    recorded = Recorded(("0", "1"), ("train",) * 2, states, (CAMERA,) * 2)
    instruments = (Instrument("upright"), Instrument("level"))
    return GaussianScene("bars", canonical, TwoBars(), instruments, recorded, torch.zeros(3))


@pytest.mark.parametrize(("front", "state"), [("upright", at(60, 70)), ("level", at(70, 60))])
def test_the_instrument_in_front_hides_the_other(bars, camera, front, state):
    labeller = CompositedLabels(bars)
    drawing = draw_layers(bars, labeller, state, camera, 0.01)
    labels = {label.name: label for label in annotate(bars, drawing, labeller.names)}
    assert drawing.parts[24, 32] == {"upright": 1, "level": 2}[front]
    back = "level" if front == "upright" else "upright"
    assert labels[front].visibility > 0.97
    assert 0.6 < labels[back].visibility < 0.95
    assert len(labels[back].shape.polygons) == 2  # cut in two by the one in front
    assert labels[back].shape.area < drawing.layers[back].mask.sum()


def test_where_one_instrument_meets_another_all_is_instrument_and_no_edge(bars, camera):
    drawing = draw_layers(bars, CompositedLabels(bars), at(60, 70), camera, 0.01)
    middle = drawing.parts[24].numpy()
    meeting = np.flatnonzero((middle[:-1] != middle[1:]) & (middle[:-1] > 0) & (middle[1:] > 0))
    assert len(meeting) == 2  # level, upright, level
    assert (drawing.share[24, meeting] > LABELS.threshold).all()
    assert not drawing.ignored[24, meeting].any()
    for part in (1, 2):  # at the edges of both
        assert (drawing.ignored & (drawing.parts == part)).any()


def test_both_cast_a_shadow_on_the_tissue_and_none_on_each_other_or_in_the_labels(bars, camera):
    state = at(60, 70)
    bright = draw_layers(bars, CompositedLabels(bars, LABELS.threshold), state, camera, 0.01)
    with torch.no_grad():
        bars.shadow_offsets[0] = torch.tensor([15.0, 15.0, 0.0])
        bars.shadow_strengths[0] = 0.8
    try:
        shaded = draw_layers(bars, CompositedLabels(bars, LABELS.threshold), state, camera, 0.01)
    finally:
        with torch.no_grad():
            bars.shadow_strengths.zero_()
    assert torch.equal(shaded.parts, bright.parts)
    assert torch.equal(shaded.share, bright.share)
    darker = (bright.image - shaded.image).mean(-1)
    assert darker[bright.share > 0.99].abs().max() < 0.02
    tissue = bright.share < 0.01
    assert darker[tissue].max() > 0.2
    dark = (darker > 0.1) & tissue  # a cross of two bars, up and to the left of theirs: the light is on the other side
    across, down = torch.nonzero(dark.any(0))[:, 0], torch.nonzero(dark.any(1))[:, 0]
    assert int(across.max() - across.min()) > 10
    assert int(down.max() - down.min()) > 10
    assert float(across.float().mean()) < camera.cx
    assert float(down.float().mean()) < camera.cy


def test_threshold_labels_tell_instruments_apart_by_nearness(bars, camera):
    state = at(50, 80)
    labeller = ThresholdLabels(bars)
    owners = labeller.owners(state, bars.at(state))
    assert (owners[:WALL] == -1).all()
    assert (owners[WALL : WALL + BAR] == 0).all()
    assert (owners[WALL + BAR :] == 1).all()
    assert draw_layers(bars, labeller, state, camera, 0.01).parts[24, 32] == 1


def test_bodies_sampled_together_are_moved_together(bars):
    sampler = InterpolatedStates([at(60, 70), at(60, 70), at(61, 71)])
    for index in range(10):
        state = sampler(index, np.random.default_rng(index))
        gap = state.instruments["level"].pose[2, 3] - state.instruments["upright"].pose[2, 3]
        assert float(gap) == pytest.approx(10, abs=0.1)
