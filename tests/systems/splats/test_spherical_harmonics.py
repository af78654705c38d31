import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.math import RollPitchYaw
from reference_harmonics import evaluate_sh
from scipy.special import sph_harm_y

from splatpilot.systems.splats.scene import C0, degree_of, rotation_matrices, sh_basis


def random_directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_basis_is_the_real_part_of_the_complex_harmonics():
    """Every basis function is the real or imaginary part of SciPy's complex harmonic."""
    d = random_directions(200)
    polar, azimuth = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    columns = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            Y = sph_harm_y(degree, abs(m), polar, azimuth)
            columns.append(Y.real if m == 0 else np.sqrt(2) * (Y.real if m > 0 else Y.imag))
    np.testing.assert_allclose(sh_basis(d, 3), np.stack(columns, axis=-1), atol=1e-14)


def test_basis_keeps_the_published_signs():
    """The first functions have the constants and signs of 3D Gaussian splatting."""
    x, y, z = random_directions(1)[0]
    expected = [0.28209479, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x, 1.09254843 * x * y]
    np.testing.assert_allclose(sh_basis([x, y, z], 3)[:5], expected, rtol=1e-7)


def test_constant_coefficient_is_direction_independent():
    """Coefficients of degree 0 give their value times C0 from everywhere."""
    np.testing.assert_allclose(
        evaluate_sh([[[1.0, 2.0, 3.0]]], random_directions(9)), C0 * np.tile([1, 2, 3], (9, 1))
    )


@settings(max_examples=30, deadline=None)
@given(
    rpy=st.tuples(*[st.floats(-7, 7)] * 3),
    degree=st.integers(0, 3),
    seed=st.integers(0, 2**16),
)
def test_rotated_coefficients_describe_the_rotated_function(rpy, degree, seed):
    """Rotated coefficients evaluate to what the original gives in turned-back directions."""
    R_WO = RollPitchYaw(*rpy).ToRotationMatrix().matrix()
    sh_O = np.random.default_rng(seed).normal(size=((degree + 1) ** 2, 3))
    matrices = rotation_matrices(R_WO, degree)
    sh_W = np.concatenate(
        [M @ sh_O[k * k : (k + 1) ** 2] for k, M in zip(range(degree + 1), matrices, strict=True)]
    )
    d_W = random_directions(20, seed)
    d_O = d_W @ R_WO
    np.testing.assert_allclose(evaluate_sh(sh_W, d_W), evaluate_sh(sh_O, d_O), atol=1e-12)
    for M in matrices:
        np.testing.assert_allclose(M @ M.T, np.eye(len(M)), atol=1e-12)


def test_degree_of_counts():
    """1, 4, 9 and 16 coefficients belong to degrees 0 to 3, other numbers are refused."""
    assert [degree_of(K) for K in (1, 4, 9, 16)] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match=r"5 .* coefficients.*1, 4, 9 or 16"):
        degree_of(5)
    with pytest.raises(ValueError, match="degree 4"):
        sh_basis([0, 0, 1], 4)
