"""Points fall where a pinhole camera shows them, as tensors and as arrays."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from neeco.geometry.camera import Camera
from neeco.geometry.projection import in_image, pixel_centers, project, project_world, unproject_world
from neeco.raster.reference import camera_from_world


def a_camera() -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.2, -0.4, 0.1]).as_matrix())
    pose[:3, 3] = torch.tensor([5.0, -3.0, -90.0])
    return Camera(pose, 200.0, 210.0, 80.0, 64.0, 160, 128)


def test_a_point_on_the_axis_falls_on_the_principal_point_and_one_beside_it_by_its_slope():
    u, v = project(np.array([[0.0, 0.0, 50.0], [10.0, -5.0, 50.0]]), 100.0, 200.0, 32.0, 24.0)
    assert u.tolist() == [32.0, 52.0]
    assert v.tolist() == [24.0, 4.0]


def test_tensors_and_arrays_agree_to_the_last_bit_and_follow_the_stated_order():
    points = np.random.default_rng(0).normal(size=(50, 3)) + np.array([0.0, 0.0, 9.0])
    u, v = project(points, 101.3, 99.7, 31.1, 23.9)
    tensor_u, tensor_v = project(torch.from_numpy(points), 101.3, 99.7, 31.1, 23.9)
    assert np.array_equal(tensor_u.numpy(), u)
    assert np.array_equal(tensor_v.numpy(), v)
    assert np.array_equal(u, points[:, 0] / points[:, 2] * 101.3 + 31.1)


def test_every_camera_may_have_its_own_intrinsics():
    points = torch.tensor([[1.0, 1.0, 2.0], [2.0, 4.0, 4.0]]).expand(3, 2, 3)
    fx = torch.tensor([[1.0], [10.0], [100.0]])
    u, _ = project(points, fx, fx, 0.0, 0.0)
    assert u.tolist() == [[0.5, 0.5], [5.0, 5.0], [50.0, 50.0]]


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_points_behind_are_held_at_the_nearest_depth_when_asked(kind):
    points = kind([[1.0, 2.0, -4.0], [1.0, 2.0, 0.5]])
    u, v = project(points, 10.0, 10.0, 0.0, 0.0, nearest=1.0)
    assert u.tolist() == [10.0, 10.0]
    assert v.tolist() == [20.0, 20.0]
    assert project(points, 10.0, 10.0, 0.0, 0.0)[0].tolist() == [-2.5, 20.0]


def test_points_of_the_world_fall_where_the_reference_draws_them():
    camera = a_camera()
    points = torch.from_numpy(np.random.default_rng(1).uniform(-20, 20, (30, 3)))
    pixels, depths = project_world(points, camera)
    rotation, translation = camera_from_world(camera.world_from_camera)
    local = points @ rotation.T + translation
    assert torch.allclose(depths, local[:, 2])
    assert torch.allclose(pixels[:, 0], camera.fx * local[:, 0] / local[:, 2] + camera.cx)
    assert torch.allclose(pixels[:, 1], camera.fy * local[:, 1] / local[:, 2] + camera.cy)
    as_arrays = project_world(points.numpy(), camera)
    assert np.allclose(as_arrays[0], pixels)
    assert np.allclose(as_arrays[1], depths)


def test_single_points_and_batches_keep_their_shape_and_type():
    camera = a_camera()
    pixel, depth = project_world(np.zeros(3), camera)
    assert pixel.shape == (2,)
    assert math.isfinite(depth)
    pixels, depths = project_world(torch.zeros(4, 5, 3), camera)
    assert pixels.shape == (4, 5, 2)
    assert depths.shape == (4, 5)
    assert pixels.dtype == torch.float32


def test_unprojecting_takes_projecting_back():
    camera = a_camera()
    pixels = pixel_centers(3, 4).double()
    depths = 40 + torch.arange(12.0, dtype=torch.float64).reshape(3, 4)
    points = unproject_world(pixels, depths, camera)
    again, deep = project_world(points, camera)
    assert pixels[1, 2].tolist() == [2.5, 1.5]
    assert torch.allclose(again, pixels, atol=1e-9)
    assert torch.allclose(deep, depths, atol=1e-9)


def test_the_image_holds_what_lies_before_the_camera_and_within_its_edges():
    camera = a_camera()
    corners = torch.tensor([[0.5, 0.5], [camera.width - 0.5, camera.height - 0.5], [-0.5, 3.0], [3.0, camera.height]])
    points = unproject_world(corners.double(), torch.full((4,), 50.0, dtype=torch.float64), camera)
    assert in_image(points, camera).tolist() == [True, True, False, False]
    behind = 2 * camera.world_from_camera[:3, 3].double() - points
    assert not bool(in_image(behind, camera).any())


def test_a_resized_camera_sees_points_at_the_same_share_of_the_image():
    camera = a_camera()
    points = torch.from_numpy(np.random.default_rng(3).uniform(-20, 20, (30, 3)))
    pixels, _ = project_world(points, camera)
    resized, _ = project_world(points, camera.resized(480, 64))
    assert torch.allclose(resized, pixels * torch.tensor([3.0, 0.5], dtype=torch.float64))
    assert camera.resized(480, 64).resized(160, 128) == camera
