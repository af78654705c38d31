"""One flight with faults."""

import heapq
import math
import socket
import struct
from dataclasses import asdict, dataclass
from typing import Any, cast

import numpy as np
from lcm import LCM
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem

from splatpilot.diagrams.flight.blocks import goal_position, make_policy
from splatpilot.diagrams.flight.flight import (
    Outcome,
    flight_outcome,
    has_landed,
    sample_initial_state,
)
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram, HardwareConfig, image_codecs
from splatpilot.diagrams.hardware.vehicle import BuildVehicleDiagram
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.drake import weakly
from splatpilot.systems.messaging.bridge_status import UnixClock
from splatpilot.systems.messaging.codecs import (
    Codec,
    CommandCodec,
    MotionCaptureCodec,
    StateCodec,
    VehicleStatusCodec,
    VelocitySetpointCodec,
)
from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.messaging.lcm_ports import PUBLISH_OFFSET
from splatpilot.systems.messaging.receiver import UdpConfig
from splatpilot.systems.messaging.tof_receiver import TimeOfFlightReceiver, TimeOfFlightStream
from splatpilot.systems.sensing.time_of_flight import GRID_MAGIC
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState

KINDS = (
    "dropped",
    "delayed",
    "duplicated",
    "reordered",
    "clock_jump",
    "state_frozen",
    "state_jumped",
    "body_lost",
    "body_dropped",
    "grid_dropped",
    "grid_corrupt",
    "policy_nonsense",
    "policy_raises",
    "policy_stalled",
    "policy_killed",
    "not_finite",
    "corrupt",
)
"""Types of faults: messages are dropped, 300 ms late, sent twice, or overtake each other; the
vehicle's clock jumps; its state is constant, or meters off; motion capture loses the vehicle, or
its messages are dropped; packets of the time-of-flight sensor are dropped, or have flipped bits;
the policy outputs nonsense or raises exceptions, its process stalls or ends; messages contain NaN,
or have flipped bits.

Of two faults, the earlier one here is applied first: messages are decoded before corruption."""

DELAY = 0.3
"""[s] of delayed messages."""

_FOREVER = 1e6  # [s]


@dataclass(frozen=True)
class Fault:
    """A fault of a trial."""

    kind: str
    begin: float  # [s]
    duration: float  # [s]
    fraction: float  # [-] of messages with the fault.
    size: float  # [s] jump of the clock; its sign is that of the jump of the state.

    @classmethod
    def sample(cls, kind: str, random: np.random.Generator) -> "Fault":
        """Samples a fault of a type."""
        return cls(
            kind=kind,
            begin=float(random.uniform(0.5, 3.0)),
            duration=_FOREVER if kind == "policy_killed" else float(random.uniform(0.3, 4.0)),
            fraction=float(random.uniform(0.3, 1.0)),
            size=float(random.choice([-1.0, 1.0]) * 10 ** random.uniform(-1.0, 1.0)),
        )

    def is_on(self, now: float) -> bool:
        """Checks if the fault is on at a time [s]."""
        return self.begin <= now < self.begin + self.duration


