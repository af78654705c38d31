import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, HalfSpace, MovingSpheres
from splatpilot.systems.sensing.imu import RangeFinder, RangeFinderSensor
from splatpilot.systems.splats.moving_bodies import Bodies, MovingObstacles
from splatpilot.systems.vehicle.quadrotor_geometry import quadrotor_gaussians
from tests.systems.vehicle.responses import evaluate

FIELD = AnalyticDistanceField(
    [HalfSpace([0, 0, 1], 0.0), Box(RigidTransform([4.0, 0.0, 0.5]), [2.0, 2.0, 1.0])],
    np.full(3, -20.0),
    np.full(3, 20.0),
)


def measure(X_WB: RigidTransform, time: float = 0.0, bodies=None, seed: int = 0, **fields) -> float:
    sensor = RangeFinderSensor(RangeFinder(**{"noise": 0.0} | fields), FIELD, seed)
    moving = {"moving": AbstractValue.Make(bodies)} if bodies else {}
    return evaluate(sensor, time=time, body_pose=X_WB, **moving)[0]


@pytest.mark.parametrize(
    ("X_WB", "expected"),
    [
        (RigidTransform([0.0, 0.0, 3.0]), 3.0),
        (RigidTransform([4.0, 0.0, 3.0]), 2.0),
        (RigidTransform(RotationMatrix.MakeXRotation(0.5), [0.0, 0.0, 3.0]), 3.0 / np.cos(0.5)),
        (RigidTransform([0.0, 0.0, 12.0]), np.inf),
        (RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.0, 0.0, 15.0]), np.inf),
    ],
)
def test_the_range_is_along_the_ray(X_WB, expected):
    assert measure(X_WB) == pytest.approx(expected, abs=1e-3)


def test_moving_bodies_are_hit():
    spheres = MovingSpheres([0.5], [np.array([[0.0, 0.0, 1.5]])], 1.0)
    obstacles = MovingObstacles(spheres, [quadrotor_gaussians()])
    X_WB = RigidTransform([0.0, 0.0, 3.0])
    assert measure(X_WB, bodies=Bodies(0.0, obstacles)) == pytest.approx(1.0, abs=1e-3)


def test_noise_follows_from_the_seed_and_the_sample():
    X_WB = RigidTransform([0.0, 0.0, 3.0])
    values = [measure(X_WB, k / 50.0, noise=0.1) for k in range(300)]
    assert np.std(values) == pytest.approx(0.1, rel=0.1)
    assert np.mean(values) == pytest.approx(3.0, abs=0.02)
    first, again, other = (measure(X_WB, seed=seed, noise=0.1) for seed in (4, 4, 5))
    assert first == again != other
