import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

from splatpilot.systems.policies import planner as privileged_planner
from splatpilot.systems.policies.hypotheses import HypothesisSelector
from splatpilot.systems.policies.lattice import LatticeConfig, TrajectoryLattice
from splatpilot.systems.policies.planner import PrivilegedPlanner, PrivilegedPlannerConfig, plan
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.systems.vehicle.flatness import (
    FlatnessController,
    FlatnessControllerConfig,
    attitude_from_thrust,
)
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorPlant, hover_state

MARGIN = LatticeConfig().margin


def flying(p_WB, v_WB, a_WB=(0.0, 0.0, 0.0)):
    state = hover_state(p_WB)
    state[3:6] = v_WB
    thrust_W = np.array([a_WB[0] + 0.375 * v_WB[0], a_WB[1] + 0.375 * v_WB[1], 9.81])
    R_WB = RotationMatrix(attitude_from_thrust(thrust_W, 0.0))
    state[6:10] = R_WB.ToQuaternion().wxyz()
    return state


def fly(esdf, p_WB, p_WG, duration):
    """Returns the states (N, 13) of a flight, every 20 ms."""
    builder, config = DiagramBuilder(), PrivilegedPlannerConfig()
    plant = builder.AddSystem(QuadrotorPlant(initial_state=hover_state(p_WB)))
    planner = builder.AddSystem(PrivilegedPlanner(esdf, config))
    lookahead = FlatnessControllerConfig().lookahead
    selector = builder.AddSystem(HypothesisSelector(config.lattice.num_hypotheses, lookahead))
    controller = builder.AddSystem(FlatnessController())
    state = plant.GetOutputPort("state")
    for system in (planner, selector, controller):
        builder.Connect(state, system.GetInputPort("state"))
    builder.Connect(planner.GetOutputPort("hypotheses"), selector.GetInputPort("hypotheses"))
    builder.Connect(selector.GetOutputPort("waypoint"), controller.GetInputPort("waypoint"))
    builder.Connect(controller.GetOutputPort("command"), plant.GetInputPort("command"))
    builder.ExportInput(planner.GetInputPort("goal"), "goal")
    states = LogVectorOutput(state, builder, publish_period=0.02)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    diagram.GetInputPort("goal").FixValue(simulator.get_mutable_context(), p_WG)
    simulator.AdvanceTo(duration)
    return states.FindLog(simulator.get_context()).data().T


def test_flies_straight_at_nominal_speed(empty):
    toa = time_of_arrival(empty, np.array([14.0, 4.0, 3.0]))
    state = flying([3.0, 4.0, 3.0], [2.0, 0.0, 0.0])
    way_W = plan(0.0, state, empty, toa, TrajectoryLattice()).waypoints_W[0]
    np.testing.assert_allclose(way_W[:, 0], 3.0 + 0.2 * np.arange(1, 11), atol=0.02)
    np.testing.assert_allclose(way_W[:, 1:], [[4.0, 3.0]] * 10, atol=0.03)


@pytest.mark.parametrize("y", [3.6, 4.0, 4.3])
def test_all_hypotheses_avoid_an_obstacle(pillar, y):
    toa = time_of_arrival(pillar, np.array([14.0, 4.0, 3.0]), MARGIN)
    state = flying([3.5, y, 3.0], [2.0, 0.0, 0.0])
    hypotheses = plan(0.0, state, pillar, toa, TrajectoryLattice())
    assert pillar.distance(hypotheses.waypoints_W).min() > VEHICLE_RADIUS + MARGIN
    assert np.all(np.diff(hypotheses.costs) >= 0.0)


def test_a_state_in_an_obstacle_leads_out(pillar, pillar_plan):
    state = hover_state([5.4, 4.1, 3.0])
    way_W = pillar_plan(state).waypoints_W[0]
    assert pillar.distance(state[:3]) < VEHICLE_RADIUS
    assert pillar.distance(way_W[-1]) > pillar.distance(state[:3]) + 0.1


@pytest.mark.parametrize("p_WB", [[7.3, 6.5, 2.0], [4.5, 3.0, 1.5]])
def test_escapes_a_u_trap(u_trap, p_WB):
    p_WG = np.array([12.0, 5.0, 2.0])
    toa, lattice = time_of_arrival(u_trap, p_WG, MARGIN), TrajectoryLattice()
    p, v, a = np.array(p_WB), np.zeros(3), np.zeros(3)
    for _ in range(120):
        way_W = plan(0.0, flying(p, v, a), u_trap, toa, lattice).waypoints_W[0]
        p, v, a = way_W[0], (way_W[1] - p) / 0.2, (way_W[1] - 2.0 * way_W[0] + p) / 0.1**2
        assert u_trap.distance(p) > VEHICLE_RADIUS
        if np.linalg.norm(p - p_WG) < 0.3:
            return
    pytest.fail(f"After 12 s still at {p}.")


