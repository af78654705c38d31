"""One flight in which something goes wrong."""

from dataclasses import asdict
from typing import Any, cast

import numpy as np
from lcm import LCM
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem

from splatpilot.analysis.faults.fault import Fault, Trial
from splatpilot.analysis.faults.relay import GridStream, Relay
from splatpilot.diagrams.flight import Outcome, flight_outcome, has_landed
from splatpilot.diagrams.flight_start import sample_initial_state
from splatpilot.diagrams.hardware_config import HardwareConfig
from splatpilot.diagrams.hardware_diagram import BuildHardwareDiagram, image_codecs
from splatpilot.diagrams.pilot import goal_of, make_policy
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.vehicle_diagram import BuildVehicleDiagram
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.messaging.codecs import (
    CommandCodec,
    MotionCaptureCodec,
    StateCodec,
    VehicleStatusCodec,
    VelocitySetpointCodec,
)
from splatpilot.systems.messaging.failsafe_config import FailsafeConfig
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.messaging.message_publisher import PUBLISH_OFFSET
from splatpilot.systems.messaging.time_of_flight_receiver import (
    TimeOfFlightReceiver,
    TimeOfFlightStream,
)
from splatpilot.systems.messaging.udp_inbox import UdpConfig
from splatpilot.systems.messaging.unix_clock import UnixClock
from splatpilot.systems.vehicle.flight_limits import FlightLimits
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState

TICK = 0.01  # [s]
_SETTLING = 4.0  # [s] after the fault in which the vehicle comes to rest, or flies on.
_LATEST = 12.0  # [s], the end of a trial.
_RESTING = 0.35  # [m/s]
_SLACK = 1.1  # [-], by which speed and tilt may exceed their limits while these are enforced,
_TOLERANCE = 0.01  # [m], and by which distances may fall short of theirs.
_BODY = "vehicle"


