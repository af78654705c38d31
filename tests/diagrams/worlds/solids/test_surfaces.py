import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splatpilot.diagrams.worlds.solids import surfaces

P_A, P_B = np.array([1.0, 2.0, -0.5]), np.array([1.4, 1.8, 4.0])
AXIS = (P_B - P_A) / np.linalg.norm(P_B - P_A)


def _tube(taper=1.0) -> surfaces.Surfels:
    return surfaces.tube(P_A, P_B, 0.4, (0.1, 0.2), np.random.default_rng(0), taper)


@pytest.mark.parametrize("taper", [1.0, 0.25])
def test_patches_of_a_tube_lie_on_the_cylinder_or_cone(taper):
    surfels = _tube(taper)
    along, length = (surfels.p - P_A) @ AXIS, np.linalg.norm(P_B - P_A)
    assert along.min() >= -1e-12 and along.max() <= length + 1e-12
    radial = surfels.p - P_A - np.outer(along, AXIS)
    radii = 0.4 * (1 - (1 - taper) * along / length)
    np.testing.assert_allclose(np.linalg.norm(radial, axis=1), radii, atol=1e-12)
    if taper == 1.0:
        np.testing.assert_allclose(surfels.n, radial / 0.4, atol=1e-12)
        np.testing.assert_allclose(surfels.t, np.tile(AXIS, (len(surfels), 1)))


def test_patches_of_a_sphere_lie_on_it():
    surfels = surfaces.sphere((1, 2, 3), 0.7, 0.1)
    np.testing.assert_allclose(surfels.p, [1, 2, 3] + 0.7 * surfels.n, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(surfels.n, axis=1), 1)
    np.testing.assert_allclose(np.sum(surfels.t * surfels.n, axis=1), 0, atol=1e-12)


def _transmittance(surfels: surfaces.Surfels, p: NDArray, n: NDArray) -> NDArray:
    """What passes straight through a layer of patches of opacity 0.99 at p (M, 3) along n."""
    offset = p[:, None] - surfels.p
    u = np.sum(offset * surfels.t, axis=-1) / surfels.extent[:, 0]
    v = np.sum(offset * np.cross(surfels.n, surfels.t), axis=-1) / surfels.extent[:, 1]
    front = n @ surfels.n.T > 0
    return np.prod(1 - 0.99 * np.exp(-(u**2 + v**2) / 2) * front, axis=1)


def test_layers_have_no_holes():
    rng = np.random.default_rng(1)
    angle, s = rng.uniform(0, 2 * np.pi, 300), rng.uniform(0.1, 0.9, 300)
    e_1 = np.cross(AXIS, (0, 1, 0)) / np.linalg.norm(np.cross(AXIS, (0, 1, 0)))
    n = np.outer(np.cos(angle), e_1) + np.outer(np.sin(angle), np.cross(AXIS, e_1))
    p = P_A + np.outer(s, P_B - P_A) + 0.4 * n
    assert _transmittance(_tube(), p, n).max() < 0.2
    assert _transmittance(_tube(), p, n).mean() < 0.05

    n = rng.normal(size=(300, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    assert _transmittance(surfaces.sphere((0, 0, 0), 0.7, 0.1), 0.7 * n, n).max() < 0.2

    grid = surfaces.rectangle((0, 0), (3, 2), 0.1, rng)
    ground = surfaces.on_ground(grid, np.zeros(len(grid)), (0.062, 0.062), 0.0)
    p = np.column_stack([rng.uniform(0.2, 1.8, (300, 2)), np.zeros(300)])
    assert _transmittance(ground, p, np.tile((0, 0, 1.0), (300, 1))).max() < 0.2


def test_gaussians_are_as_flat_and_oriented_as_their_patches():
    surfels = _tube()
    colors = np.random.default_rng(2).uniform(size=(len(surfels), 3))
    scene = surfaces.to_gaussians(surfels, colors, 0.7)
    np.testing.assert_allclose(scene.means, surfels.p, atol=1e-6)
    np.testing.assert_allclose(scene.base_colors, colors, atol=1e-6)
    np.testing.assert_allclose(scene.opacities, 0.7)
    np.testing.assert_allclose(scene.scales[:, :2], surfels.extent, rtol=1e-6)
    np.testing.assert_allclose(scene.scales[:, 2], surfaces.THICKNESS)
    R = Rotation.from_quat(np.roll(scene.quats, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(R[..., 0], surfels.t, atol=1e-6)
    np.testing.assert_allclose(R[..., 2], surfels.n, atol=1e-6)


PLOT = surfaces.FloorPlan.of_size(6.0, 4.0, 3.0)


def test_surfaces_face_the_volume_if_they_face_one_of_its_corners():
    rng = np.random.default_rng(0)
    p, n = rng.uniform(-8, 12, (2000, 3)), rng.normal(size=(2000, 3))
    corners = np.array(list(itertools.product((0.0, 6.0), (-2.0, 2.0), (0.0, 3.0))))
    ahead = np.einsum("nk,nck->nc", n, corners - p[:, None]).max(axis=1) > 0
    np.testing.assert_array_equal(PLOT.is_faced(p, n), ahead)
    assert 0.1 < ahead.mean() < 0.9


def test_outside_is_the_distance_in_plan():
    p = np.array([[3.0, 0.0, 9.0], [3.0, 5.0, 1.0], [-3.0, -6.0, 1.0]])
    np.testing.assert_allclose(PLOT.outside(p), [0, 3, 5])
