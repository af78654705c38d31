import math
from typing import Any, cast

import numpy as np
import pytest
from pydrake.common.schema import GaussianVector, Transform

from splatpilot.systems.collision.shapes import AnalyticDistanceField
from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.receiver import TimeOfFlightStream, UdpConfig
from splatpilot.systems.policies.agile_autonomy import AgileAutonomyConfig
from splatpilot.systems.policies.depthnav import DepthNavConfig
from splatpilot.systems.policies.diffaero import DiffAeroConfig, DiffAeroTofConfig
from splatpilot.systems.policies.diffaero_rgb import DiffAeroRgbConfig
from splatpilot.systems.policies.hypotheses import HypothesisSelector
from splatpilot.systems.policies.lattice import LatticeConfig
from splatpilot.systems.policies.planner import PrivilegedPlanner
from splatpilot.systems.policies.reactive import ReactiveConfig
from splatpilot.systems.policies.straight import StraightConfig
from splatpilot.systems.policies.student import StudentDepthConfig, StudentRgbConfig
from splatpilot.systems.policies.velocity import VelocitySetpoint
from splatpilot.systems.px4.commander import Px4CommanderConfig
from splatpilot.systems.px4.motion_capture import MotionCaptureConfig
from splatpilot.systems.sensing.imu import RangeFinder
from splatpilot.systems.sensing.latency import DelayedPose, FrameTimes
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.sensing.time_of_flight import TimeOfFlight
from splatpilot.systems.vehicle.airframe import QuadrotorAirframe
from splatpilot.systems.vehicle.flatness import FlatnessController, FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor import (
    VEHICLE_RADIUS,
    QuadrotorParams,
    QuadrotorPlant,
    hover_state,
)
from splatpilot.systems.vehicle.vehicles import Kingfisher
from splatpilot.systems.vehicle.wind import Wind

NAN, INF = math.nan, math.inf
ZERO_FIELDS = {
    FailsafeConfig: "max_age max_lag recovery patience descent",
    FlatnessControllerConfig: "period lookahead min_thrust max_thrust max_tilt tilt_gain "
    "max_tilt_rate yaw_gain max_yaw_rate yaw_speed",
    FlightLimits: "max_speed max_tilt deceleration",
    OnboardCamera: "width height fov_x fov_y max_depth",
    Px4CommanderConfig: "hover_thrust streaming max_age",
    QuadrotorParams: "rate_time_constant",
    RangeFinder: "max_range",
    ReactiveConfig: "speed memory",
    StraightConfig: "speed",
    TimeOfFlight: "width height fov_x fov_y fov max_range columns rows",
    Wind: "airspeed",
    **dict.fromkeys(
        (AgileAutonomyConfig, DepthNavConfig, DiffAeroConfig, DiffAeroTofConfig), "speed"
    ),
    **dict.fromkeys((DiffAeroRgbConfig, StudentRgbConfig, StudentDepthConfig), "speed"),
}
OTHER_FIELDS = [
    (FlatnessControllerConfig, {"period": 1e-5, "min_thrust": 25.0, "max_tilt": 1.6}),
    (FlatnessControllerConfig, {"lookahead": 0.1, "max_tilt_rate": INF}),
    (FlightLimits, {"max_tilt": 2.0, "deceleration": NAN, "min_clearance": -0.1}),
    (FlightLimits, {"geofence": [[0.0, 0, 0], [1.0, 1, 0]]}),
    (FlightLimits, {"geofence": [[0.0, 0, 0]]}),
    (FlightLimits, {"geofence": [[0.0, -5.0, 0.5], [10.0, 5.0, 1.1]]}),
    (FlightLimits, {"geofence": [[0.0, 0.0, NAN], [10.0, 5.0, 3.0]]}),
    (LatticeConfig, {"speed": 20.1, "horizon": 0.9, "speed_fractions": [], "num_hypotheses": 600}),
    (LatticeConfig, {"horizon": 1.55, "speed_fractions": [0.5, 1.2], "jerk_weight": NAN}),
    (MotionCaptureConfig, {"version": [1, 0]}),
    (ObservationNoise, {"depth_dropout": 1.1, "depth_additive": INF, "latency": 1.5}),
    (ObservationNoise, {"color_noise": -0.1, "exposure_error": 6.5, "read_noise": 3.0}),
    (ObservationNoise, {"jitter": 0.1, "frame_rate": [10.0]}),
    (ObservationNoise, {"frame_rate": [30.0, 10.0]}),
    (ObservationNoise, {"frame_rate": [0.0, 10.0]}),
    (OnboardCamera, {"fov_x": 180.0, "max_depth": 0.05}),
    (OnboardCamera, {"X_BC": Transform(translation=[NAN, 0.0, 0.0])}),
    (
        OnboardCamera,
        {"X_BC": Transform(translation=cast(Any, GaussianVector)[3]([0.0] * 3, [0.1] * 3))},
    ),
    (OnboardCamera, {"readout": 0.3}),
    (Px4CommanderConfig, {"setpoints": "position", "arm": True}),
    (QuadrotorParams, {"drag": -0.1, "gravity": -9.81}),
    (QuadrotorParams, {"drag": NAN, "gravity": INF, "model": "motors", "radius": INF}),
    (QuadrotorParams, {"inertia": [1.0, 0.0, 1.0], "arm": [0.1], "rotor_drag": [0.1]}),
    (QuadrotorParams, {"min_thrust": 10.0, "max_thrust": 9.0}),
    (RangeFinder, {"direction": [0.0, 0.0, 0.0]}),
    (RangeFinder, {"direction": [1.0]}),
    (ReactiveConfig, {"speed": NAN, "columns": 15}),
    (TimeOfFlight, {"fov": 180.0, "fov_x": NAN, "anchor": "left", "rows": 200, "columns": 181}),
    (TimeOfFlightStream, {"latency": 2.0}),
    (UdpConfig, {"senders": ["drone"], "host": "", "port": 70000, "group": "10.0.0.1"}),
    (UdpConfig, {"senders": []}),
    (Wind, {"gusts": -1.0, "altitude": 1.0, "mean": [NAN, 0.0, 0.0]}),
    (Wind, {"mean": [1.0]}),
]
CASES = [
    *((config, name, 0) for config, names in ZERO_FIELDS.items() for name in names.split()),
    *((config, *item) for config, fields in OTHER_FIELDS for item in fields.items()),
]


