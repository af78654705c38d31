"""The stand-in for PX4, as others see it who fly PX4."""

import socket
import threading
import time

import numpy as np
import pytest
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.connection_result import ConnectionResult
from mavsdk.plugins.offboard.offboard import Offboard, OffboardError, VelocityNedYaw
from px4_stand_in import OFFBOARD, Px4StandIn


def test_mavsdk_takes_the_stand_in_for_px4():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    px4 = Px4StandIn("1.18", [0.0, 0.0, 2.0])
    px4.peer = ("127.0.0.1", port)
    client = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    result = client.add_any_connection(f"udpin://127.0.0.1:{port}")
    assert result == ConnectionResult.SUCCESS
    stopped, began = threading.Event(), time.monotonic()

    def run() -> None:
        while not stopped.wait(0.005):
            px4.step(time.monotonic() - began)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        system = client.first_autopilot(10.0)
        assert system is not None
        offboard = Offboard(system)
        with pytest.raises(OffboardError):
            offboard.start()
        offboard.set_velocity_ned(VelocityNedYaw(1.0, 2.0, -3.0, 0.0))
        offboard.start()
        assert px4.mode == OFFBOARD
        np.testing.assert_allclose(px4.velocity, [1.0, -2.0, 3.0], atol=1e-6)
    finally:
        stopped.set()
        thread.join()
        client.destroy()
        px4.socket.close()
