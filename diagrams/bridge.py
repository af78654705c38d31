"""`splatpilot bridge`: policy and controller fly a vehicle by messages."""

import contextlib
import time
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

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


def run(
    *,
    scenario: Scenario,
    config: HardwareConfig,
    log: Path | None = None,
    overwrite: bool = False,
) -> dict[str, float | str]:
    """
    Waits for a vehicle's messages and flies it to the scenario's goal.

    It is over at the goal, after the scenario's timeout, where the world's map says that the
    vehicle has collided or left it, and when it has landed, or state or images were older than
    allowed for `config.patience` (see `Failsafe` for what happens meanwhile). The vehicle then
    hears no more, upon which autopilots hold.

    Args:
        scenario: who flies, and where to.
        config: where messages travel.
        log: where to write all messages, as LCM's logger does.
        overwrite: that log, if it is there.

    Returns:
        How it ended (`outcome`: of `Outcome`, "timeout" or "silence"), `flight_time_s`, and of
        `BridgeStatus` `gaps`, `rejected` and `overruns`.

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
        p_WG = goal_of(scenario, world)
        ended = {"outcome": "timeout", "time": scenario.timeout, "fresh": 0.0}

        def over(now: float) -> bool:
            status = np.asarray(diagram.GetOutputPort("status").Eval(root))
            if status[0] == lcmt_bridge_status.LANDING and has_landed(diagram, root):
                outcome = Outcome.LANDED
            elif status[2:4].max() <= config.failsafe.max_age:
                ended["fresh"] = now
                outcome = flight_outcome(diagram, root, p_WG, scenario.goal_radius)
            else:
                outcome = "silence" if now > ended["fresh"] + config.patience else None
            if outcome is None and now < scenario.timeout:
                return False
            ended.update(outcome=str(outcome or "timeout"), time=now)
            return True

        # Decisions are due when images have just come, as long as both come at the same rate.
        run_in_real_time(
            simulator,
            diagram,
            config.tick,
            over,
            ready=lambda: wait_for_messages(diagram, config.patience),
        )
    gaps, rejected, overruns = np.asarray(diagram.GetOutputPort("status").Eval(root))[4:]
    summary = {
        "outcome": ended["outcome"],
        "flight_time_s": ended["time"],
        "gaps": gaps,
        "rejected": rejected,
        "overruns": overruns,
    }
    print(*(f"{name:<14} {value}" for name, value in summary.items()), sep="\n")
    return summary


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