@pytest.mark.parametrize(("config", "field", "value"), CASES)
def test_an_invalid_field_is_named(config, field, value):
    with pytest.raises(ValueError, match=rf"{config.__name__}\.{field} must be .*, got"):
        config(**{field: value}).validate()


SLOW, UNSTABLE = (
    FlatnessControllerConfig(**fields)
    for fields in ({"max_thrust": 12.0}, {"disturbance_time": 0.1})
)
SHAPES, START = AnalyticDistanceField([], [0.0] * 3, [1.0] * 3), hover_state([1.0, -2.0, 3.0])


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (DelayedPose, (FrameTimes.late(-0.1),), "delays of frames must be .* got -0.1"),
        (FlatnessController, ("x",), "config must be of type .* got a str"),
        (FlatnessController, (None, "x"), "params must be of type .* got a str"),
        (FlatnessController, (SLOW,), r"max_thrust must be above 14\.08 .* got 12"),
        (FlatnessController, (UNSTABLE,), r"must be 0 or at least lookahead, 0\.4 s"),
        (HypothesisSelector, (3, 0.0), r"lookahead must be in \(0, 1\] s, got 0"),
        (HypothesisSelector, (3, 1.01), r"lookahead must be in \(0, 1\] s, got 1.01"),
        (PrivilegedPlanner, (SHAPES,), "esdf must be .* got a Analytic.*`esdf`"),
        (PrivilegedPlanner, (None,), "esdf must be of type Esdf"),
        (QuadrotorAirframe, (QuadrotorParams(), START), r"params\.model must be rotors, got lags"),
        (QuadrotorAirframe, (Kingfisher(), START + np.eye(13)[3]), "initial_state must be at rest"),
        (QuadrotorAirframe, (Kingfisher(max_thrust=5.0), START), "max_thrust must be above"),
        (QuadrotorPlant, ("x",), "params must be of type QuadrotorParams, got a str"),
        (QuadrotorPlant, (None, np.zeros(13)), r"q_WB must be a rotation .* got \[0\.0, 0\.0"),
        (QuadrotorPlant, (None, np.zeros(12)), "initial_state must be 13 finite numbers"),
        (QuadrotorPlant, (None, np.full(13, NAN)), "initial_state must be 13 finite numbers"),
        (VelocitySetpoint, (None,), "controller must be of type FlatnessControllerConfig"),
    ],
)
def test_invalid_arguments_of_systems_are_named(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(*arguments)


def test_limits_may_be_reached():
    ObservationNoise(frame_rate=[10.0, 10.0], jitter=0.1, frame_dropout=0.5).validate()
    side = 2.0 * (VEHICLE_RADIUS + 0.1) + 1e-9
    FlightLimits(geofence=[[0.0, 0.0, 0.0], [side, side, side]]).validate()
