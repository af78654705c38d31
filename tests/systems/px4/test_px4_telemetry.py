"""What PX4 says, and what others do."""

import socket
import time

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pymavlink.dialects.v20 import common as dialect

from splatpilot.systems.messaging.udp_inbox import UdpConfig, UdpInbox
from splatpilot.systems.px4.mavlink import Mavlink
from splatpilot.systems.px4.px4_telemetry import Px4Telemetry

POSITION = dialect.MAVLink_local_position_ned_message(0, 1.0, 2.0, -3.0, 0.5, 0.0, 0.0)
ATTITUDE = dialect.MAVLink_attitude_quaternion_message(0, 1.0, 0, 0, 0, 0.1, 0.2, 0.3)


@pytest.fixture
def inbox():
    made = UdpInbox(UdpConfig(port=0))
    yield made
    made.close()


def send(inbox: UdpInbox, *messages, raw: bytes = b"", sender: str = "127.0.0.1") -> None:
    link = dialect.MAVLink(None, 1, 1)
    packet = b"".join(bytes(message.pack(link)) for message in messages) + raw
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.bind((sender, 0))
        out.sendto(packet, ("127.0.0.1", inbox.port))
    time.sleep(0.01)


def test_state_needs_position_and_attitude(inbox, caplog):
    """The state is as old as the older of the two, and infinitely old before both; what is no
    message of PX4's is counted and logged, and changes nothing."""
    system = Px4Telemetry(inbox, Mavlink(), 0.01, max_age=0.1)
    simulator = Simulator(system)
    simulator.Initialize()

    def out(name: str) -> np.ndarray:
        return system.GetOutputPort(name).Eval(simulator.get_context()).copy()

    send(inbox, POSITION)
    simulator.AdvanceTo(0.1)
    assert out("age")[0] == np.inf and out("is_fresh")[0] == 0
    send(inbox, ATTITUDE, dialect.MAVLink_heartbeat_message(2, 12, 129, 6 << 16, 4, 3))
    simulator.AdvanceTo(0.2)
    np.testing.assert_allclose(
        out("state"), [1, -2, 3, 0.5, 0, 0, 1, 0, 0, 0, 0.1, -0.2, -0.3], rtol=1e-6
    )
    assert 0.15 < out("age")[0] <= 0.2 and out("is_fresh")[0] == 0
    assert out("armed")[0] == 1 and out("mode").tolist() == [6.0, 0.0]
    send(inbox, POSITION, ATTITUDE)
    simulator.AdvanceTo(0.25)
    assert out("is_fresh")[0] == 1
    before = out("state")
    send(inbox, raw=b"nonsense")
    send(inbox, POSITION, raw=b"\x00")
    send(inbox, POSITION, sender="127.0.0.9")
    simulator.AdvanceTo(0.3)
    np.testing.assert_array_equal(out("state"), before)
    assert out("rejected")[0] == 3
    assert "PX4: a message is refused" in caplog.text


@pytest.mark.parametrize(
    ("base", "mode", "told"), [(129, 6, [1, 1]), (129, 3, [1, 0]), (1, 6, [0, 1]), (1, 3, [0, 0])]
)
def test_vehicle_status_is_that_of_the_last_heartbeat_unless_it_is_old(inbox, base, mode, told):
    system = Px4Telemetry(inbox, Mavlink(), 0.01)
    simulator = Simulator(system)
    port = system.vehicle_status_output_port()
    simulator.AdvanceTo(0.1)
    assert np.isnan(port.Eval(simulator.get_context())).all()
    send(inbox, dialect.MAVLink_heartbeat_message(2, 12, base, mode << 16, 4, 3))
    simulator.AdvanceTo(3.0)
    assert port.Eval(simulator.get_context()).tolist() == told
    simulator.AdvanceTo(3.2)
    assert np.isnan(port.Eval(simulator.get_context())).all()
