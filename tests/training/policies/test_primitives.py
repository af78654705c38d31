"""Batched primitives against the exact distance field and against rays marched through it."""

import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.systems.collision.analytic_distance_field import AnalyticDistanceField
from splatpilot.systems.collision.shapes import Box, Capsule, Cylinder, HalfSpace, Sphere
from splatpilot.systems.policies.observation import pool_depth
from splatpilot.training.policies.primitives import Primitives
from splatpilot.training.policies.ray_casting import PinholeGrid

LOWER, UPPER = np.array([0.0, -8.0, 0.0]), np.array([20.0, 8.0, 6.0])
R_BC = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def some_world(seed: int) -> list:
    rng = np.random.default_rng(seed)
    shapes: list = [HalfSpace([0, 0, 1], 0.0), HalfSpace([0, 0, -1], -6.0)]
    for _ in range(8):
        a, b, c, d = rng.uniform(LOWER, UPPER, (4, 3))
        way = rng.normal(size=3)
        shapes += [
            Sphere(a, rng.uniform(0.1, 1.0)),
            Box(RigidTransform(RollPitchYaw(rng.uniform(-3, 3, 3)), b), rng.uniform(0.2, 1.0, 3)),
            Cylinder(c, c + way, rng.uniform(0.1, 0.4)),
            Capsule(d, d + way, rng.uniform(0.1, 0.4)),
        ]
    return shapes


@pytest.fixture(scope="module")
def worlds():
    shapes = [some_world(seed) for seed in range(3)]
    shapes.append([HalfSpace([0, 0, 1], 0.0), Sphere([10, 0, 3], 1.0)])  # few kinds
    return shapes, Primitives(shapes, np.tile(LOWER, (4, 1)), np.tile(UPPER, (4, 1)))


def test_distances_and_normals(worlds):
    """The nearest shape's distance and normal are those of the exact field, inside shapes too."""
    shapes, primitives = worlds
    for seed in range(20):
        p_WQ = np.random.default_rng(100 + seed).uniform(LOWER, UPPER, (4, 3))
        distances, normals = primitives.near(torch.tensor(p_WQ, dtype=torch.float32))
        for w in range(4):
            exact = AnalyticDistanceField(shapes[w], LOWER, UPPER).query(p_WQ[w])
            nearest = int(distances[w].argmin())
            assert float(distances[w, nearest]) == pytest.approx(float(exact.distance), abs=1e-5)
            np.testing.assert_allclose(normals[w, :, nearest], exact.gradient, atol=1e-4)


def cameras(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    p = rng.uniform([1, -5, 1], [6, 5, 5], (4, 3))
    R = np.stack([RollPitchYaw(rng.uniform(-0.3, 0.3, 3)).ToRotationMatrix().matrix() @ R_BC] * 4)
    return torch.tensor(p, dtype=torch.float32), torch.tensor(R, dtype=torch.float32)


def marched(shapes: list, p_WC: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Depth along rays (R, 3) by marching on the exact distances."""
    field = AnalyticDistanceField(shapes, LOWER - 60, UPPER + 60)
    depth = np.zeros(len(rays))
    for _ in range(200):
        step = field.distance(p_WC + depth[:, None] * rays) / np.linalg.norm(rays, axis=1)
        depth = np.minimum(depth + step, 50.0)
    return depth


def test_depth_is_where_marched_rays_end(worlds):
    """With pixels of no width, depth is what marching along the rays finds."""
    shapes, primitives = worlds
    grid = PinholeGrid.of(24, 14, 90.0)._replace(half_pixel=0.0)
    p, R = cameras(1)
    distances, _ = primitives.near(p)
    depth = primitives.depth(p, R, grid, distances, nearest=99).numpy()
    for w in range(4):
        rays = grid.directions_C.numpy() @ R[w].numpy().T
        expected = marched(shapes[w], p[w].numpy(), rays)
        seen = expected < 40.0
        assert seen.mean() > 0.5
        # Rays that graze an edge end on either side of it.
        assert np.quantile(np.abs(depth[w] - expected)[seen], 0.97) < 1e-3
        assert (depth[w][expected >= 50.0] > 49.0).all()


def test_wide_pixels_see_what_the_pooled_image_of_a_finer_camera_sees():
    """A coarse image is the least of a finer one, to a few percent where a trunk is."""
    trunk = [Capsule([6.0, 0.4, -1.0], [6.0, 0.4, 9.0], 0.15), HalfSpace([0, 0, 1], 0.0)]
    primitives = Primitives([trunk], LOWER[None], UPPER[None])
    p = torch.tensor([[0.0, 0.0, 2.0]])
    R = torch.tensor(R_BC, dtype=torch.float32)[None]
    distances, _ = primitives.near(p)
    coarse = primitives.depth(p, R, PinholeGrid.of(16, 9, 90.0), distances).reshape(9, 16).numpy()
    fine_grid = PinholeGrid.of(160, 90, 90.0)._replace(half_pixel=0.0)
    fine = primitives.depth(p, R, fine_grid, distances).reshape(90, 160).numpy()
    pooled = pool_depth(fine, 9, 16)
    near = pooled < 7.0
    assert near[:, 6:9].sum() >= 9  # the trunk is thinner than a pixel and seen in every row
    np.testing.assert_array_equal(np.isfinite(coarse), np.isfinite(pooled))
    np.testing.assert_allclose(coarse[near], pooled[near], rtol=0.05)


def test_only_shapes_before_the_camera_count_among_the_nearest():
    """What is behind does not crowd out what is ahead, of more shapes than are looked at."""
    behind = [Sphere([-1.0 - 0.1 * i, 0.0, 2.0], 0.05) for i in range(40)]
    primitives = Primitives([[*behind, Sphere([9.0, 0.0, 2.0], 0.5)]], LOWER[None], UPPER[None])
    p = torch.tensor([[0.0, 0.0, 2.0]])
    R = torch.tensor(R_BC, dtype=torch.float32)[None]
    depth = primitives.depth(p, R, PinholeGrid.of(17, 9, 90.0), primitives.near(p)[0])
    assert float(depth.min()) == pytest.approx(8.5, abs=0.1)


def test_level_camera_beside_an_upright_trunk_gives_numbers():
    """Rays exactly across a cylinder's axis or along a box's face give no NaN."""
    shapes = [
        Cylinder([5, 0, 0], [5, 0, 6], 0.3),
        Box(RigidTransform([8.0, 2.0, 3.0]), [1.0, 1.0, 2.0]),
    ]
    primitives = Primitives([shapes], LOWER[None], UPPER[None])
    p = torch.tensor([[0.0, 0.0, 3.0]])
    R = torch.tensor(R_BC, dtype=torch.float32)[None]
    depth = primitives.depth(p, R, PinholeGrid.of(17, 9, 90.0), primitives.near(p)[0])
    assert not depth.isnan().any()
    middle = depth.reshape(9, 17)[4]
    assert float(middle[8]) == pytest.approx(4.7, abs=1e-5)  # straight ahead, the trunk
    assert float(middle[6]) == pytest.approx(7.5, abs=1e-5)  # y = 4 / 17 z, the box's face
    assert float(depth.min()) == pytest.approx(4.7, abs=1e-5)
