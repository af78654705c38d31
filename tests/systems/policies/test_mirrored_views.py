"""Two views of one image and their consensus."""

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.systems.policies.student import (
    ALIKE,
    SHARPNESS,
    StudentNetwork,
    StudentSpec,
    consensus,
    mirrored_vectors,
    plan,
    plan_both_views,
)


@pytest.fixture(scope="module", params=["rgb", "depth"])
def network(request) -> StudentNetwork:
    """Of random weights, for images of 64x48."""
    spec, rng = StudentSpec(request.param, 64, 48, way_version=2), np.random.default_rng(0)
    shapes = spec.weight_shapes().items()
    weights = {key: rng.normal(scale=0.1, size=shape) for key, shape in shapes}
    return StudentNetwork(spec, {key: value.astype(np.float32) for key, value in weights.items()})


def image_for(network: StudentNetwork) -> np.ndarray:
    rng = np.random.default_rng(1)
    if network.spec.observation == "rgb":
        return rng.integers(0, 256, (48, 64, 3), np.uint8)
    return rng.uniform(0.5, 25.0, (48, 64)).astype(np.float32)


def test_two_that_agree_outvote_a_cheaper_one():
    """Of one trajectory far to the left and two that are 0.3 m apart ahead, in closed form:
    the weights of the pair are 1 and exp(-1), and each is drawn towards the other."""
    ends = np.array([3.0, -0.15, 0.15])
    waypoints = np.zeros((3, 10, 3))
    waypoints[..., 1] = ends[:, None]
    found, costs = consensus(waypoints, np.array([0.9, 1.0, 1.0]))
    assert ALIKE == 0.3 and SHARPNESS == 2.0
    drawn = 0.15 * (1.0 - math.exp(-1.0)) / (1.0 + math.exp(-1.0))
    np.testing.assert_allclose(found[..., 1], np.tile([[3.0], [-drawn], [drawn]], 10), atol=1e-9)
    agreed = 2.0 - math.log(1.0 + math.exp(-1.0))
    np.testing.assert_allclose(costs, [1.8, agreed, agreed], atol=1e-9)
    assert costs.argmin() > 0


def test_what_all_agree_upon_stays():
    """Equal hypotheses are flown as they are, and the costs of fewer are higher."""
    waypoints = np.tile(np.linspace(0.1, 2.0, 30).reshape(1, 10, 3), (6, 1, 1))
    found, costs = consensus(waypoints, np.ones(6))
    np.testing.assert_allclose(found, waypoints, atol=1e-12)
    np.testing.assert_allclose(costs, 2.0 - math.log(6.0), atol=1e-12)


def test_left_and_right_are_treated_alike(network):
    """In a mirrored world, of mirrored pose, velocity, goal and image, the plan is the mirrored
    one, which it is not of one view alone."""
    image = image_for(network)
    mirror = np.ascontiguousarray(image[:, ::-1])
    X_WB = RigidTransform(RollPitchYaw(0.1, -0.05, 0.4), [1.0, 2.0, 1.5])
    X_WM = RigidTransform(RollPitchYaw(-0.1, -0.05, -0.4), [1.0, -2.0, 1.5])
    v_WB, p_WG = np.array([1.2, -0.4, 0.1]), np.array([9.0, 4.0, 2.0])
    arguments = (image, X_WB, v_WB, p_WG)
    in_mirror = (mirror, X_WM, mirrored_vectors(v_WB), mirrored_vectors(p_WG))
    here, there = (plan_both_views(network, 0.0, *of) for of in (arguments, in_mirror))
    assert here.waypoints_B.shape == (6, 10, 3)
    # The views change places, and so do their hypotheses.
    expected = mirrored_vectors(np.roll(there.waypoints_B, 3, axis=0))
    np.testing.assert_allclose(here.waypoints_B, expected, atol=1e-4)
    np.testing.assert_allclose(here.costs, np.roll(there.costs, 3), atol=1e-4)
    one, other = (plan(network, 0.0, *of) for of in (arguments, in_mirror))
    assert np.abs(one.waypoints_B - mirrored_vectors(other.waypoints_B)).max() > 0.01
