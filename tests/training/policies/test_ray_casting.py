import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot import _native
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import (
    AnalyticDistanceField,
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    Shape,
    ShapeUnion,
    Sphere,
)
from splatpilot.systems.policies.base import pool_depth
from splatpilot.training.policies.ray_casting import EsdfGeometry, Grids, PixelRays, ShapeGeometry

LOWER, UPPER = np.array([0.0, -8.0, 0.0]), np.array([20.0, 8.0, 6.0])
R_BC = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
RAYS = PixelRays.of(24, 14, 90.0)
THIN = RAYS._replace(half_pixel=0.0)


def some_world(seed: int, count: int = 8) -> list[Shape]:
    rng = np.random.default_rng(seed)
    shapes: list[Shape] = [HalfSpace([0, 0, 1], 0.0), HalfSpace([0, 0, -1], -6.0)]
    for _ in range(count):
        a, b, c, d = rng.uniform(LOWER, UPPER, (4, 3))
        axis = rng.normal(size=3)
        shapes += [
            Sphere(a, rng.uniform(0.1, 1.0)),
            Box(RigidTransform(RollPitchYaw(rng.uniform(-3, 3, 3)), b), rng.uniform(0.2, 1.0, 3)),
            Cylinder(c, c + axis, rng.uniform(0.1, 0.4)),
            Capsule(d, d + axis, rng.uniform(0.1, 0.4)),
        ]
    return shapes


def floats(values: np.ndarray | list) -> torch.Tensor:
    return torch.tensor(np.array(values), dtype=torch.float32)


