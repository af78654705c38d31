from typing import Any

import numpy as np
import pytest
from baked_scenes import random_scene
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.special import sph_harm_y

from splatpilot.systems.splats.scene import (
    ARRAYS,
    GaussianScene,
    choose_origin,
    harmonic_degree,
    sh_basis,
)


def evaluate_sh(sh: Any, directions: Any) -> np.ndarray:
    sh = np.asarray(sh, dtype=np.float64)
    basis = sh_basis(directions, harmonic_degree(sh.shape[-2]))
    return np.einsum("...k,...kc->...c", basis, sh)


def random_arrays() -> dict[str, Any]:
    scene = random_scene(6, sh_degree=1)
    return {name: getattr(scene, name).astype(float) for name in ARRAYS}


def test_arrays_are_float32_contiguous_with_unit_quaternions():
    arrays = random_arrays()
    arrays |= {"means": np.asfortranarray(arrays["means"]), "quats": 3.0 * arrays["quats"]}
    scene = GaussianScene(**arrays)
    for name in arrays:
        array = getattr(scene, name)
        assert array.dtype == np.float32 and array.flags.c_contiguous
    quats = arrays["quats"] / np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
    np.testing.assert_allclose(scene.quats, quats, atol=1e-7)
    tiny = GaussianScene(**arrays | {"quats": (arrays["quats"] * 1e-6).astype(np.float32)})
    np.testing.assert_allclose(tiny.quats, quats, atol=1e-6)
    assert (len(scene), scene.sh_degree) == (6, 1)


def test_from_colors_gives_those_colors_from_everywhere():
    arrays = random_arrays()
    del arrays["sh"]
    colors = np.random.default_rng(1).uniform(size=(6, 3))
    scene = GaussianScene.from_colors(**arrays, colors=colors)
    np.testing.assert_allclose(scene.base_colors, colors, atol=1e-6)
    assert scene.sh_degree == 0


@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("means", (3, 1), np.nan, r"means\[3, 1\] must be finite, got nan \(1 of 6"),
        ("scales", (1, 2), 0.0, r"scales\[1, 2\] must be > 0 m, got 0\.0"),
        ("opacities", (5,), 0.0, r"opacities\[5\] must be in \(0, 1\], got 0\.0"),
        ("opacities", (0,), 1.5, r"opacities\[0\] must be in \(0, 1\], got 1\.5"),
        ("quats", (2,), 0.0, r"quats\[2\] must be of a length > 0, got \[0"),
        ("quats", None, np.ones((6, 3)), r"quats must be of shape \(N, 4\), got \(6, 3\)"),
        ("sh", None, np.zeros((6, 4)), r"sh must be of shape \(N, K, 3\), got \(6, 4\)"),
        ("scales", None, np.ones((5, 3)), r"of one length.*'means': 6.*'scales': 5"),
        ("sh", None, np.zeros((6, 5, 3)), "1, 4, 9 or 16, got 5"),
    ],
)
def test_invalid_arrays_are_named(name, index, value, message):
    arrays = random_arrays()
    if index is None:
        arrays[name] = value
    else:
        arrays[name][index] = value
    with pytest.raises(ValueError, match=message):
        GaussianScene(**arrays)


def random_directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_transform_moves_points_shapes_and_view_dependence():
    scene = random_scene(6)
    X_WO = RigidTransform(RollPitchYaw(0.4, -1.1, 2.3), np.array([1.0, -2.0, 3.0]))
    moved = scene.transformed_by(X_WO)
    R = X_WO.rotation().matrix()
    np.testing.assert_allclose(moved.means, X_WO.multiply(scene.means.T).T, atol=1e-5)
    expected = R @ scene.covariances @ R.T
    np.testing.assert_allclose(moved.covariances, expected, rtol=1e-4, atol=1e-4)
    d_W = random_directions(50)[:, None]
    expected = evaluate_sh(scene.sh, d_W @ R)
    np.testing.assert_allclose(evaluate_sh(moved.sh, d_W), expected, atol=1e-5)


def test_scaled_scene_has_all_lengths_times_the_factor():
    scene = random_scene(6)
    scaled = scene.scaled_by(2.5)
    np.testing.assert_allclose(scaled.means, 2.5 * scene.means, rtol=1e-6)
    np.testing.assert_allclose(scaled.covariances, 2.5**2 * scene.covariances, rtol=1e-4)
    for name in ("quats", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(scaled, name), getattr(scene, name))


def test_merge_pads_the_lower_degree():
    first, other = random_scene(3, sh_degree=2), random_scene(2, seed=5, sh_degree=1)
    merged = first.merged_with(other)
    for name in ("means", "quats", "scales", "opacities"):
        expected = np.concatenate([getattr(first, name), getattr(other, name)])
        np.testing.assert_array_equal(getattr(merged, name), expected)
    np.testing.assert_array_equal(merged.sh[:3], first.sh)
    np.testing.assert_array_equal(merged.sh[3:, :4], other.sh)
    assert not merged.sh[3:, 4:].any()
    assert other.merged_with(first).sh_degree == 2


def test_basis_is_the_real_part_of_the_complex_harmonics():
    d = random_directions(200)
    polar, azimuth = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    columns = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            Y = sph_harm_y(degree, abs(m), polar, azimuth)
            columns.append(Y.real if m == 0 else np.sqrt(2) * (Y.real if m > 0 else Y.imag))
    np.testing.assert_allclose(sh_basis(d, 3), np.stack(columns, axis=-1), atol=1e-14)
    with pytest.raises(ValueError, match="0 to 3, got 4"):
        sh_basis(d, 4)


@pytest.mark.parametrize(
    ("scale", "offset", "moves"),
    [
        (1.0, 900.0, False),
        (1.0, 1100.0, True),
        (1000.0, 900.0, False),  # as large as it is far
        (1e-3, 0.9, False),
        (1e-3, 5.0, True),  # in units of kilometers
        (0.0, 900.0, False),
        (0.0, 1100.0, True),
    ],
)
def test_origin_moves_to_what_is_far(scale, offset, moves):
    near = np.random.default_rng(0).normal(size=(100, 3))
    positions = scale * near + [offset, 0, 0]
    origin = choose_origin(positions)
    assert origin.any() == moves
    if moves:
        assert np.linalg.norm(np.median(positions - origin, axis=0)) <= 1
    far = choose_origin(5 * near + [456789.3, 812345.6, -283.1])
    np.testing.assert_array_equal(far, np.round(far))
