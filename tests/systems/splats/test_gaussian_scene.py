from typing import Any

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from reference_harmonics import evaluate_sh

from splatpilot.systems.splats.scene import C0, GaussianScene


def random_arrays(N: int = 6, K: int = 4, seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return {
        "means": rng.normal(size=(N, 3)),
        "quats": rng.normal(size=(N, 4)),
        "scales": np.exp(rng.normal(size=(N, 3))),
        "opacities": rng.uniform(0.01, 1, size=N),
        "sh": rng.normal(size=(N, K, 3)),
    }


def covariances(scene: GaussianScene) -> np.ndarray:
    """R diag(s)^2 R^T through Drake, apart from the code under test."""
    result = []
    for quat, scale in zip(scene.quats, scene.scales, strict=True):
        wxyz = quat.astype(float) / np.linalg.norm(quat.astype(float))
        R = RotationMatrix(Quaternion(wxyz)).matrix()
        result.append(R @ np.diag(scale.astype(float) ** 2) @ R.T)
    return np.array(result)


def test_arrays_are_float32_contiguous_with_unit_quaternions():
    """Whatever comes in, float32 contiguous arrays with normalised quaternions are kept."""
    arrays = random_arrays()
    arrays["means"] = np.asfortranarray(arrays["means"])
    scene = GaussianScene(**arrays)
    for name in arrays:
        array = getattr(scene, name)
        assert array.dtype == np.float32 and array.flags.c_contiguous
    quats = arrays["quats"] / np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
    np.testing.assert_allclose(scene.quats, quats, atol=1e-7)
    assert (len(scene), scene.sh_degree) == (6, 1)


def test_tiny_quaternions_are_normalised():
    """A quaternion of length 1e-6 is a rotation like any other."""
    arrays = random_arrays()
    scene = GaussianScene(**arrays | {"quats": (arrays["quats"] * 1e-6).astype(np.float32)})
    np.testing.assert_allclose(scene.quats, GaussianScene(**arrays).quats, atol=1e-6)


def test_from_colors_gives_those_colors_from_everywhere():
    """A scene made from colours shows them in every direction."""
    arrays = random_arrays()
    del arrays["sh"]
    colors = np.random.default_rng(1).uniform(size=(6, 3))
    scene = GaussianScene.from_colors(**arrays, colors=colors)
    np.testing.assert_allclose(0.5 + C0 * scene.sh[:, 0], colors, atol=1e-6)
    np.testing.assert_allclose(scene.base_colors, colors, atol=1e-6)
    assert scene.sh_degree == 0


@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("means", (3, 1), np.nan, r"means\[3, 1\] = nan must be finite \(1 of 6"),
        ("sh", (2, 0, 1), np.inf, r"sh\[2, 0, 1\] = inf must be finite"),
        ("scales", (1, 2), 0.0, r"scales\[1, 2\] = 0\.0 must be > 0 m"),
        ("scales", (1, 2), -0.5, r"scales\[1, 2\] = -0\.5 must be > 0 m.*exponential"),
        ("scales", (4, 0), np.inf, r"scales\[4, 0\] = inf must be finite"),
        ("opacities", (5,), 0.0, r"opacities\[5\] = 0\.0 must be in \(0, 1\].*sigmoid"),
        ("opacities", (0,), 1.5, r"opacities\[0\] = 1\.5 must be in \(0, 1\]"),
        ("quats", (2,), 0.0, r"quats\[2\] = .* must not be zero.*\(1, 0, 0, 0\)"),
    ],
)
def test_bad_values_are_named(name, index, value, message):
    """A bad value is refused with array, index, value, limit and remedy."""
    arrays = random_arrays()
    arrays[name][index] = value
    with pytest.raises(ValueError, match=message):
        GaussianScene(**arrays)


