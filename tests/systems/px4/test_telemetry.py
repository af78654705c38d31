from collections.abc import Callable

import numpy as np
import pytest
from harness import Harness, Packets
from pymavlink.dialects.v20 import common as dialect
from scipy.spatial.transform import Rotation

from splatpilot.systems.px4.mavlink import Mavlink
from splatpilot.systems.px4.telemetry import Px4Telemetry

EPOCH = 1_800_000_000.0  # [s] Unix time of the Context's time 0.
BOOT = 1_799_999_000.0  # [s] Unix time when PX4 began.


def position(time: float, x: float = 1.0):
    return dialect.MAVLink_local_position_ned_message(round(1e3 * time), x, 2.0, -3.0, 0.5, 0, 0)


def attitude(time: float, yaw: float = 0.0, rate: float = 0.0):
    q = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
    return dialect.MAVLink_attitude_quaternion_message(round(1e3 * time), *q, 0.1, 0.2, rate)


class Link(Harness):
    """Telemetry, and PX4's end of it."""

    def __init__(self, now: Callable[[], float] | None = None):
        self.packets, self.mavlink = Packets(), dialect.MAVLink(None, 1, 1)
        system = Px4Telemetry(self.packets, Mavlink(), ("127.0.0.1", 9), 0.01, now)
        super().__init__(system, unix_time=EPOCH)

    @property
    def boot_time(self) -> float:
        """[s] By PX4's clock."""
        return EPOCH + self.now - BOOT

    def send(self, *messages, raw: bytes = b"") -> None:
        """Sends messages in one packet."""
        packed = (bytes(message.pack(self.mavlink)) for message in messages)
        self.packets.waiting.append(b"".join(packed) + raw)

    def send_state(self, late: float = 0.0, **values) -> None:
        """Sends position and attitude of `late` [s] ago."""
        time = self.boot_time - late
        self.send(position(time, **values), attitude(time))

    def advance(self, duration: float) -> list:
        """The TIMESYNC messages that are sent meanwhile."""
        for _ in range(round(duration / 0.01)):
            self.simulator.AdvanceTo(round(self.now + 0.01, 6))
            self.give(unix_time=EPOCH + self.now)
        return self.packets.take_sent()


@pytest.fixture
def link() -> Link:
    return Link()


def test_state_needs_position_and_attitude(link, caplog):
    link.send(position(link.boot_time))
    link.advance(0.1)
    assert link.out("age") == np.inf
    link.send(position(link.boot_time), attitude(link.boot_time, rate=0.3))
    link.advance(0.05)
    expected = [1, -2, 3, 0.5, 0, 0, 1, 0, 0, 0, 0.1, -0.2, -0.3]
    np.testing.assert_allclose(link.out("state"), expected, rtol=1e-6)
    assert link.out("age") == pytest.approx(0.05, abs=1e-3)
    link.send(raw=b"nonsense")
    link.packets.strangers = 1
    link.advance(0.05)
    np.testing.assert_allclose(link.out("state"), expected, rtol=1e-6)
    assert link.out("rejected") == 2
    assert "PX4: message rejected" in caplog.text


@pytest.mark.parametrize("late", ["position", "attitude"])
def test_position_and_attitude_are_brought_to_the_time_of_the_older(link, late):
    start = link.boot_time
    link.send(position(start), attitude(start, yaw=1.0, rate=2.0))
    link.advance(0.04)
    newer = {"position": attitude(start + 0.04, 1.08, 2), "attitude": position(start + 0.04, 1.02)}
    link.send(newer[late])
    link.advance(0.01)
    assert link.out("age") == pytest.approx(0.05, abs=1e-3)
    yaw = Rotation.from_quat(link.out("state")[6:10], scalar_first=True).as_euler("ZYX")[0]
    assert (link.out("state")[0], yaw) == pytest.approx((1.0, -1.0), abs=1e-3)


@pytest.mark.parametrize("back", [0.0, 0.5, 20.0])
def test_older_states_are_counted_and_change_nothing(link, back):
    link.advance(0.5)
    link.send_state()
    link.advance(0.1)
    link.send_state(0.1 + back, x=9.0)
    link.advance(0.01)
    assert link.out("state")[0] == 1.0
    assert link.out("age") == pytest.approx(0.11, abs=1e-3)
    assert link.out("rejected") == 2


