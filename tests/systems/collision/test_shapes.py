import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake import geometry
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.shapes import (
    AnalyticDistanceField,
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    MovingSpheres,
    ShapeUnion,
    Sphere,
)

X_WO = RigidTransform(RollPitchYaw(0.4, -0.7, 1.2), np.array([0.3, -0.2, 0.5]))
A, B = np.array([-0.5, 0.2, -0.6]), np.array([0.4, -0.3, 0.9])
SHAPES = {
    "sphere": Sphere(np.array([0.1, 0.2, -0.3]), 0.8),
    "capsule": Capsule(A, B, 0.4),
    "cylinder": Cylinder(A, B, 0.4),
    "box": Box(X_WO, np.array([0.6, 1.0, 1.4])),
    "half space": HalfSpace(np.array([1.0, 2.0, -2.0]), 0.1),
}


def field_of(*shapes) -> AnalyticDistanceField:
    return AnalyticDistanceField(shapes, np.full(3, -3.0), np.full(3, 3.0))


AXIS = RigidTransform(RotationMatrix.MakeFromOneVector(B - A, 2), 0.5 * (A + B))
LENGTH = np.linalg.norm(B - A)
DRAKES = {
    "sphere": (RigidTransform([0.1, 0.2, -0.3]), geometry.Sphere(0.8)),
    "capsule": (AXIS, geometry.Capsule(0.4, LENGTH)),
    "cylinder": (AXIS, geometry.Cylinder(0.4, LENGTH)),
    "box": (X_WO, geometry.Box(0.6, 1.0, 1.4)),
    "half space": (
        geometry.HalfSpace.MakePose([1.0, 2.0, -2.0], np.array([1.0, 2.0, -2.0]) / 30),
        geometry.HalfSpace(),
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_distances_are_drakes(name):
    scene_graph = geometry.SceneGraph()
    source = scene_graph.RegisterSource("test")
    instance = geometry.GeometryInstance(*DRAKES[name], "shape")
    anchored = scene_graph.RegisterAnchoredGeometry(source, instance)
    scene_graph.AssignRole(source, anchored, geometry.ProximityProperties())
    query = scene_graph.get_query_output_port().Eval(scene_graph.CreateDefaultContext())
    p_WQ = np.random.default_rng(1).uniform(-1.5, 1.5, (400, 3))
    expected = [query.ComputeSignedDistanceToPoint(p)[0].distance for p in p_WQ]
    distance = field_of(SHAPES[name]).distance(p_WQ)
    np.testing.assert_allclose(distance, expected, atol=1e-12)
    assert (distance < 0.0).any() and (distance > 0.0).any()


@pytest.mark.parametrize("name", SHAPES)
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_gradient_is_the_derivative_of_the_distance(name, seed):
    field = field_of(SHAPES[name])
    p = np.random.default_rng(seed).uniform(-1.8, 1.8, (120, 3))
    sample = field.query(p)
    np.testing.assert_array_equal(sample.distance, field.distance(p))
    np.testing.assert_allclose(np.linalg.norm(sample.gradient, axis=1), 1.0, atol=1e-12)
    step = 1e-6
    forward, backward = (
        [(field.distance(p + s * step * e) - sample.distance) / (s * step) for e in np.eye(3)]
        for s in (1.0, -1.0)
    )
    forward, backward = np.transpose(forward), np.transpose(backward)
    smooth = np.abs(forward - backward).max(axis=1) < 1e-3  # not on the medial axis
    assert smooth.mean() > 0.9
    difference = 0.5 * (forward + backward)
    np.testing.assert_allclose(sample.gradient[smooth], difference[smooth], atol=1e-3)


def test_gradient_is_a_unit_vector_where_it_is_not_unique():
    z = np.array([0.0, 0.0, 1.0])
    for shape in (Sphere(0.0 * z, 1.0), Capsule(-z, z, 0.5), Cylinder(-z, z, 0.5)):
        gradient = field_of(shape).query([[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]]).gradient
        np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0)
        if not isinstance(shape, Sphere):
            np.testing.assert_allclose(gradient @ z, 0.0, atol=1e-12)
    box = field_of(Box(RigidTransform(), np.full(3, 2.0))).query([[0.0] * 3, [1.0, 1.0, 1.0]])
    np.testing.assert_allclose(np.linalg.norm(box.gradient, axis=1), 1.0)


def test_union_is_the_minimum_over_its_shapes():
    lower, upper = np.array([-2.0, -2.0, -1.0]), np.array([36.0, 16.0, 6.0])
    random, shapes = np.random.default_rng(5), list(SHAPES.values())
    for kind in [Cylinder, Capsule] * 15:
        base = np.r_[random.uniform(0.0, [36.0, 16.0]), -1.0]
        top = base + np.r_[random.normal(size=2) * 0.3, 8.0]
        shapes.append(kind(base, top, float(random.uniform(0.1, 0.4))))
    union = AnalyticDistanceField(shapes, lower, upper)
    p = random.uniform(lower, upper, (1500, 3))
    p = np.concatenate([p, [10.0, 5.0, 2.0] + 0.4 * random.random((1500, 3))])
    alone = np.stack([ShapeUnion.of([shape]).distance(p) for shape in shapes])
    expected, nearest = alone.min(axis=0), alone.argmin(axis=0)
    sample = union.query(p)
    np.testing.assert_allclose(sample.distance, expected, rtol=0.0, atol=1e-14)
    np.testing.assert_array_equal(union.distance(p), sample.distance)
    gradients = np.stack([ShapeUnion.of([shape]).nearest(p)[1] for shape in shapes])
    np.testing.assert_allclose(sample.gradient, gradients[nearest, np.arange(len(p))], atol=1e-9)
    for row in (0, 700):
        broken = p.copy()
        broken[row, 1] = np.nan
        others = np.arange(len(p)) != row
        np.testing.assert_array_equal(union.distance(broken)[others], sample.distance[others])
    assert union.query(p[17]).distance == pytest.approx(expected[17])


def test_states_and_bounds():
    field = field_of(SHAPES["sphere"])
    p = [[0.1, 0.2, -0.3], [2.9, 0.0, 0.0], [3.1, 0.0, 0.0], [np.nan, 0.0, 0.0]]
    sample = field.query(p)
    FREE, OCCUPIED, _, OUTSIDE = FieldState
    np.testing.assert_array_equal(sample.state, [OCCUPIED, FREE, OUTSIDE, OUTSIDE])
    np.testing.assert_array_equal(np.isnan(sample.distance), [False, False, True, True])
    np.testing.assert_array_equal(sample.gradient[2:], 0.0)
    assert sample.state.dtype == np.uint8


def test_an_empty_union_is_infinitely_far():
    field = field_of()
    for p in (np.zeros(3), np.zeros((600, 3))):
        assert (field.distance(p) == np.inf).all()
        assert (field.query(p).state == FieldState.FREE).all()


def spheres(radii, path, period=0.1):
    return lambda: MovingSpheres(radii, [path], period)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: field_of(Sphere(np.zeros(3), 0.0)), "Sphere.radius must be .* got 0.0"),
        (lambda: field_of(Cylinder(A, A, 1.0)), "Cylinder.p_WB must be apart"),
        (lambda: field_of(Box(X_WO, [1.0, 0.0, 1.0])), "Box.size must be > 0"),
        (lambda: field_of(HalfSpace(np.zeros(3), 1.0)), "normal must be a direction"),
        (lambda: field_of(Sphere([0.0, np.nan, 0.0], 1.0)), "Sphere.p_WO must be"),
        (spheres([1.0, 1.0], np.zeros((1, 3))), "paths must be 2"),
        (spheres([1.0], np.zeros((0, 3))), "at least one row"),
        (spheres([0.0], np.zeros((1, 3))), "radii must be > 0"),
        (spheres([1.0], np.zeros((1, 3)), 0.0), "period must be > 0"),
        (lambda: AnalyticDistanceField([], np.zeros(3), [1.0, 0.0, 1.0]), "upper_W must be above"),
    ],
)
def test_impossible_shapes_paths_and_bounds_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


