from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix

from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Cylinder, HalfSpace
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState
from splatpilot.training.corpus.collect import draw_off_path
from splatpilot.training.corpus.expert import ExpertConfig, Labeler

P_WG = np.array([11.0, 4.0, 1.5])
AXES = np.array([[4.0, 2.5], [7.0, 5.5]])
RADIUS = 0.4


def labeler_of(radius: float = RADIUS) -> Labeler:
    """12 x 8 x 3 m of ground with two pillars."""
    shapes = [HalfSpace(np.array([0.0, 0.0, 1.0]), 0.0)]
    shapes += [Cylinder([x, y, -1], [x, y, 4], radius) for x, y in AXES]
    exact = AnalyticDistanceField(shapes, np.zeros(3), np.array([12.0, 8.0, 3.0]))
    return Labeler(esdf_from_distance_field(exact, 0.2), P_WG, ExpertConfig())


def test_half_stand_before_a_pillar_and_none_in_one():
    labeler, count = labeler_of(), 400
    states = draw_off_path(labeler, count, 2.5, np.random.default_rng(0))
    assert states.shape == (count, 13)
    p_WB, v_WB = states[:, :3], states[:, 3:6]
    room = labeler.field.distance(p_WB) - VEHICLE_RADIUS
    assert room.min() > 0.0 and (p_WB >= 0.0).all()
    ahead = np.hypot(v_WB[:, 0], v_WB[:, 1])
    assert 1.5 < ahead.max() < 4.0
    assert (ahead - np.sqrt(6.0 * room) < 1.5).all()  # but for what goes sideways
    yaws, leans = [], []
    for state in states:
        R_WB = RotationMatrix(Quaternion(QuadrotorState.of(state).q_WB))
        roll, pitch, yaw = RollPitchYaw(R_WB).vector()
        yaws.append(yaw)
        leans += [roll, pitch]
    assert 0.08 < np.std(leans) < 0.16
    looking = np.stack([np.cos(yaws), np.sin(yaws)], 1)

    before, others = slice(0, count // 2), slice(count // 2, count)
    surfaces = labeler.field.query(p_WB[before]).gradient[:, :2]
    into = -(surfaces * looking[before]).sum(1) / np.linalg.norm(surfaces, axis=1)
    assert room[before].max() < 1.0 and np.median(into) > 0.7
    arriving, anywhere = slice(count // 2, 3 * count // 4), slice(3 * count // 4, count)
    to_goal = np.linalg.norm(p_WB[arriving] - P_WG, axis=1)
    assert to_goal.max() < 4.0 and (to_goal < 1.0).mean() > 0.15
    assert np.abs(looking[arriving].mean(0)).max() < 0.25
    ways = P_WG[:2] - p_WB[anywhere, :2]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    assert np.median((ways * looking[anywhere]).sum(1)) > 0.6
    assert np.ptp(p_WB[others], axis=0) == pytest.approx([11.0, 7.0, 2.2], abs=1.2)


def test_same_seed_draws_the_same_states():
    labeler = labeler_of()
    one, same, other = (
        draw_off_path(labeler, 20, 2.0, np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, same)
    assert not np.allclose(one, other)


def test_a_place_without_room_is_named():
    labeler = labeler_of()
    labeler.toa = replace(labeler.toa, reachable=np.zeros_like(labeler.toa.reachable))
    with pytest.raises(InfeasibleFlightError, match="no free position with a path"):
        draw_off_path(labeler, 5, 2.0, np.random.default_rng(0))
