"""Rotations go there and back, and say the same in every form."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.geometry.rotations import (
    axis_angle_quat,
    matrix_to_quat,
    quat_multiply,
    quat_to_matrix,
    rigid_from_vector,
    rotate_about,
    rotation_from_vector,
    vector_from_rotation,
)

NUMBERS = st.floats(-1, 1, allow_nan=False)


@st.composite
def rotation_vectors(draw: st.DrawFn) -> Tensor:
    """[3] float64, angle below pi."""
    vector = torch.tensor([draw(NUMBERS) for _ in range(3)], dtype=torch.float64)
    return vector * (draw(st.floats(0, 1)) * 3.1 / math.sqrt(3))


@given(rotation_vectors())
def test_matrices_agree_with_scipy(vector: Tensor) -> None:
    expected = torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_matrix())
    assert torch.allclose(rotation_from_vector(vector), expected, atol=1e-12)


@given(rotation_vectors())
def test_vector_to_matrix_and_back(vector: Tensor) -> None:
    assert torch.allclose(vector_from_rotation(rotation_from_vector(vector)), vector, atol=1e-7)


@given(rotation_vectors())
def test_matrix_to_quaternion_and_back(vector: Tensor) -> None:
    matrix = rotation_from_vector(vector)
    quat = matrix_to_quat(matrix)
    assert quat[0] >= 0
    assert torch.allclose(quat.norm(), torch.ones((), dtype=torch.float64))
    assert torch.allclose(quat_to_matrix(quat), matrix, atol=1e-12)


@pytest.mark.parametrize("axis", [(1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (0.6, 0, 0.8)])
def test_half_turns_have_a_quaternion(axis: tuple[float, ...]) -> None:
    matrix = rotation_from_vector(math.pi * torch.tensor(axis, dtype=torch.float64))
    assert torch.allclose(quat_to_matrix(matrix_to_quat(matrix)), matrix, atol=1e-9)


@given(rotation_vectors(), rotation_vectors())
def test_quaternion_product_is_the_product_of_matrices(first: Tensor, second: Tensor) -> None:
    a, b = matrix_to_quat(rotation_from_vector(first)), matrix_to_quat(rotation_from_vector(second))
    product = quat_to_matrix(a) @ quat_to_matrix(b)
    assert torch.allclose(quat_to_matrix(quat_multiply(a, b)), product, atol=1e-12)


@given(rotation_vectors(), st.floats(-3, 3))
def test_turning_about_a_line_leaves_the_line(vector: Tensor, angle: float) -> None:
    axis = rotation_from_vector(vector)[:, 0]
    pivot = torch.tensor([4.0, -5.0, 6.0], dtype=torch.float64)
    on_line = pivot + torch.tensor([-3.0, 0.0, 20.0], dtype=torch.float64)[:, None] * axis
    turned = rotate_about(on_line, axis, pivot, torch.full((3,), angle, dtype=torch.float64))
    assert torch.allclose(turned, on_line, atol=1e-9)


@given(rotation_vectors(), st.floats(-3, 3))
def test_turning_about_a_line_is_a_rotation_about_its_pivot(vector: Tensor, angle: float) -> None:
    axis, angles = rotation_from_vector(vector)[:, 0], torch.full((1,), angle, dtype=torch.float64)
    pivot, point = torch.tensor([[1.0, 2.0, 3.0], [-4.0, 0.5, 9.0]], dtype=torch.float64)
    expected = pivot + quat_to_matrix(axis_angle_quat(axis, angles))[0] @ (point - pivot)
    assert torch.allclose(rotate_about(point[None], axis, pivot, angles)[0], expected, atol=1e-9)


def test_gradients_are_finite_at_no_rotation_at_all() -> None:
    vector = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    (rigid_from_vector(vector)[:3] * torch.arange(12.0).reshape(3, 4)).sum().backward()
    # d/d w_x of the matrix is skew(x): entries (2, 1) - (1, 2) = 9 - 6
    assert vector.grad is not None
    assert torch.allclose(vector.grad, torch.tensor([3.0, -6.0, 3.0, 3.0, 7.0, 11.0], dtype=torch.float64))
