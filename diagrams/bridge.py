"""`splatpilot bridge`: policy and controller fly a vehicle by messages."""

import contextlib
import logging
import math
import time
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram

from splatpilot.diagrams.flight import Outcome, flight_outcome, has_landed
from splatpilot.diagrams.hardware_config import HardwareConfig
from splatpilot.diagrams.hardware_diagram import BuildHardwareDiagram
from splatpilot.diagrams.pilot import goal_of
from splatpilot.diagrams.real_time import run_in_real_time
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.systems.messaging.generated import lcmt_bridge_status
from splatpilot.systems.messaging.message_log import recorded
from splatpilot.systems.messaging.message_subscriber import MessageSubscriber
from splatpilot.systems.messaging.open_lcm import open_lcm
from splatpilot.systems.messaging.time_of_flight_receiver import TimeOfFlightReceiver

_log = logging.getLogger(__name__)


def run(
    *,
    scenario: Scenario,
    config: HardwareConfig,
    log: Path | None = None,
    overwrite: bool = False,
) -> dict[str, float | str]:
    """
    Waits for a vehicle's messages and flies it to the scenario's goal.

    The flight begins when the bridge is in charge of a vehicle in the air, however long that takes:
    the vehicle says that it is armed and flies by the bridge, and touches nothing that the world's
    map has. It is over at the goal, after the scenario's timeout, if the world's map says that the
    vehicle has collided or left it while the bridge is in charge, and when it has landed, or state
    or images were older than allowed for `config.patience` (see `Failsafe` for what happens
    meanwhile). The vehicle then hears no more, upon which autopilots hold.

    Args:
        scenario: who flies, and where to.
        config: where messages travel.
        log: where to write all messages, as LCM's logger does.
        overwrite: that log, if it is there.

    Returns:
        How it ended (`outcome`: of `Outcome`, "timeout" or "silence"), `flight_time_s` since it
        began, and of `BridgeStatus` `gaps`, `rejected` and `overruns`.

    Raises:
        ValueError: for a scenario that cannot be flown by messages.
        OSError: if LCM does not work, nothing comes, or the log cannot be written.
    """
    scenario.validate()
    config.validate()
    lcm = open_lcm(config.url)
    with contextlib.nullcontext() if log is None else recorded(lcm, log, overwrite):
        world = make_world(scenario.world, scenario.seed)
        diagram = BuildHardwareDiagram(scenario, world, lcm, config)
        print(f"Waiting for a vehicle at {config.url}...", flush=True)
        wait_for_messages(diagram, config.patience)
        simulator = Simulator(diagram)
        root = simulator.get_context()
        flight = BridgeFlight(diagram, root, scenario, goal_of(scenario, world), config)
        # Decisions are due when images have just come, as long as both come at the same rate.
        run_in_real_time(
            simulator,
            diagram,
            config.tick,
            flight.is_over,
            ready=lambda: wait_for_messages(diagram, config.patience),
        )
    gaps, rejected, overruns = np.asarray(diagram.GetOutputPort("status").Eval(root))[4:]
    summary = {
        "outcome": flight.outcome,
        "flight_time_s": flight.duration,
        "gaps": gaps,
        "rejected": rejected,
        "overruns": overruns,
    }
    print(*(f"{name:<14} {value}" for name, value in summary.items()), sep="\n")
    return summary


class BridgeFlight:
    """
    A flight as the bridge sees it: it begins when the bridge is in charge of a vehicle in the air.

    Args:
        diagram, root: of `BuildHardwareDiagram`, and its Context.
        p_WG: (3,) [m] the goal.
        config: how old messages may be, and for how long.
    """

    def __init__(
        self,
        diagram: Diagram,
        root: Context,
        scenario: Scenario,
        p_WG: np.ndarray,
        config: HardwareConfig,
    ) -> None:
        self._diagram, self._root = diagram, root
        self._scenario, self._p_WG, self._config = scenario, p_WG, config
        self._in_charge, self._began, self._fresh = False, math.inf, -math.inf
        self.outcome = ""
        """Of `Outcome`, "timeout" or "silence"; empty until the flight is over."""
        self.duration = 0.0
        """[s]"""

    def is_over(self, now: float) -> bool:
        """Checks at a time [s] whether the flight is over, and how it ended."""
        status, charge, collision = (
            np.asarray(self._diagram.GetOutputPort(name).Eval(self._root))
            for name in ("status", "in_charge", "in_collision")
        )
        in_charge, landed = bool(charge[0]), has_landed(self._diagram, self._root)
        if in_charge != self._in_charge:
            # Not printed: a reader that is gone would end the flight.
            _log.warning("%.2f s: the bridge is %sin charge", now, "" if in_charge else "not ")
            self._in_charge = in_charge
        if in_charge and not landed and not collision[0]:
            self._began = min(self._began, now)
        if now < self._began:
            return False
        is_fresh = status[2:4].max() <= self._config.failsafe.max_age
        self._fresh = now if is_fresh else max(self._fresh, self._began)
        outcome = None
        if landed and (status[0] == lcmt_bridge_status.LANDING or not in_charge):
            outcome = Outcome.LANDED
        elif not is_fresh:
            outcome = "silence" if now > self._fresh + self._config.patience else None
        elif in_charge:
            radius = self._scenario.goal_radius
            outcome = flight_outcome(self._diagram, self._root, self._p_WG, radius)
        if now >= self._began + self._scenario.timeout:
            outcome = outcome or Outcome.TIMEOUT
        self.outcome, self.duration = str(outcome or ""), now - self._began
        return outcome is not None


def wait_for_messages(diagram: Diagram, patience: float) -> None:
    """
    Waits until something has come for each subscriber of a diagram.

    Args:
        diagram: of `BuildHardwareDiagram`.
        patience: [s], at most.

    Raises:
        TimeoutError: if nothing comes for one; the message names its channel.
    """
    deadline = time.monotonic() + patience
    subscribers = [
        s for s in diagram.GetSystems() if isinstance(s, MessageSubscriber | TimeOfFlightReceiver)
    ]
    for subscriber in subscribers:
        while not subscriber.has_message():
            if time.monotonic() > deadline:
                raise TimeoutError(
                    f"nothing has come on {subscriber.channel} for {patience:g} s; start the "
                    "vehicle, with the same URL and scenario"
                )
            time.sleep(0.001)