def cameras(seed: int, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    p = rng.uniform([1, -5, 1], [6, 5, 5], (count, 3))
    angles = rng.uniform(-0.3, 0.3, (count, 3))
    R = [RollPitchYaw(rpy).ToRotationMatrix().matrix() @ R_BC for rpy in angles]
    return floats(p), floats(R)


def one_image(geometry, rays: PixelRays, p_WC: list[float]) -> np.ndarray:
    """The depth (R,) that a level camera looking along x sees in the only world."""
    return geometry.depth(floats([p_WC]), floats([R_BC]), rays, torch.arange(1))[0].numpy()


@pytest.fixture(scope="module")
def worlds() -> tuple[list[list[Shape]], ShapeGeometry]:
    shapes = [some_world(seed, count) for seed, count in ((0, 8), (1, 8), (2, 60))]
    shapes.append([HalfSpace([0, 0, 1], 0.0), Sphere([10, 0, 3], 1.0)])  # few kinds
    return shapes, ShapeGeometry(shapes)


def marched(distance, p_WC: np.ndarray, rays_W: np.ndarray) -> np.ndarray:
    """Depth (R,) along rays (R, 3) by marching on exact distances; 50 m where nothing is."""
    depth = np.zeros(len(rays_W))
    for _ in range(200):
        step = distance(p_WC + depth[:, None] * rays_W) / np.linalg.norm(rays_W, axis=1)
        depth = np.minimum(depth + step, 50.0)
    return depth


def test_depth_is_where_marched_rays_end(worlds):
    shapes, geometry = worlds
    p, R = cameras(1, 4)
    depth = geometry.depth(p, R, THIN, torch.arange(4)).numpy()
    for w in range(4):
        field = AnalyticDistanceField(shapes[w], LOWER - 60, UPPER + 60)
        expected = marched(field.distance, p[w].numpy(), THIN.directions_C @ R[w].numpy().T)
        seen = expected < 40.0
        assert seen.mean() > 0.4
        # Rays that graze an edge end on either side of it.
        assert np.quantile(np.abs(depth[w] - expected)[seen], 0.97) < 1e-3
        assert (depth[w][expected >= 50.0] > 49.0).all()


@pytest.mark.parametrize(
    "shape",
    [
        Capsule([6.0, 0.4, -1.0], [6.0, 0.4, 9.0], 0.15),
        Cylinder([6.0, 0.4, -1.0], [6.0, 0.4, 9.0], 0.15),
        Box(RigidTransform([6.0, 0.4, 4.0]), [0.3, 0.3, 10.0]),
        Sphere([6.0, 0.4, 2.0], 1.0),
    ],
)
def test_wide_pixels_see_what_the_pooled_image_of_a_finer_camera_sees(shape):
    geometry, p_WC = ShapeGeometry([[shape, HalfSpace([0, 0, 1], 0.0)]]), [0.0, 0.0, 2.0]
    coarse = one_image(geometry, PixelRays.of(16, 9, 90.0), p_WC).reshape(9, 16)
    fine = one_image(geometry, PixelRays.of(160, 90, 90.0)._replace(half_pixel=0.0), p_WC)
    pooled = pool_depth(fine.reshape(90, 160), 9, 16)
    near = pooled < 7.0
    assert near[:, 6:9].sum() >= 9  # a trunk is thinner than a pixel and seen in every row
    outlines = 0.05 if isinstance(shape, Sphere) else 0.0
    assert (np.isfinite(coarse) != np.isfinite(pooled)).mean() <= outlines
    assert (np.abs(coarse - pooled)[near] > 0.05 * pooled[near]).mean() <= outlines


def test_the_nearest_of_many_are_the_first_when_all_are_sorted():
    shapes = some_world(4, 60)
    p_WQ = np.random.default_rng(40).uniform(LOWER, UPPER, (50, 3))
    distances, normals = ShapeGeometry([shapes]).nearest(floats(p_WQ), torch.arange(50) * 0, 4)
    exact = np.array([ShapeUnion.of([s]).distance(p_WQ) for s in shapes]).T  # (50, M)
    order = np.argsort(exact, axis=1)[:, :4]
    np.testing.assert_allclose(distances, np.take_along_axis(exact, order, 1), atol=1e-5)
    for n, row in enumerate(order):
        for k, shape in enumerate(shapes[i] for i in row):
            gradient = ShapeUnion.of([shape]).nearest(p_WQ[n])[1]
            np.testing.assert_allclose(normals[n, k], gradient, atol=1e-3)


def test_normals_are_unit_vectors_where_distances_have_a_ridge_and_0_of_missing_shapes():
    sphere, log, post = Sphere([1, 1, 1], 0.5), Capsule([0] * 3, [2, 0, 0], 0.5), [0.0, 0.0, 3.0]
    geometry = ShapeGeometry([[sphere], [log], [Cylinder([0, 0, 0], [0, 0, 6], 0.5)]])
    points = floats([[1, 1, 1], [1, 0, 0], post])
    distances, normals = geometry.nearest(points, torch.arange(3), 2)
    np.testing.assert_allclose(normals[:, 0].norm(dim=1), 1.0, atol=1e-6)
    assert normals[1, 0, 0] == normals[2, 0, 2] == 0.0
    assert (distances[:, 1] == torch.inf).all() and not normals[:, 1].any()


def field_of(shapes: list[Shape]) -> Esdf:
    return esdf_from_distance_field(AnalyticDistanceField(shapes, LOWER, UPPER), 0.1)


def test_distance_fields_show_what_their_shapes_do_from_inside_and_outside():
    shapes = [
        HalfSpace([0, 0, 1], 0.0),
        Sphere([6, 1, 3], 0.8),
        Capsule([9, -2, 0], [9, -2, 6], 0.3),
        Box(RigidTransform([12.0, 3.0, 2.0]), [1.0, 2.0, 4.0]),
    ]
    exact, field = ShapeGeometry([shapes]), EsdfGeometry([field_of(shapes)])
    for rays in (THIN, PixelRays.of(16, 9, 90.0)):
        expected, seen = (one_image(g, rays, [1.0, 0.0, 2.0]) for g in (exact, field))
        rays_W = rays.directions_C @ R_BC.T
        p_WP = [1.0, 0.0, 2.0] + np.minimum(expected, 99.0)[:, None] * rays_W
        known = ((p_WP > LOWER - 0.01) & (p_WP < UPPER)).all(axis=1) & (seen < np.inf)
        assert known.sum() > 75
        off = np.abs(seen - expected)[known] - 2.0 * rays.half_pixel * expected[known]
        assert np.quantile(off, 0.9) < 0.1  # the others are at outlines
        assert (seen[~known] == np.inf).mean() > 0.95
    geometry = EsdfGeometry([field_of([Sphere([4, 0, 3], 1.0)])])
    rays = PixelRays.of(5, 3, 60.0)._replace(half_pixel=0.0)
    assert one_image(geometry, rays, [-5.0, 0.0, 3.0])[7] == pytest.approx(8.0, abs=0.05)
    assert (one_image(geometry, rays, [25.0, 0.0, 3.0]) == np.inf).all()


def test_grids_are_interpolated_as_the_distance_field_is():
    fields = [field_of(some_world(seed)) for seed in range(2)]
    geometry = EsdfGeometry(fields)
    p_WQ = np.random.default_rng(0).uniform(LOWER + 0.06, UPPER - 0.06, (300, 3))
    for w, field in enumerate(fields):
        expected = field.query(p_WQ)
        world = torch.arange(300) * 0 + w
        distances, gradients = geometry.interpolate(floats(p_WQ), world)
        np.testing.assert_allclose(distances, expected.distance, atol=2e-5)
        # Points within rounding of a cell's face may have the gradient of its other side.
        off = np.abs(gradients.numpy() - expected.gradient).max(axis=1)
        assert np.quantile(off, 0.98) < 1e-3
    edge, beyond = floats([[0.05, 0.0, 3.0]]), floats([[-7.0, 0.0, 3.0]])
    for a, b in zip(
        *(geometry.interpolate(p, torch.arange(1)) for p in (edge, beyond)), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_threads_and_instructions_do_not_change_results():
    shapes, fields = some_world(5, 30), [field_of(some_world(5))]
    p, R = cameras(5, 13)
    world, results = torch.arange(13) * 0, []
    for setting in (
        *({"threads": n} for n in (1, 2, 3)),
        *({"simd": level} for level in _native.simd_levels()),
    ):
        exact, field = ShapeGeometry([shapes], **setting), EsdfGeometry(fields, **setting)
        images = exact.depth(p, R, RAYS, world), field.depth(p, R, RAYS, world)
        results.append([*images, *exact.nearest(p, world, 4), *field.nearest(p, world, 1)])
    for result in results[1:]:
        assert all(map(torch.equal, result, results[0]))


def test_bad_input_is_refused():
    geometry = ShapeGeometry([some_world(0)])
    field = EsdfGeometry([field_of(some_world(0))])
    p, R = cameras(0, 2)
    world, twice = torch.zeros(2, dtype=int), RAYS._replace(directions_C=2.0 * RAYS.directions_C)
    outside = [torch.tensor(index) for index in ([0, 1], [-1, 0])]
    calls = [lambda g=g, w=w: g.nearest(p, w, 1) for g in (geometry, field) for w in outside]
    calls += [lambda g=g, w=w: g.depth(p, R, RAYS, w) for g in (geometry, field) for w in outside]
    for call, message in (
        *((call, r"world must be in \[0, 1\), got -?1") for call in calls),
        (lambda: geometry.nearest(p, world[:1], 1), "differ in number"),
        (lambda: geometry.depth(p, R[:1], RAYS, world), "differ in shape"),
        (lambda: geometry.nearest(p, world, 17), r"in \[1, 16\]"),
        (lambda: geometry.depth(p, R, twice, world), "depth 1"),
        (lambda: ShapeGeometry([[]], threads=0), "threads"),
        (lambda: Grids([np.zeros((1, 2, 2))], [LOWER], [0.1]), "2 to 32768 voxels"),
        (lambda: Grids([np.zeros((2, 2, 2))], [LOWER], [0.0]), "voxel sizes must be"),
        (lambda: ShapeGeometry([[Sphere([0, 0, 0], -1.0)]]), r"Sphere\.radius"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    nowhere = floats([[torch.nan] * 3] * 2)
    for g in (geometry, field):
        assert g.depth(nowhere, R, RAYS, world).shape == (2, 24 * 14)