PATHS = [
    np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]),
    np.array([[-3.0, 0, 0]]),
    np.array([[0.0, 3, 0], [np.inf] * 3]),
]
SPHERES = MovingSpheres([0.5, 0.25, 1.0], PATHS, period=0.5)
STANDING = Sphere([0.0, -2.0, 1.0], 0.7)


def test_paths_are_followed_there_and_back():
    x = [SPHERES.centers(0.5 * step)[0, 0] for step in range(9)]
    assert x == [0, 1, 2, 1, 0, 1, 2, 1, 0]
    np.testing.assert_array_equal(SPHERES.centers(0.74), SPHERES.centers(0.5))
    assert SPHERES.centers(sum([0.1] * 15))[0, 0] == 1  # in spite of rounding
    np.testing.assert_array_equal(SPHERES.centers(7.3)[1], PATHS[1][0])
    assert np.isinf(SPHERES.centers(0.5)[2]).all() and np.isfinite(SPHERES.centers(1.0)[2]).all()


@pytest.mark.parametrize("time", [0.0, 0.5, 1.2])
def test_the_field_has_the_spheres_of_its_time(time):
    centers = zip(SPHERES.centers(time), SPHERES.radii, strict=True)
    moving = [Sphere(center, radius) for center, radius in centers if np.isfinite(center).all()]
    p_WQ = np.random.default_rng(0).uniform(-3.5, 3.5, (40, 5, 3))
    expected = field_of(STANDING, *moving).query(p_WQ)
    field = SPHERES.among(field_of(STANDING), time)
    sample = field.query(p_WQ)
    np.testing.assert_allclose(sample.distance, expected.distance, atol=1e-12)
    np.testing.assert_allclose(sample.gradient, expected.gradient, atol=1e-12)
    np.testing.assert_array_equal(sample.state, expected.state)
    np.testing.assert_array_equal(field.distance(p_WQ), sample.distance)
    assert field.query(p_WQ[0, 0]).distance.shape == ()


def test_samples_of_trajectories_meet_the_spheres_of_their_times():
    times = np.array([0.2, 0.6, 1.1, 1.4])
    p_WQ = np.random.default_rng(1).uniform(-3.0, 3.0, (30, 4, 3))
    along = SPHERES.along(field_of(STANDING), times).distance(p_WQ)
    assert along.shape == (30, 4)
    for s, time in enumerate(times):
        expected = SPHERES.among(field_of(STANDING), time).distance(p_WQ[:, s])
        np.testing.assert_array_equal(along[:, s], expected)
