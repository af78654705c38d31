"""One flight in which something goes wrong."""

from dataclasses import asdict
from typing import Any, cast

import numpy as np
from lcm import LCM
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem

from splatpilot.analysis.faults.fault import Fault
from splatpilot.analysis.faults.relay import Relay
from splatpilot.diagrams.flight import Outcome, flight_outcome, has_landed
from splatpilot.diagrams.flight_start import sample_initial_state
from splatpilot.diagrams.hardware_config import HardwareConfig
from splatpilot.diagrams.hardware_diagram import BuildHardwareDiagram, image_codecs
from splatpilot.diagrams.pilot import goal_of, make_policy
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.vehicle_diagram import BuildVehicleDiagram
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.messaging.codecs import CommandCodec, StateCodec
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.messaging.message_publisher import PUBLISH_OFFSET
from splatpilot.systems.messaging.unix_clock import UnixClock
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

TICK = 0.01  # [s]
_SETTLING = 4.0  # [s] after the fault in which the vehicle comes to rest, or flies on.
_LATEST = 12.0  # [s], the end of a trial.
_RESTING = 0.35  # [m/s]
_SLACK = 1.1  # [-], by which a limit may be exceeded while it is enforced.


class Nonsense(LeafSystem):
    """Passes an acceleration (3,), but for a time in which it is no number, or immense."""

    def __init__(self, fault: Fault) -> None:
        super().__init__()
        self._fault = fault
        self.DeclareVectorInputPort("sense", 3)
        self.DeclareVectorOutputPort("acceleration", 3, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        now, fault = context.get_time(), self._fault
        if fault.kind == "policy_nonsense" and fault.is_on(now):
            immense = fault.part > 0.65
            output.SetFromVector(np.full(3, 1e6 if immense else np.nan))
        else:
            output.SetFromVector(np.asarray(self.get_input_port().Eval(context)))


def spoilt_policy(scenario: Scenario, world: World, fault: Fault) -> Diagram:
    """The scenario's policy, which returns accelerations, with `Nonsense` after it."""
    builder = DiagramBuilder()
    policy = builder.AddNamedSystem("policy", make_policy(scenario, world))
    nonsense = builder.AddNamedSystem("nonsense", Nonsense(fault))
    builder.Connect(policy.GetOutputPort("acceleration"), nonsense.get_input_port())
    for index in range(policy.num_input_ports()):
        port = policy.get_input_port(index)
        builder.ExportInput(port, port.get_name())
    builder.ExportOutput(nonsense.get_output_port(), "acceleration")
    return builder.Build()


def fly_trial(scenario: Scenario, world: World, fault: Fault, seed: int) -> dict[str, Any]:
    """
    Flies a scenario, whose policy returns accelerations, through a fault.

    Vehicle and bridge are the very diagrams that fly by messages, each with a clock of its own
    diagram's time; what they say goes through a `Relay`.

    Returns:
        The fault, what the vehicle did (`most_speed` [m/s], `most_tilt` [rad], `least_clearance`
        [m], `inside`), how it ended (`outcome`), the reasons that the bridge gave, and whether that
        was `safe`.
    """
    config = HardwareConfig(tick=TICK)
    lcm, far = LCM("memq://"), LCM("memq://")
    policy = spoilt_policy(scenario, world, fault)
    vehicle = BuildVehicleDiagram(scenario, world, lcm, config)
    bridge = BuildHardwareDiagram(scenario, world, far, config, policy=policy)
    images = image_codecs(scenario, policy)
    random = np.random.default_rng(seed)
    relay = Relay(lcm, far, [StateCodec(), *images], [CommandCodec()], fault, random)
    simulators = {"vehicle": Simulator(vehicle), "bridge": Simulator(bridge)}
    ApplySimulatorConfig(scenario.simulator, simulators["vehicle"])
    root = simulators["vehicle"].get_mutable_context()
    plant = vehicle.GetSubsystemByName("plant").GetMyMutableContextFromRoot(root)
    plant.SetContinuousState(sample_initial_state(scenario, world))
    p_WG = goal_of(scenario, world)
    limits, field = config.failsafe.limits, world.distance_field
    measured = {"most_speed": 0.0, "most_tilt": 0.0, "least_clearance": np.inf, "inside": True}
    reasons: set[int] = set()
    end = min(fault.begin + min(fault.duration, 4.0) + _SETTLING, _LATEST)
    ended, mode, stalled = "", status.WAITING, 0.0
    for tick in range(round(end / TICK)):
        now = tick * TICK
        simulators["vehicle"].AdvanceTo(now + 2 * PUBLISH_OFFSET)
        relay.step(now)
        # A process that stood still has as much less time behind it.
        if fault.kind in ("policy_killed", "policy_stalled") and fault.is_on(now):
            stalled += TICK
        else:
            simulators["bridge"].AdvanceTo(now - stalled + 2 * PUBLISH_OFFSET)
            clock = cast(UnixClock, bridge.GetSubsystemByName("clock"))
            bridge_root = simulators["bridge"].get_mutable_context()
            clock.set_epoch(clock.GetMyMutableContextFromRoot(bridge_root), stalled)
            mode, reason = np.asarray(bridge.GetOutputPort("status").Eval(bridge_root))[:2]
            reasons.add(int(reason))
        state = QuadrotorState.of(np.asarray(vehicle.GetOutputPort("state").Eval(root)))
        clearance = float(np.asarray(vehicle.GetOutputPort("clearance").Eval(root))[0])
        measured["most_speed"] = max(measured["most_speed"], float(np.linalg.norm(state.v_WB)))
        measured["most_tilt"] = max(measured["most_tilt"], float(state.tilt))
        measured["inside"] &= bool(
            ((state.p_WB >= field.lower_W) & (state.p_WB <= field.upper_W)).all()
        )
        if has_landed(vehicle, root):
            ended = Outcome.LANDED
            break
        measured["least_clearance"] = min(measured["least_clearance"], clearance)
        outcome = flight_outcome(vehicle, root, p_WG, scenario.goal_radius)
        if outcome is not None:
            ended = outcome
            break
    if not ended:
        v_WB = QuadrotorState.of(np.asarray(vehicle.GetOutputPort("state").Eval(root))).v_WB
        if np.linalg.norm(v_WB[:2]) < _RESTING and v_WB[2] < _RESTING:
            ended = "hover" if abs(v_WB[2]) < _RESTING else "landing"
        else:
            ended = "flies on" if mode == status.FLYING and not fault.is_on(end) else "adrift"
    kept = (
        measured["most_speed"] <= _SLACK * limits.max_speed
        and measured["most_tilt"] <= _SLACK * limits.max_tilt
        and measured["least_clearance"] >= 0.0
        and measured["inside"]
    )
    safe = ("goal", "hover", "landing", "landed", "flies on")
    return {
        **asdict(fault),
        "seed": seed,
        **measured,
        "reasons": sorted(reasons - {status.NONE}),
        "outcome": str(ended),
        "safe": bool(kept and ended in safe),
    }