@dataclass(frozen=True)
class Trial:
    """Faults, policy and commands of a flight."""

    faults: tuple[Fault, ...]
    policy: str
    setpoints: str  # see `HardwareConfig.setpoints`.

    @classmethod
    def sample(cls, number: int, random: np.random.Generator) -> "Trial":
        """Samples the trial of a number. Types of faults, commands and policies alternate; about
        half of the trials have two faults. Faults of grids need the policy with that input."""
        turn, kind = divmod(number, len(KINDS))
        kinds = [kind]
        if random.random() < 0.5:
            kinds.append(int(random.choice([k for k in range(len(KINDS)) if k != kind])))
        faults = tuple(Fault.sample(KINDS[k], random) for k in sorted(kinds))
        needs_grid = any(fault.kind.startswith("grid") for fault in faults)
        policy = "diffaero_tof" if needs_grid else ("straight", "reactive")[turn // 2 % 2]
        return cls(faults, policy, ("velocity", "body_rates")[turn % 2])


class GridStream:
    """Sends a sensor's packets by UDP to a port of this host."""

    def __init__(self, port: int) -> None:
        self._port = port

    def publish(self, _: str, data: bytes) -> None:
        """Sends a packet."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto(data, ("127.0.0.1", self._port))


class Relay:
    """
    Carries messages between two LCMs, with faults.

    Args:
        vehicle, bridge: transports of either.
        from_vehicle, from_bridge: codecs of their messages.
        faults: of the trial.
        random: source of randomness.
        grids: replaces the LCM for grids of the vehicle.
    """

    def __init__(
        self,
        vehicle: LCM,
        bridge: LCM,
        from_vehicle: list[Codec],
        from_bridge: list[Codec],
        faults: tuple[Fault, ...],
        random: np.random.Generator,
        grids: GridStream | None = None,
    ) -> None:
        self._faults, self._random, self._grids = faults, random, grids
        self._ends, self._count, self._now = (vehicle, bridge), 0, 0.0
        self._waiting: list[tuple[float, int, LCM | GridStream, str, bytes]] = []
        self._state: Any = None
        for sender, codecs in ((vehicle, from_vehicle), (bridge, from_bridge)):
            for codec in codecs:
                sender.subscribe(codec.channel, self._taker(codec, sender is vehicle))

    def step(self, now: float) -> None:
        """Receives messages, and delivers those that are due at a time [s]."""
        self._now = now
        for end in self._ends:
            while end.handle_timeout(0):
                pass
        while self._waiting and self._waiting[0][0] <= now:
            _, _, receiver, channel, data = heapq.heappop(self._waiting)
            receiver.publish(channel, data)

    def _taker(self, codec: Codec, from_vehicle: bool):
        # The relay owns LCM, which owns its callbacks.
        take = weakly(self._take)
        return lambda channel, data: take(codec, from_vehicle, channel, data)

    def _take(self, codec: Codec, from_vehicle: bool, channel: str, data: bytes) -> None:
        receiver: LCM | GridStream = self._ends[1 if from_vehicle else 0]
        if codec.port == "depth_grid" and self._grids is not None:
            receiver, message = self._grids, codec.message.decode(data)
            head = GRID_MAGIC, message.header.seq, message.header.utime * 1000
            data = struct.pack(f"<IIQ{message.num_values}f", *head, *message.values)
        copies = [(0.0, data)]
        for fault in self._faults:
            copies = [
                (delay + later, changed)
                for delay, sent in copies
                for later, changed in self._treat(fault, codec, sent, from_vehicle)
            ]
        for delay, sent in copies:
            self._count += 1
            due = self._now + delay
            heapq.heappush(self._waiting, (due, self._count, receiver, channel, sent))

    def _treat(
        self, fault: Fault, codec: Codec, data: bytes, from_vehicle: bool
    ) -> list[tuple[float, bytes]]:
        """Applies a fault to a message; returns delays [s] and contents of its copies."""
        random, is_on, unchanged = self._random, fault.is_on(self._now), [(0.0, data)]
        if fault.kind == "clock_jump" and from_vehicle and codec.port != "depth_grid":
            jump = round(fault.size * 1e6) if self._now >= fault.begin else 0
            return [(0.0, self._changed(codec, data, utime=jump))]
        if fault.kind == "state_frozen" and codec.port == "state":
            self._state = (self._state or codec.message.decode(data)) if is_on else None
            return [(0.0, self._changed(codec, data, like=self._state))]
        if not is_on:
            return unchanged
        if fault.kind == "state_jumped" and codec.port == "state":
            moved = math.copysign(1.0 + 2.0 * fault.fraction, fault.size)  # [m]
            return [(0.0, self._changed(codec, data, moved=moved))]
        if random.random() > fault.fraction:
            return unchanged
        affected_port = {
            "body_lost": "motion_capture_pose",
            "body_dropped": "motion_capture_pose",
            "grid_dropped": "depth_grid",
            "grid_corrupt": "depth_grid",
        }.get(fault.kind, codec.port)
        if codec.port != affected_port:
            return unchanged
        match fault.kind:
            case "dropped" | "body_dropped" | "grid_dropped":
                return []
            case "delayed":
                return [(DELAY, data)]
            case "duplicated":
                return [(0.0, data), (float(random.uniform(0.0, DELAY)), data)]
            case "reordered":
                return [(float(random.uniform(0.0, DELAY)), data)]
            case "body_lost":
                return [(0.0, self._changed(codec, data, tracked=False))]
            case "corrupt" | "grid_corrupt":
                broken = bytearray(data[: random.integers(0, len(data) + 1)])
                for index in random.integers(0, max(len(broken), 1), 8) if broken else ():
                    broken[index] ^= 1 << int(random.integers(8))
                return [(0.0, bytes(broken))]
            case "not_finite":
                # Any number becomes NaN.
                place = 8 * int(random.integers(1, max(len(data) // 8, 2)))
                spoilt = data[: place - 4] + struct.pack(">d", math.nan) + data[place + 4 :]
                return [(0.0, spoilt)]
        return unchanged

    def _changed(
        self,
        codec: Codec,
        data: bytes,
        utime: int = 0,
        like: Any = None,
        moved: float = 0.0,
        tracked: bool = True,
    ) -> bytes:
        """Shifts the time of a message [us], copies another, moves it [m] or loses track."""
        message = codec.message.decode(data)
        message.header.utime += utime
        if like is not None:
            header = message.header
            message = codec.message.decode(like.encode())
            message.header = header
        if moved:
            message.p_WB = np.add(message.p_WB, [0.0, moved, 0.0])
        if not tracked:
            message.tracked = False
        return message.encode()


TICK = 0.01  # [s]
_SETTLING = 4.0  # [s] after the fault, until the vehicle is at rest or continues.
_LATEST = 12.0  # [s], the end of a trial.
_RESTING = 0.35  # [m/s]
_SLACK = 1.1  # [-] tolerance of speed and tilt, and
_TOLERANCE = 0.01  # [m] of distances.
_BODY = "vehicle"


class Nonsense(LeafSystem):
    """Passes a target (3,), or replaces it by NaN, huge values or an exception during faults."""

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
    """Builds the scenario's policy of accelerations or velocities with `Nonsense` after it."""
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

    The diagrams of vehicle and bridge exchange messages through a `Relay`.

    Returns:
        The trial; `max_speed` [m/s], `max_tilt` [rad] and, except during landing, `min_clearance`
        [m] and `min_inside` [m], the distance of the collision sphere from the fence; `outcome`;
        the bridge's `reasons`; and `safe`.
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
    p_WG, field = goal_position(scenario, world), world.distance_field
    measured = {"max_speed": 0.0, "max_tilt": 0.0, "min_clearance": np.inf, "min_inside": np.inf}
    reasons: set[int] = set()
    last = max(fault.begin + min(fault.duration, 4.0) for fault in faults)
    end = min(last + _SETTLING, _LATEST)
    ended, mode, stalled = "", status.WAITING, 0.0
    for tick in range(round(end / TICK)):
        now = tick * TICK
        simulators["vehicle"].AdvanceTo(now + 2 * PUBLISH_OFFSET)
        relay.step(now)
        # A stalled process loses time.
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