def test_follows_a_narrow_bend(narrow_bend):
    p_WG = np.array([4.2, 2.6, 0.8])
    states = fly(narrow_bend, [1.0, 1.0, 0.8], p_WG, 12.0)
    assert np.linalg.norm(states[:, :3] - p_WG, axis=1).min() < 0.31
    assert narrow_bend.distance(states[:, :3]).min() > VEHICLE_RADIUS


def test_a_vehicle_that_drifts_to_less_than_the_margin_is_not_cut_off(narrow_bend):
    toa = time_of_arrival(narrow_bend, np.array([4.2, 2.6, 0.8]), MARGIN)
    p_WB = np.array([2.3, 1.05, 0.8])  # beside the inner corner
    assert not toa.is_reachable(p_WB)
    assert narrow_bend.distance(p_WB) - VEHICLE_RADIUS > narrow_bend.voxel_size
    hypotheses = plan(0.0, hover_state(p_WB), narrow_bend, toa, TrajectoryLattice())
    assert np.isfinite(hypotheses.costs).all()


def test_arrives_and_stops_near_an_obstacle(pillar):
    p_WG = np.array([6.0 - 0.4 - VEHICLE_RADIUS - 0.1, 4.0, 3.0])
    states = fly(pillar, [2.0, 2.5, 2.5], p_WG, 9.0)
    rest = states[-50:]  # the last second
    assert np.linalg.norm(rest[:, :3] - p_WG, axis=1).max() < 0.1
    assert np.linalg.norm(rest[:, 3:6], axis=1).max() < 0.1
    assert pillar.distance(states[:, :3]).min() > VEHICLE_RADIUS


@given(
    p=st.tuples(*[st.floats(-100, 100)] * 3),
    v=st.tuples(*[st.floats(-30, 30)] * 3),
    rpy=st.tuples(*[st.floats(-4, 4)] * 3),
)
@settings(max_examples=60)
def test_any_state_gets_finite_plans(pillar_plan, p, v, rpy):
    q = RollPitchYaw(rpy).ToQuaternion().wxyz()
    hypotheses = pillar_plan(np.array([*p, *v, *q, 0.0, 0.0, 0.0]))
    assert np.isfinite(hypotheses.to_vector()).all()
    assert np.all(np.diff(hypotheses.costs) >= 0.0)


@pytest.fixture(scope="session")
def pillar_plan(pillar, pillar_toa):
    lattice = TrajectoryLattice()
    return lambda state: plan(0.0, state, pillar, pillar_toa, lattice)


def test_time_of_arrival_is_computed_once_per_goal(empty, monkeypatch):
    goals = []
    march = privileged_planner.time_of_arrival
    monkeypatch.setattr(
        privileged_planner,
        "time_of_arrival",
        lambda field, p_WG, margin: goals.append(p_WG.tolist()) or march(field, p_WG, margin),
    )
    planner = PrivilegedPlanner(empty)
    simulator = Simulator(planner)
    context = simulator.get_mutable_context()
    planner.GetInputPort("state").FixValue(context, hover_state([3.0, 4.0, 3.0]))
    for p_WG, until in [([9.0, 4.0, 3.0], 0.3), ([9.0, 4.0, 3.0], 0.6), ([9.0, 6.0, 3.0], 0.9)]:
        planner.GetInputPort("goal").FixValue(context, p_WG)
        simulator.AdvanceTo(until)
    assert goals == [[9.0, 4.0, 3.0], [9.0, 6.0, 3.0]]


def test_unknown_space_is_not_planned_through(empty):
    planner = PrivilegedPlanner(empty)
    context = planner.CreateDefaultContext()
    planner.GetInputPort("state").FixValue(context, hover_state([1.5, 5.0, 1.5]))
    planner.GetInputPort("goal").FixValue(context, [15.8, 5.0, 1.5])
    with pytest.raises(ValueError, match="boundary of the known volume"):
        Simulator(planner, context).AdvanceTo(0.1)


def test_a_goal_that_is_cut_off_is_refused(closed_wall):
    toa = time_of_arrival(closed_wall, np.array([9.0, 5.0, 2.0]))
    message = r"no path leads from p_WB = \[3.0, 5.0, 2.0\].*clearance 1.\d+ m.*\[9.0, 5.0, 2.0\]"
    with pytest.raises(ValueError, match=message):
        plan(0.0, hover_state([3.0, 5.0, 2.0]), closed_wall, toa, TrajectoryLattice())


def test_a_state_that_is_not_finite_is_refused(pillar_plan):
    with pytest.raises(ValueError, match="must be 13 finite numbers"):
        pillar_plan(np.full(13, np.nan))
