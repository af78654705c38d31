"""`splatpilot px4`: a vehicle that PX4 flies, behind the bridge's messages."""

import time

import numpy as np
from pydrake.systems.analysis import Simulator

from splatpilot.diagrams.px4_config import Px4Config
from splatpilot.diagrams.px4_diagram import BuildPx4Diagram
from splatpilot.diagrams.real_time import run_in_real_time
from splatpilot.systems.messaging.open_lcm import open_lcm
from splatpilot.systems.messaging.udp_inbox import UdpInbox
from splatpilot.systems.px4.mavlink import OFFBOARD
from splatpilot.systems.px4.px4_telemetry import HEARTBEAT_TIMEOUT

REMINDER = 10.0
"""[s] of silence after each of which it says that there is no heartbeat."""


def run(*, config: Px4Config, duration: float = np.inf) -> None:
    """
    Stands between the bridge and PX4, for `duration` [s], or until it is interrupted.

    It says when PX4 is heard, armed, and in offboard mode, and when it is not any more; and every
    ten seconds how long there has been no heartbeat.

    Raises:
        ValueError: for a configuration out of range.
        OSError: if LCM does not work or the port is in use.
        ModuleNotFoundError: where pymavlink is not installed.
    """
    config.validate()
    lcm, inbox = open_lcm(config.url), UdpInbox(config.udp)
    try:
        epoch = time.time() - time.monotonic()
        diagram = BuildPx4Diagram(config, lcm, inbox, now=lambda: epoch + time.monotonic())
        simulator = Simulator(diagram)
        root = simulator.get_context()
        asked = config.commander
        print(f"PX4's packets come to {config.udp.host}:{inbox.port}.", flush=True)
        for what, is_asked in (("Offboard mode", asked.engage), ("Arming", asked.arm)):
            print(f"{what} is {'asked for' if is_asked else 'left to the pilot'}.", flush=True)
        before, reminders = (False, False, False), 0

        def over(now: float) -> bool:
            nonlocal before, reminders
            age, armed, mode = (
                np.asarray(diagram.GetOutputPort(name).Eval(root))
                for name in ("heartbeat_age", "armed", "mode")
            )
            is_so = bool(age[0] <= HEARTBEAT_TIMEOUT), bool(armed[0]), mode[0] == OFFBOARD[0]
            if is_so != before:
                heard, armed_so, offboard = is_so
                what = (
                    f"heard, {'armed' if armed_so else 'disarmed'}, "
                    f"{'in' if offboard else 'not in'} offboard mode"
                )
                print(f"{now:8.2f} s: PX4 is {what if heard else 'not heard'}", flush=True)
                before = is_so
            silences = int(min(age[0], now) / REMINDER)
            if silences > reminders:
                print(
                    f"{now:8.2f} s: no heartbeat for {silences * REMINDER:g} s at "
                    f"{config.udp.host}:{inbox.port}",
                    flush=True,
                )
            reminders = silences
            return now >= duration

        run_in_real_time(simulator, diagram, config.tick, over)
    finally:
        inbox.close()
