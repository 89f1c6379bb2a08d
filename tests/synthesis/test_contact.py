"""Whether instruments touch the tissue, how deep, and what files say of it. The rod is 2 mm thick about its axis."""

import json
from dataclasses import replace

import pytest
from rod_world import WALL_MM

from neeco.capture.model import InstrumentState, State, Uncertainty
from neeco.labels.drawing import draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.synthesis.contact import RestingTissue, contact_of
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings

ROD_MM = 2.0


@pytest.fixture
def contact(scene, camera):
    def of(state, **changes):
        drawing = draw_layers(scene, CompositedLabels(scene), state, camera, 0.01)
        return contact_of(scene, replace(drawing, **changes), "rod")

    return of


def test_a_tip_that_is_lowered_through_tissue_touches_it_and_its_depth_is_measured(contact, state):
    depths = (-6.0, -4.0, 0.5, 2.0, 4.0)
    labels = [contact(state(z=WALL_MM - ROD_MM + depth, jaw=0.0, roll=0.4)) for depth in depths]
    assert [label["contact"] != "none" for label in labels] == [depth > RestingTissue.touching_mm for depth in depths]
    assert [label["penetration_mm"] for label in labels] == pytest.approx(depths, abs=0.3)
    assert all(0.5 <= label["contact_confidence"] <= 1 for label in labels)
    assert labels[0]["contact_confidence"] > labels[1]["contact_confidence"] > 0.65


def test_jaws_that_close_on_tissue_grasp_it(contact, state):
    touching = {jaw: contact(state(z=WALL_MM, jaw=jaw))["contact"] for jaw in (0.0, 0.1, 0.4, 0.8)}
    assert touching == {0.0: "grasping", 0.1: "grasping", 0.4: "touching", 0.8: "touching"}
    assert contact(state(z=70.0, jaw=0.0))["contact"] == "none"


def test_the_box_is_the_tissue_within_reach(contact, state, camera):
    x, _, width, height = contact(state(z=WALL_MM, jaw=0.0))["contact_box"]
    reach = RestingTissue.reach_mm * camera.fx / WALL_MM  # px
    assert (width, height) == pytest.approx((2 * reach, 2 * reach), abs=3)
    assert x < camera.cx < x + width
    assert contact(state(z=70.0))["contact_box"] is None


def test_an_uncertain_state_is_less_sure_to_touch(contact, state):
    exact = state(z=WALL_MM + 2, jaw=0.0)
    rod = exact.instruments["rod"]
    doubt = Uncertainty((0.1, 0.1, 15.0), (0.1, 0.1, 180.0))
    doubted = State({"rod": InstrumentState(rod.pose, rod.joints, uncertainty=doubt)})
    sure, unsure = contact(exact), contact(doubted)
    assert sure["penetration_mm"] == unsure["penetration_mm"]
    assert 0.5 < unsure["contact_confidence"] < sure["contact_confidence"] - 0.1


def test_nothing_is_said_of_an_instrument_without_a_known_working_end(contact, state):
    assert contact(state(z=WALL_MM), keypoints={}) == {}


def test_data_sets_tell_contact_in_states_and_as_coco_attributes(run, state, tmp_path):
    lines = []
    for z in (70.0, WALL_MM - ROD_MM):
        pose = state(z=z).instruments["rod"].pose.tolist()
        lines.append(json.dumps({"instruments": [{"name": "rod", "pose": pose, "joints": {"jaw_angle": 0.05}}]}))
    (tmp_path / "asked.jsonl").write_text("\n".join(lines))
    asked = {"states": str(tmp_path / "asked.jsonl"), "tissue_check": False, "min_share": 0.0, "max_unobserved": 1.0}
    synthesize(run, tmp_path / "set", Settings(count=2, **asked), formats=("coco",))
    records = [json.loads(line) for line in (tmp_path / "set" / "states.jsonl").read_text().splitlines()]
    stated = [label for record in records for label in record["labels"]]
    assert [label["contact"] for label in stated] == ["none", "grasping"]
    coco = json.loads((tmp_path / "set" / "coco" / "instances.json").read_text())
    for annotation, label in zip(coco["annotations"], stated, strict=True):
        assert annotation["attributes"] == {key: label[key] for key in annotation["attributes"]}
        assert annotation["attributes"].keys() >= {"contact", "contact_confidence", "penetration_mm", "contact_box"}