def test_wrong_shapes_and_lengths_are_refused():
    """Arrays of the wrong shape, of different lengths and of an odd number of SH are refused."""
    arrays = random_arrays()
    with pytest.raises(ValueError, match=r"quats has shape \(6, 3\), expected \(N, 4\)"):
        GaussianScene(**arrays | {"quats": arrays["means"]})
    with pytest.raises(ValueError, match=r"sh has shape \(6, 4\), expected \(N, K, 3\)"):
        GaussianScene(**arrays | {"sh": np.zeros((6, 4), np.float32)})
    with pytest.raises(ValueError, match=r"different lengths .*means 6.*scales 5"):
        GaussianScene(**arrays | {"scales": arrays["scales"][:5]})
    with pytest.raises(ValueError, match="5 spherical-harmonic coefficients"):
        GaussianScene(**arrays | {"sh": np.zeros((6, 5, 3), np.float32)})


def test_transform_moves_points_shapes_and_view_dependence():
    """A moved scene has moved centres, rotated covariances, and looks the same from moved eyes."""
    scene = GaussianScene(**random_arrays(K=16))
    X_WO = RigidTransform(RollPitchYaw(0.4, -1.1, 2.3), np.array([1.0, -2.0, 3.0]))
    moved = scene.transformed_by(X_WO)
    R = X_WO.rotation().matrix()
    np.testing.assert_allclose(moved.means, X_WO.multiply(scene.means.T).T, atol=1e-5)
    np.testing.assert_allclose(
        covariances(moved), R @ covariances(scene) @ R.T, rtol=1e-4, atol=1e-4
    )
    d_W = np.random.default_rng(2).normal(size=(50, 1, 3))
    d_W /= np.linalg.norm(d_W, axis=-1, keepdims=True)
    np.testing.assert_allclose(
        evaluate_sh(moved.sh, d_W), evaluate_sh(scene.sh, d_W @ R), atol=1e-5
    )


def test_transform_there_and_back_is_the_identity():
    """Moving by X and by its inverse gives the scene back."""
    scene = GaussianScene(**random_arrays(K=9))
    X = RigidTransform(RollPitchYaw(1, 2, 3), np.array([0.5, 0.25, -1.0]))
    back = scene.transformed_by(X).transformed_by(X.inverse())
    for name in ("means", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(back, name), getattr(scene, name), atol=1e-5)
    np.testing.assert_allclose(covariances(back), covariances(scene), rtol=1e-4, atol=1e-4)


def test_scaled_scene_has_all_lengths_times_the_factor():
    """Centres and deviations grow; what is seen of them from eyes that moved along does not."""
    scene = GaussianScene(**random_arrays(K=9))
    scaled = scene.scaled_by(2.5)
    np.testing.assert_allclose(scaled.means, 2.5 * scene.means, rtol=1e-6)
    np.testing.assert_allclose(covariances(scaled), 2.5**2 * covariances(scene), rtol=1e-4)
    for name in ("quats", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(scaled, name), getattr(scene, name))


def test_merge_places_the_other_scene_and_pads_the_lower_degree():
    """Merging keeps the first scene as it is and puts the other, zero padded, at X_WO."""
    first = GaussianScene(**random_arrays(N=3, K=9))
    other = GaussianScene(**random_arrays(N=2, K=4, seed=5))
    X_WO = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), np.array([10.0, 0.0, 0.0]))
    merged = first.merged_with(other, X_WO)
    placed = other.transformed_by(X_WO)
    assert (len(merged), merged.sh_degree) == (5, 2)
    for name in ("means", "quats", "scales", "opacities"):
        expected = np.concatenate([getattr(first, name), getattr(placed, name)])
        np.testing.assert_array_equal(getattr(merged, name), expected)
    np.testing.assert_array_equal(merged.sh[:3], first.sh)
    np.testing.assert_array_equal(merged.sh[3:, :4], placed.sh)
    assert not merged.sh[3:, 4:].any()
    reverse = other.merged_with(first)
    np.testing.assert_array_equal(reverse.means, np.concatenate([other.means, first.means]))
    assert reverse.sh_degree == 2
