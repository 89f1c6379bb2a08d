"""What the training cameras saw, told from depth."""

import torch

from neeco.evaluation.evaluate import observed_depths, unobserved_tissue


def test_tissue_outside_every_training_view_is_unseen_and_the_rest_is_not(world, tmp_path):
    scene = world.TinyScene()
    frames = world.make_capture(tmp_path, scene, ("train", "train")).frames
    coverage = observed_depths(scene, frames)
    unseen, tissue = unobserved_tissue(coverage, scene, frames[0])
    assert tissue.float().mean() > 0.7
    assert (unseen & tissue).float().mean() < 0.02
    far = world.moved(frames[0], world.translation(), world.translation(48.0))  # half a view to the right
    unseen, _ = unobserved_tissue(coverage, scene, far)
    assert unseen[:, -16:].float().mean() > 0.9
    assert unseen[:, :16].float().mean() < 0.2


def test_tissue_behind_the_instrument_is_unseen_until_a_view_from_elsewhere(world, tmp_path):
    scene = world.TinyScene()
    frames = world.make_capture(tmp_path, scene, ("train", "train")).frames
    behind = torch.tensor([[-5.0 / 60 * 100, -3.0 / 60 * 100, 100.0]])  # the bar of frame 0 hides it from frame 0
    assert not observed_depths(scene, frames[:1]).observed(behind).item()
    moved_away = [frames[0], world.moved(frames[0], world.translation(0, 20.0), world.translation())]
    assert observed_depths(scene, moved_away).observed(behind).item()


def test_without_training_views_nothing_was_seen(world, tmp_path):
    scene = world.TinyScene()
    frame = world.make_capture(tmp_path, scene, ("test",)).frames[0]
    unseen, tissue = unobserved_tissue(observed_depths(scene, ()), scene, frame)
    assert torch.equal(unseen, tissue)
