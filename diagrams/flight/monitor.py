"""The end of a flight, as a system."""

import copy
import enum
import math
from collections.abc import Iterable
from typing import Any, cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    OutputPort,
    System,
    ValueProducer,
    WitnessFunction,
    WitnessFunctionDirection,
)
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from splatpilot.diagrams.flight.blocks import AddMovingBodies, ConnectInputs
from splatpilot.diagrams.flight.scenario import Scenario, goal_position, sample_scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf_collision import EsdfCollision
from splatpilot.systems.common.drake import ByValues, connect, vector_output, weak_callback
from splatpilot.systems.messaging.flight_limits import LEVEL
from splatpilot.systems.vehicle.state import QuadrotorState

LOG_PERIOD = 0.02  # [s]
_TOUCH = 0.03  # [m] max clearance of a landed vehicle
_TOUCHDOWN_SPEED = 0.8  # [m/s] max speed of a landed vehicle
_KNOWN = FieldState.UNKNOWN - 0.5  # Field states in the known volume are below.


class Outcome(enum.StrEnum):
    """Result of a flight."""

    GOAL = "goal"
    COLLISION = "collision"
    LEFT_VOLUME = "left_volume"
    TIMEOUT = "timeout"
    LANDED = "landed"
    ERROR = "error"
    INTERRUPTED = "interrupted"


ENDS = Outcome.COLLISION, Outcome.LEFT_VOLUME, Outcome.GOAL
"""Outcomes of flights besides timeouts; of several, the first counts."""


def _end(
    p_WB: Iterable[float],
    p_WG: Iterable[float],
    clearance: float,
    field_state: float,
    goal_radius: float,
) -> tuple[float, Outcome | None]:
    """Returns the minimum margin to `ENDS`, [m] or [-], and the first that is not positive."""
    margins = clearance, _KNOWN - field_state, math.dist(p_WG, p_WB) - goal_radius
    margin = min(m for m in margins if not math.isnan(m))
    if margin > 0:
        return margin, None
    return margin, next(end for end, m in zip(ENDS, margins, strict=True) if m <= 0)


def _declare_outcome(system: Any, timeout: float) -> None:
    """Declares the port and the events of the outcome of a flight."""
    calc = weak_callback(system._calc_outcome)
    system.DeclareAbstractOutputPort("outcome", lambda: Value(""), calc)
    system.DeclarePerStepPublishEvent(system._check)
    system.DeclarePeriodicPublishEvent(timeout, timeout, system._check)


class FlightMonitor(LeafSystem):
    """Ends a flight at a collision, outside the known volume, at the goal, or at its timeout.

    .. pydrake_system::

        name: FlightMonitor
        input_ports: [state, goal, clearance, field_state]
        output_ports: [outcome]

    - ``state`` (13), ``goal`` (3) p_WG [m]; ``clearance`` (1) [m], ``field_state`` (1): of
      `EsdfCollision`.
    - ``outcome``: str, of `Outcome` at this instant; empty during the flight.

    Each simulator step ends with ReachedTermination if the flight is over. Where the Context has an
    accuracy, as `make_flight_simulator` sets it, a witness function ends the step at that instant.
    Supports the scalars float and, by values and without the witness function, AutoDiffXd.
    """

    def __init__(self, scenario: Scenario, world: World) -> None:
        super().__init__(converter=_MonitorByValues.converter())
        scenario = sample_scenario(scenario)
        scenario.validate()
        self.scenario, self.world = copy.deepcopy(scenario), world
        for name, size in {"state": 13, "goal": 3, "clearance": 1, "field_state": 1}.items():
            self.DeclareVectorInputPort(name, size)
        _declare_outcome(self, scenario.timeout)
        calc = weak_callback(self._calc_end)
        self._end_index = self.DeclareCacheEntry(
            "end", ValueProducer(lambda: Value(object), calc), {self.all_input_ports_ticket()}
        ).cache_index()
        # Time [s] and margin of the last witness value that was not positive: a hint for `fly`.
        self.overrun: tuple[float, float] | None = None
        self._witness = self.MakeWitnessFunction(
            "end",
            WitnessFunctionDirection.kPositiveThenNonPositive,
            weak_callback(self._margin),
        )

    def DoGetWitnessFunctions(self, context: Context) -> list[WitnessFunction]:
        # Drake cannot isolate the instant without an accuracy.
        return [] if context.get_accuracy() is None else [self._witness]

    def _calc_end(self, context: Context, end: Any) -> None:
        p_WB, p_WG, clearance, field_state = (
            self._read(index, context, size) for index, size in enumerate((3, 3, 1, 1))
        )
        radius = self.scenario.goal_radius
        end.set_value(_end(p_WB, p_WG, clearance[0], field_state[0], radius))

    def _read(self, index: int, context: Context, size: int) -> list[float]:
        """Returns the first numbers at an input port; an array would cost several times as much."""
        vector = self.EvalVectorInput(context, index)
        if vector is None:  # Drake raises.
            self.get_input_port(index).Eval(context)
        return [vector.GetAtIndex(i) for i in range(size)]

    def _eval_end(self, context: Context) -> tuple[float, Outcome | None]:
        return cast(Any, self.get_cache_entry(self._end_index).Eval(context))

    def margin(self, context: Context) -> float:
        """Returns the minimum margin to an outcome other than a timeout, [m] or [-]."""
        return self._eval_end(context)[0]

    def _margin(self, context: Context) -> float:
        margin = self.margin(context)
        if margin <= 0:
            self.overrun = context.get_time(), margin
        return margin

    def outcome(self, context: Context) -> Outcome | None:
        """Returns the outcome at the instant of this system's Context; None during the flight."""
        is_late = context.get_time() >= self.scenario.timeout
        return self._eval_end(context)[1] or (Outcome.TIMEOUT if is_late else None)

    def _calc_outcome(self, context: Context, output: Any) -> None:
        output.set_value(str(self.outcome(context) or ""))

    def _check(self, context: Context) -> EventStatus:
        outcome = self.outcome(context)
        if outcome is None:
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(self, f"{self.get_name()}: {outcome}")


