"""Ports by methods."""

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.systems.framework import InputPort, OutputPort, System

from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.esdf_collision import EsdfCollision
from splatpilot.systems.collision.shapes import AnalyticDistanceField, HalfSpace
from splatpilot.systems.policies.agile_autonomy import AgileAutonomy
from splatpilot.systems.policies.depthnav import DepthNav
from splatpilot.systems.policies.diffaero import DiffAero
from splatpilot.systems.policies.hypotheses import HypothesisSelector
from splatpilot.systems.policies.planner import PrivilegedPlanner
from splatpilot.systems.policies.reactive import Reactive
from splatpilot.systems.policies.straight import Straight
from splatpilot.systems.policies.velocity import VelocityTracker
from splatpilot.systems.sensing.latency import DelayedPose, FrameTimes
from splatpilot.systems.sensing.noise import ColorNoise, DepthNoise, ObservationNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.quadrotor import QuadrotorPlant
from splatpilot.systems.vehicle.state import StateToPose
from splatpilot.systems.visualization.meshcat_drawing import FlightVisualizer
from splatpilot.systems.visualization.video import VideoRecorder


@pytest.fixture(scope="module")
def systems() -> list[System]:
    field = AnalyticDistanceField([HalfSpace([0, 0, 1], 0.0)], np.zeros(3), np.ones(3))
    noise = ObservationNoise(), OnboardCamera(), 15.0, 0
    return [
        QuadrotorPlant(),
        QuadrotorPlant().ToAutoDiffXd(),
        FlatnessController(),
        StateToPose(),
        EsdfCollision(field),
        HypothesisSelector(),
        PrivilegedPlanner(esdf_from_distance_field(field, 0.2)),
        Straight(),
        Reactive(),
        DiffAero(),
        DepthNav(),
        AgileAutonomy(),
        DelayedPose(FrameTimes.late(0.1)),
        VelocityTracker(),
        DepthNoise(*noise),
        ColorNoise(*noise),
        FlightVisualizer(Meshcat(), 3),
        VideoRecorder(64, 48, 10.0),
    ]


def test_every_port_has_its_method(systems):
    """`<name>_input_port()` and `<name>_output_port()` are the ports of these names."""
    for system in systems:
        for index in range(system.num_input_ports()):
            port = system.get_input_port(index)
            found = getattr(system, f"{port.get_name()}_input_port")()
            assert (found.get_name(), found.get_index()) == (port.get_name(), index)
        for index in range(system.num_output_ports()):
            port = system.get_output_port(index)
            found = getattr(system, f"{port.get_name()}_output_port")()
            assert (found.get_name(), found.get_index()) == (port.get_name(), index)
    assert isinstance(StateToPose().state_input_port(), InputPort)
    assert isinstance(StateToPose().pose_output_port(), OutputPort)
