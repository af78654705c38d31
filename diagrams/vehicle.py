"""`splatpilot vehicle`: a simulated vehicle that is flown by messages."""

import dataclasses
import math
import time
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

from splatpilot.diagrams.flight import (
    Flight,
    Outcome,
    flight_outcome,
    has_landed,
    record_flight,
)
from splatpilot.diagrams.flight_files import write_flight, write_summary
from splatpilot.diagrams.flight_start import sample_initial_state
from splatpilot.diagrams.hardware_config import HardwareConfig
from splatpilot.diagrams.pilot import goal_of
from splatpilot.diagrams.real_time import run_in_real_time
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.vehicle_diagram import BuildVehicleDiagram
from splatpilot.diagrams.worlds.appearance import seen_otherwise
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.systems.files import require_writable_folder
from splatpilot.systems.messaging.open_lcm import open_lcm
from splatpilot.systems.output_folders import holds_folder


@holds_folder("out")
def run(*, scenario: Scenario, config: HardwareConfig, out: Path) -> dict[str, float | str]:
    """
    Hovers at the scenario's start until commands come, flies by them until the flight ends, hovers
    and then lands where they cease, and leaves in `out` what `write_flight` and `write_summary`
    write. Time is counted from the first command.

    Args:
        scenario: the vehicle, its world, its start, and what its policy sees.
        config: where messages travel.

    Returns:
        `Flight.summary()` and `overruns`, of ticks.

    Raises:
        ValueError: for a scenario that cannot be flown by messages.
        OSError: if LCM does not work, no command comes within `config.patience`, or `out` cannot be
            written.
    """
    scenario.validate()
    config.validate()
    lcm = open_lcm(config.url)
    world = make_world(scenario.world, scenario.seed)
    world = seen_otherwise(world, scenario.appearance, scenario.seed)
    start = sample_initial_state(scenario, world)
    require_writable_folder(out)
    diagram = BuildVehicleDiagram(scenario, world, lcm, config)
    simulator = Simulator(diagram)
    ApplySimulatorConfig(scenario.simulator, simulator)
    root = simulator.get_mutable_context()
    plant = diagram.GetSubsystemByName("plant").GetMyMutableContextFromRoot(root)
    plant.SetContinuousState(start)
    p_WG = goal_of(scenario, world)
    took_off = math.inf

    def how_it_ended() -> Outcome | None:
        if has_landed(diagram, root):
            return Outcome.LANDED
        return flight_outcome(diagram, root, p_WG, scenario.goal_radius)

    def over(now: float) -> bool:
        nonlocal took_off
        if math.isinf(np.asarray(diagram.GetOutputPort("command_age").Eval(root))[0]):
            if now > config.patience:
                raise TimeoutError(
                    f"no command has come for {config.patience:g} s; start the bridge, with the "
                    "same URL and scenario"
                )
            return False
        took_off = min(took_off, now)
        return how_it_ended() is not None or now - took_off >= scenario.timeout

    print(f"Hovering at {config.url} until commands come...", flush=True)
    started = time.monotonic()
    overruns = run_in_real_time(simulator, diagram, config.tick, over)
    wall_time = time.monotonic() - started
    diagram.ForcedPublish(root)  # Who flies is to know the last state too.
    outcome = how_it_ended() or Outcome.TIMEOUT
    flight = _since(took_off, record_flight(diagram, root, world, outcome, wall_time))
    write_flight(out, scenario, flight)
    summary = flight.summary() | {"overruns": overruns}
    write_summary(out, summary)
    print(*(f"{name:<18} {value}" for name, value in summary.items()), sep="\n")
    return summary


def _since(time: float, flight: Flight) -> Flight:
    """A flight without what was before `time` [s], which is its time 0."""
    rows = flight.times >= time
    return dataclasses.replace(
        flight,
        times=flight.times[rows] - time,
        states=flight.states[rows],
        commands=flight.commands[rows],
        clearances=flight.clearances[rows],
        wall_time=flight.wall_time - time,
    )