class _MonitorByValues(ByValues):
    """A monitor for AutoDiffXd."""

    def __init__(self, monitor: FlightMonitor) -> None:
        super().__init__(monitor)
        _declare_outcome(self, monitor.scenario.timeout)

    def _calc_outcome(self, context, output):
        self._system._calc_outcome(self.context_of_values(context), output)

    def _check(self, context):
        return self._system._check(self.context_of_values(context))


def AddFlightMonitor(
    builder: DiagramBuilder,
    scenario: Scenario,
    world: World,
    state: OutputPort,
    command: OutputPort,
    *,
    goal: OutputPort | None = None,
    collision: System | None = None,
    hypotheses: OutputPort | None = None,
    plan_period: float = LOG_PERIOD,
    logs: bool = True,
) -> FlightMonitor:
    """Adds the system `monitor`, and the logs of state, command and clearance that `fly` reads.

    Args:
        state: (13), the true one; command: (4).
        goal: p_WG (3) [m]; by default a source `goal` of the scenario's.
        collision: an `EsdfCollision`; by default one named `collision` of the world's field.
        hypotheses: plans to log, every `plan_period` [s].
        logs: adds the logs.
    """
    scenario = sample_scenario(scenario)
    if collision is None:
        collision = EsdfCollision(world.distance_field, scenario.vehicle.radius)
        builder.AddNamedSystem("collision", collision)
        if world.moving:
            AddMovingBodies(builder, world, [collision])
        connect(builder, state, collision.GetInputPort("state"))
    if goal is None:
        source = ConstantVectorSource(goal_position(scenario, world))
        goal = builder.AddNamedSystem("goal", source).get_output_port()
    monitor = FlightMonitor(scenario, world)
    builder.AddNamedSystem("monitor", monitor)
    measured = {name: collision.GetOutputPort(name) for name in ("clearance", "field_state")}
    ConnectInputs(builder, monitor, {"state": state, "goal": goal} | measured)
    if logs:
        AddLogs(builder, {"state": state, "command": command, "clearance": measured["clearance"]})
    if logs and hypotheses is not None:
        AddLogs(builder, {"hypotheses": hypotheses}, plan_period)
    return monitor


def AddLogs(
    builder: DiagramBuilder, ports: dict[str, OutputPort], period: float = LOG_PERIOD
) -> None:
    """Logs each port `p` in a sink `p_log`, every `period` [s]."""
    for name, port in ports.items():
        LogVectorOutput(port, builder, period).set_name(f"{name}_log")


def flight_monitors(diagram: Diagram) -> list[tuple[Diagram, FlightMonitor]]:
    """Returns all monitors in a diagram, each with the diagram that holds it."""
    found = []
    for system in diagram.GetSystems():
        if isinstance(system, FlightMonitor):
            found.append((diagram, system))
        elif isinstance(system, Diagram):
            found += flight_monitors(system)
    return found


def flight_outcome(
    diagram: Diagram, context: Context, p_WG: np.ndarray, goal_radius: float
) -> Outcome | None:
    """Returns the outcome at this instant, by the ports of a hardware diagram; None in flight."""
    state, clearance, field_state = (
        vector_output(diagram, name, context) for name in ("state", "clearance", "field_state")
    )
    p_WB = QuadrotorState.of(state).p_WB
    return _end(p_WB, p_WG, clearance[0], field_state[0], goal_radius)[1]


def has_landed(diagram: Diagram, context: Context) -> bool:
    """Checks if the vehicle touches a level surface at less than 0.8 m/s."""
    v_WB = QuadrotorState.of(vector_output(diagram, "state", context)).v_WB
    return bool(
        vector_output(diagram, "clearance", context)[0] < _TOUCH
        and vector_output(diagram, "gradient", context)[2] > LEVEL
        and np.linalg.norm(v_WB) < _TOUCHDOWN_SPEED
    )
