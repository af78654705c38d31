import math
from typing import Any, cast

import pytest
from pydrake.common.schema import GaussianVector, Transform

from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.receiver import TimeOfFlightStream, UdpConfig
from splatpilot.systems.px4.commander import Px4CommanderConfig
from splatpilot.systems.px4.motion_capture import MotionCaptureConfig
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.sensing.time_of_flight import TimeOfFlight
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorParams

NAN, INF = math.nan, math.inf
ZERO_FIELDS = {
    FailsafeConfig: "max_age max_lag recovery patience descent",
    FlatnessControllerConfig: "period lookahead min_thrust max_thrust max_tilt tilt_gain "
    "max_tilt_rate yaw_gain max_yaw_rate yaw_speed",
    FlightLimits: "max_speed max_tilt deceleration",
    OnboardCamera: "width height fov_x fov_y max_depth",
    Px4CommanderConfig: "hover_thrust streaming max_age",
    QuadrotorParams: "rate_time_constant",
    TimeOfFlight: "width height fov_x fov_y fov max_range columns rows",
}
OTHER_FIELDS = [
    (FlatnessControllerConfig, {"period": 1e-5, "min_thrust": 25.0, "max_tilt": 1.6}),
    (FlatnessControllerConfig, {"lookahead": 0.1, "max_tilt_rate": INF}),
    (FlightLimits, {"max_tilt": 2.0, "deceleration": NAN, "min_clearance": -0.1}),
    (FlightLimits, {"geofence": [[0.0, 0, 0], [1.0, 1, 0]]}),
    (FlightLimits, {"geofence": [[0.0, 0, 0]]}),
    (FlightLimits, {"geofence": [[0.0, -5.0, 0.5], [10.0, 5.0, 1.1]]}),
    (FlightLimits, {"geofence": [[0.0, 0.0, NAN], [10.0, 5.0, 3.0]]}),
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
    (QuadrotorParams, {"drag": NAN, "gravity": INF}),
    (TimeOfFlight, {"fov": 180.0, "fov_x": NAN, "anchor": "left", "rows": 200, "columns": 181}),
    (TimeOfFlightStream, {"latency": 2.0}),
    (UdpConfig, {"senders": ["drone"], "host": "", "port": 70000, "group": "10.0.0.1"}),
    (UdpConfig, {"senders": []}),
]
CASES = [
    *((config, name, 0) for config, names in ZERO_FIELDS.items() for name in names.split()),
    *((config, *item) for config, fields in OTHER_FIELDS for item in fields.items()),
]


@pytest.mark.parametrize(("config", "field", "value"), CASES)
def test_an_invalid_field_is_named(config, field, value):
    with pytest.raises(ValueError, match=rf"{config.__name__}\.{field} must be .*, got"):
        config(**{field: value}).validate()


def test_limits_may_be_reached():
    ObservationNoise(frame_rate=[10.0, 10.0], jitter=0.1, frame_dropout=0.5).validate()
    side = 2.0 * (VEHICLE_RADIUS + 0.1) + 1e-9
    FlightLimits(geofence=[[0.0, 0.0, 0.0], [side, side, side]]).validate()
