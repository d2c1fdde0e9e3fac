"""The warp's elastic term against NumPy's decomposition in float64: equal, zero and mirrored singular values, huge and NaN."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from avatar.warp import elastic, right_singular_vectors


def twin_elastic(matrix: np.ndarray) -> tuple[float, np.ndarray]:
    """Value and gradient from NumPy's decomposition in float64."""
    u, s, vt = np.linalg.svd(matrix.astype(np.float64))
    x = sum(math.log(max(value, 1e-6)) ** 2 for value in s) / 0.03**2
    slope = [2 * math.log(value) / value / 0.03**2 if value > 1e-6 else 0.0 for value in s]
    return 2 * (x / (x + 4)), 8 / (x + 4) ** 2 * (u @ np.diag(slope) @ vt)


def turned(angle: float) -> np.ndarray:
    return Rotation.from_rotvec(angle * np.array([2.0, -1.0, 2.0]) / 3).as_matrix()


ELASTIC_CASES = {
    "identity": np.eye(3),
    "rotation": turned(2.0),
    "half turn": np.diag([1.0, -1.0, -1.0]),
    "reflection": np.diag([1.0, 1.0, -1.0]),
    "turned reflection": -turned(0.7),
    "equal, not one": 1.02 * turned(0.3),
    "two equal": turned(0.4) @ np.diag([1.03, 1.03, 0.98]) @ turned(-1.1),
    "two nearly equal": turned(0.4) @ np.diag([1.03, 1.03001, 0.98]) @ turned(-1.1),
    "near the identity": np.eye(3) + 1e-3 * np.random.default_rng(0).normal(size=(3, 3)),
    "usual": np.eye(3) + 0.05 * np.random.default_rng(1).normal(size=(3, 3)),
    "shear": np.array([[1.0, 5.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "equal columns": np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0], [3.0, 3.0, 1.0]]),
    "rank two": np.diag([1.1, 0.0, 0.9]),
    "rank one": np.outer([1.0, 2.0, -1.0], [0.5, 1.0, 2.0]),
    "zero": np.zeros((3, 3)),
    "tiny": 1e-30 * turned(0.5),
    "huge": 1e30 * turned(0.5),
    "huge and small": np.diag([1e6, 1.0, 1e-3]),
}


def test_the_naive_gradient_breaks_where_singular_values_are_equal() -> None:
    jacobian = torch.eye(3).requires_grad_()
    u, s, vt = torch.linalg.svd(jacobian)
    ((u * s.log()) @ vt).square().sum().backward()  # the matrix logarithm by singular vectors
    assert not torch.isfinite(jacobian.grad).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ELASTIC_CASES)
def test_elastic_and_its_gradient_equal_the_twin(name: str, dtype: torch.dtype) -> None:
    jacobian = torch.from_numpy(ELASTIC_CASES[name])[None].to(dtype).requires_grad_()
    value = elastic(jacobian)[0]
    value.backward()
    expected, gradient = twin_elastic(jacobian[0].detach().numpy())
    rounding = 3e-5 if dtype == torch.float32 else 1e-10  # 3e-7 of a singular value, by the scale of 0.03, three times
    assert math.sqrt(value) == pytest.approx(math.sqrt(expected), abs=rounding)
    assert torch.isfinite(jacobian.grad).all()
    if name in ("rank one", "equal columns"):  # in float32 a zero may round to more than 1e-6, whose gradient is steep
        assert jacobian.grad.abs().max() < 10
    else:
        np.testing.assert_allclose(jacobian.grad[0], gradient, atol=10 * rounding * (1 + np.abs(gradient).max()))


def test_elastic_is_exactly_zero_at_the_identity() -> None:
    jacobian = torch.eye(3).expand(2, 3, 3).clone().requires_grad_()
    value = elastic(jacobian)
    value.sum().backward()
    assert not value.any() and not jacobian.grad.any()


def test_elastic_gradient_equals_finite_differences() -> None:
    jacobian = torch.eye(3).double() + 0.05 * torch.randn(5, 3, 3).double()
    assert torch.autograd.gradcheck(elastic, jacobian.requires_grad_(), eps=1e-7, atol=1e-5)


def test_elastic_of_many_in_float32() -> None:
    torch.manual_seed(0)
    spread = torch.logspace(-4, 0.5, 3000)[:, None, None]
    jacobian = (torch.eye(3) + spread * torch.randn(3000, 3, 3)).requires_grad_()
    value = elastic(jacobian)
    value.sum().backward()
    pairs = [twin_elastic(matrix) for matrix in jacobian.detach().numpy()]
    np.testing.assert_allclose(value.detach().sqrt(), np.sqrt([pair[0] for pair in pairs]), atol=3e-5)
    np.testing.assert_allclose(jacobian.grad, [pair[1] for pair in pairs], rtol=1e-3, atol=2e-3)


def test_elastic_passes_nan_and_keeps_it_to_its_point() -> None:
    jacobian = torch.eye(3).repeat(3, 1, 1)
    jacobian[1, 0, 2], jacobian[2, 0, 0] = torch.nan, torch.inf
    assert torch.isfinite(elastic(jacobian)).tolist() == [True, False, False]


def test_right_singular_vectors_are_orthonormal_and_diagonalise() -> None:
    torch.manual_seed(0)
    matrices = torch.randn(400, 3, 3).double() * torch.logspace(-12, 0, 3).double()
    matrices = matrices[:, :, torch.randperm(3)] / matrices.abs().amax((1, 2), keepdim=True)
    vectors = right_singular_vectors(matrices)
    torch.testing.assert_close(vectors.mT @ vectors, torch.eye(3).double().expand(400, 3, 3), rtol=0, atol=1e-13)
    rotated = matrices @ vectors
    rotated = rotated / rotated.norm(dim=1, keepdim=True)
    assert (rotated.mT @ rotated - torch.eye(3)).abs().max() < 1e-9