def test_px4_may_start_again_and_asks_for_the_time(link):
    link.send(dialect.MAVLink_timesync_message(0, 12345))
    (answer,) = [each for each in link.advance(0.05) if each.tc1]
    assert (answer.ts1, answer.tc1) == (12345, pytest.approx(1e9 * EPOCH, abs=2e4))
    link.send_state()
    link.advance(1.5)
    link.send(position(2.0, x=9.0))
    link.advance(0.02)
    assert link.out("age") == np.inf
    link.send(attitude(2.02))
    link.advance(0.03)
    assert link.out("state")[0] == pytest.approx(9.0)
    assert link.out("age") == pytest.approx(0.05, abs=1e-3)
    assert link.out("rejected") == 0


@pytest.mark.parametrize("silence", [0.0, 1.5])
def test_a_link_that_buffers_is_seen_in_the_age(link, silence):
    for late, pause in ((0.0, silence), (0.1, 0.0)):
        for _ in range(20):
            link.send_state(late)
            link.advance(0.02)
        link.advance(pause)
    assert link.out("age") == pytest.approx(0.12, abs=2e-3)


def test_a_link_that_is_slow_from_the_start_is_seen_by_answers(link):
    waiting = []
    for _ in range(100):
        for message in link.advance(0.01):
            at = round(1e9 * (link.boot_time + 0.03))
            answer = dialect.MAVLink_timesync_message(at, message.ts1)
            waiting.append((link.now + 0.07, answer))
        link.send_state(0.04)
        while waiting and waiting[0][0] <= link.now + 1e-6:
            link.send(waiting.pop(0)[1])
    assert link.out("age") == pytest.approx(0.05, abs=2e-3)


def test_a_process_that_is_behind_takes_no_message_for_faster():
    late = 0.0
    link = Link(lambda: EPOCH + link.now + late)
    for late in (0.0, 0.05, 0.0):
        link.send_state(-late)
        link.advance(0.1)
    assert link.out("age") == pytest.approx(0.1, abs=1e-3)


def test_granted_commands_are_remembered(link):
    accepted, denied = dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_DENIED
    others = (400, accepted, 0, 0, 1, 190)  # of another process
    for answers, granted in (
        ([], [0, 0]),
        ([(176, accepted), (400, denied), others], [1, 0]),
        ([(400, accepted, 0, 0, 1, 191)], [1, 1]),
    ):
        link.send(*(dialect.MAVLink_command_ack_message(*answer) for answer in answers))
        link.advance(0.02)
        assert link.out("granted").tolist() == granted


def test_refusals_and_warnings_of_px4_are_logged_once(link, caplog):
    denied = dialect.MAVLink_command_ack_message(176, dialect.MAV_RESULT_DENIED)
    for severity, text in ((2, b"Arming denied: no home"), (6, b"Takeoff detected")):
        for _ in range(2):
            link.send(denied)
            link.advance(0.02)
        link.send(dialect.MAVLink_statustext_message(severity, text))
        link.advance(0.02)
    refusal = "PX4: the answer to the request for a mode is DENIED"
    assert caplog.messages == [refusal, "PX4: Arming denied: no home", refusal]


@pytest.mark.parametrize(
    ("base", "mode", "told"), [(129, 6, [1, 1]), (129, 3, [1, 0]), (1, 6, [0, 1])]
)
def test_modes_are_those_of_the_last_heartbeat_unless_it_is_old(link, base, mode, told):
    link.advance(0.1)
    assert link.out("heartbeat_age") == np.inf
    assert np.isnan(link.out("vehicle_status")).all()
    link.send(dialect.MAVLink_heartbeat_message(2, 12, base, mode << 16, 4, 3))
    link.advance(2.9)
    assert link.out("vehicle_status").tolist() == told
    assert link.out("armed") == told[0] and link.out("mode").tolist() == [mode, 0.0]
    link.advance(0.2)
    assert link.out("armed") == 0 and link.out("mode").tolist() == [0.0, 0.0]
    assert link.out("heartbeat_age") == pytest.approx(3.1, abs=0.011)
    assert np.isnan(link.out("vehicle_status")).all()