class Nonsense(LeafSystem):
    """Passes a decision (3,), except for times in which it is not finite, immense or an error."""

    def __init__(self, faults: tuple[Fault, ...]) -> None:
        super().__init__()
        self._faults = faults
        self.DeclareVectorInputPort("sense", 3)
        self.DeclareVectorOutputPort("decision", 3, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(np.asarray(self.get_input_port().Eval(context)))
        for fault in self._faults:
            if fault.kind == "policy_raises" and fault.is_on(context.get_time()):
                raise RuntimeError("the policy fails")
            if fault.kind == "policy_nonsense" and fault.is_on(context.get_time()):
                output.SetFromVector(np.full(3, 1e6 if fault.fraction > 0.65 else np.nan))


def spoilt_policy(scenario: Scenario, world: World, faults: tuple[Fault, ...]) -> Diagram:
    """The scenario's policy, which returns accelerations or velocities, with `Nonsense` after
    it."""
    builder = DiagramBuilder()
    policy = builder.AddNamedSystem("policy", make_policy(scenario, world))
    nonsense = builder.AddNamedSystem("nonsense", Nonsense(faults))
    kind = "acceleration" if policy.HasOutputPort("acceleration") else "velocity"
    builder.Connect(policy.GetOutputPort(kind), nonsense.get_input_port())
    for index in range(policy.num_input_ports()):
        port = policy.get_input_port(index)
        builder.ExportInput(port, port.get_name())
    builder.ExportOutput(nonsense.get_output_port(), kind)
    return builder.Build()


def fly_trial(
    scenario: Scenario, world: World, trial: Trial, limits: FlightLimits, seed: int
) -> dict[str, Any]:
    """
    Flies a scenario, whose policy returns accelerations or velocities, through faults.

    Vehicle and bridge are the very diagrams that fly by messages, each with a clock of its own
    diagram's time; what they say goes through a `Relay`.

    Returns:
        The trial, what the vehicle did (`max_speed` [m/s], `max_tilt` [rad] and, except while it
        lands, `min_clearance` [m] and `min_inside` [m], the distance of the collision sphere from
        the fence), how it ended (`outcome`), the reasons that the bridge gave, and whether that was
        `safe`.
    """
    faults = trial.faults
    config = HardwareConfig(
        tick=TICK,
        setpoints=trial.setpoints,
        body=_BODY,
        time_of_flight=TimeOfFlightStream(UdpConfig(port=0)),
        failsafe=FailsafeConfig(limits=limits),
    )
    lcm, far = LCM("memq://"), LCM("memq://")
    policy = spoilt_policy(scenario, world, faults)
    vehicle = BuildVehicleDiagram(scenario, world, lcm, config)
    bridge = BuildHardwareDiagram(scenario, world, far, config, policy=policy)
    images = image_codecs(scenario, policy)
    grids = None
    if bridge.HasSubsystemNamed("depth_grid_receiver"):
        receiver = bridge.GetSubsystemByName("depth_grid_receiver")
        grids = GridStream(cast(TimeOfFlightReceiver, receiver).port)
    relay = Relay(
        lcm,
        far,
        [StateCodec(), VehicleStatusCodec(), MotionCaptureCodec(_BODY), *images],
        [CommandCodec(), VelocitySetpointCodec()],
        faults,
        np.random.default_rng(seed),
        grids,
    )
    simulators = {"vehicle": Simulator(vehicle), "bridge": Simulator(bridge)}
    ApplySimulatorConfig(scenario.simulator, simulators["vehicle"])
    root = simulators["vehicle"].get_mutable_context()
    plant = vehicle.GetSubsystemByName("plant").GetMyMutableContextFromRoot(root)
    plant.SetContinuousState(sample_initial_state(scenario, world))
    autopilot = vehicle.GetSubsystemByName("failsafe")
    autopilot_context = autopilot.GetMyContextFromRoot(root)
    p_WG, field = goal_of(scenario, world), world.distance_field
    measured = {"max_speed": 0.0, "max_tilt": 0.0, "min_clearance": np.inf, "min_inside": np.inf}
    reasons: set[int] = set()
    last = max(fault.begin + min(fault.duration, 4.0) for fault in faults)
    end = min(last + _SETTLING, _LATEST)
    ended, mode, stalled = "", status.WAITING, 0.0
    for tick in range(round(end / TICK)):
        now = tick * TICK
        simulators["vehicle"].AdvanceTo(now + 2 * PUBLISH_OFFSET)
        relay.step(now)
        # A process that stood still has as much less time behind it.
        if any(f.kind in ("policy_killed", "policy_stalled") and f.is_on(now) for f in faults):
            stalled += TICK
        else:
            simulators["bridge"].AdvanceTo(now - stalled + 2 * PUBLISH_OFFSET)
            clock = cast(UnixClock, bridge.GetSubsystemByName("clock"))
            bridge_root = simulators["bridge"].get_mutable_context()
            clock.set_epoch(clock.GetMyMutableContextFromRoot(bridge_root), stalled)
            mode, reason = np.asarray(bridge.GetOutputPort("status").Eval(bridge_root))[:2]
            reasons.add(int(reason))
        state = QuadrotorState.of(np.asarray(vehicle.GetOutputPort("state").Eval(root)))
        measured["max_speed"] = max(measured["max_speed"], float(np.linalg.norm(state.v_WB)))
        measured["max_tilt"] = max(measured["max_tilt"], float(state.tilt))
        if has_landed(vehicle, root):
            ended = Outcome.LANDED
            break
        by_itself = np.asarray(autopilot.GetOutputPort("mode").Eval(autopilot_context))[0]
        if status.LANDING not in (mode, by_itself):
            clearance = float(np.asarray(vehicle.GetOutputPort("clearance").Eval(root))[0])
            to_fence = np.min([state.p_WB - field.lower_W, field.upper_W - state.p_WB])
            for name, value in (
                ("min_clearance", clearance),
                ("min_inside", float(to_fence) - VEHICLE_RADIUS),
            ):
                measured[name] = min(measured[name], value)
        outcome = flight_outcome(vehicle, root, p_WG, scenario.goal_radius)
        if outcome is not None:
            ended = outcome
            break
    if not ended:
        v_WB = QuadrotorState.of(np.asarray(vehicle.GetOutputPort("state").Eval(root))).v_WB
        if np.linalg.norm(v_WB[:2]) < _RESTING and v_WB[2] < _RESTING:
            ended = "hover" if abs(v_WB[2]) < _RESTING else "landing"
        else:
            is_on = any(fault.is_on(end) for fault in faults)
            ended = "flies on" if mode == status.FLYING and not is_on else "adrift"
    kept = (
        measured["max_speed"] <= _SLACK * limits.max_speed
        and measured["max_tilt"] <= _SLACK * limits.max_tilt
        and measured["min_clearance"] >= limits.min_clearance - _TOLERANCE
        and measured["min_inside"] >= -_TOLERANCE
    )
    safe = ("goal", "hover", "landing", "landed", "flies on")
    return {
        **asdict(trial),
        "seed": seed,
        **measured,
        "reasons": sorted(reasons - {status.NONE}),
        "outcome": str(ended),
        "safe": bool(kept and ended in safe),
    }
