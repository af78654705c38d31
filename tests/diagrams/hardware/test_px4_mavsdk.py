"""The bridge flies a vehicle of MAVSDK's server plugins, which answer commands, keep modes and read
setpoints as MAVSDK's authors understand MAVLink."""

import contextlib
import json
import socket
import time
from collections.abc import Callable

import lcm
import numpy as np
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.connection_result import ConnectionResult
from mavsdk.plugins.action_server.action_server import (
    ActionServer,
    AllowableFlightModes,
    FlightMode,
)
from mavsdk.plugins.mavlink_direct_server.mavlink_direct_server import (
    MavlinkDirectServer,
    MavlinkMessage,
)
from mavsdk.plugins.telemetry_server.telemetry_server import (
    PositionNed,
    PositionVelocityNed,
    TelemetryServer,
    VelocityNed,
)
from pydrake.systems.analysis import Simulator

from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram, HardwareConfig
from splatpilot.diagrams.hardware.px4 import BuildPx4Diagram, Px4Config
from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.receiver import UdpConfig, UdpInbox
from splatpilot.systems.px4.commander import Px4CommanderConfig

START, GOAL = [1.0, 2.0, 2.0], [9.0, 6.0, 2.0]


class MavsdkVehicle:
    """A vehicle that hovers at START, heading north."""

    def __init__(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self._began = time.monotonic()
        self._mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.AUTOPILOT))
        result = self._mavsdk.add_any_connection(f"udpin://127.0.0.1:{self.port}")
        assert result == ConnectionResult.SUCCESS
        component = self._mavsdk.server_component_by_type(ComponentType.AUTOPILOT)
        self._telemetry = TelemetryServer(component)
        self._direct = MavlinkDirectServer(component)
        actions = self._actions = ActionServer(component)
        actions.set_armable(True, False)
        actions.set_allowable_flight_modes(
            AllowableFlightModes(can_guided_mode=True, can_auto_land_mode=True)
        )
        self.armed, self.modes, self.setpoints = [], [], []
        actions.subscribe_arm_disarm(lambda result, asked, _: self.armed.append(asked.arm))
        actions.subscribe_flight_mode_change(lambda result, mode, _: self.modes.append(mode))
        self._direct.subscribe_message(
            "SET_POSITION_TARGET_LOCAL_NED",
            lambda message, _: self.setpoints.append(json.loads(message.fields_json)),
        )

    def tell(self) -> None:
        x, y, z = START
        z += 1e-4 * np.sin(time.monotonic())  # An estimate is never the same for long.
        position = PositionVelocityNed(PositionNed(x, -y, -z), VelocityNed(0.0, 0.0, 0.0))
        self._telemetry.publish_position_velocity_ned(position)
        fields = dict.fromkeys(("q2", "q3", "q4", "rollspeed", "pitchspeed", "yawspeed"), 0.0)
        fields |= {"q1": 1.0, "time_boot_ms": round(1e3 * (time.monotonic() - self._began))}
        self._direct.send_message(
            MavlinkMessage("ATTITUDE_QUATERNION", 1, 1, 0, 0, json.dumps(fields))
        )

    def close(self) -> None:
        self._mavsdk.destroy()


def test_mavsdks_vehicle_is_engaged_armed_flown_and_landed(post_world):
    vehicle, inbox, memory = MavsdkVehicle(), UdpInbox(UdpConfig(port=0)), lcm.LCM("memq://")
    scenario = Scenario(policy=policy_named("straight", 1.0), start=START, goal=GOAL)
    hardware = HardwareConfig(failsafe=FailsafeConfig(patience=1.0))
    commander = Px4CommanderConfig(engage=True, arm=True, streaming=0.2)
    config = Px4Config(vehicle_port=vehicle.port, commander=commander)
    bridge = Simulator(BuildHardwareDiagram(scenario, post_world, memory, hardware))
    link = Simulator(BuildPx4Diagram(config, memory, inbox))
    began = time.monotonic()

    def run_until(is_done: Callable[[], bool], tells: bool) -> None:
        deadline = time.monotonic() + 60.0
        while not is_done():
            assert time.monotonic() < deadline, (vehicle.modes, vehicle.armed)
            if tells:
                vehicle.tell()
            now = time.monotonic() - began
            bridge.AdvanceTo(now)
            link.AdvanceTo(now)
            time.sleep(0.01)

    with contextlib.closing(inbox), contextlib.closing(vehicle):
        run_until(lambda: len(vehicle.armed) > 0, tells=True)
        armed = time.monotonic()
        run_until(lambda: time.monotonic() > armed + 1.2, tells=True)  # a heartbeat says so
        assert (vehicle.modes, vehicle.armed) == ([FlightMode.OFFBOARD], [True])
        sent = np.array([[s["vx"], s["vy"], s["vz"]] for s in vehicle.setpoints[-50:]])
        toward = np.subtract(GOAL, START) * [1, -1, -1]
        assert np.all(sent @ toward > 0.95 * np.linalg.norm(sent, axis=1) * np.linalg.norm(toward))
        run_until(lambda: len(vehicle.modes) > 1, tells=False)
        assert vehicle.modes == [FlightMode.OFFBOARD, FlightMode.LAND]
