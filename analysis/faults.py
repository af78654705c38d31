"""`splatpilot hardware faults`: many flights with random faults."""

import heapq
import json
import logging
import math
import socket
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, cast

import numpy as np
from lcm import LCM
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from scipy.spatial.transform import Rotation

from splatpilot.diagrams.flight.blocks import decision_port, make_policy
from splatpilot.diagrams.flight.monitor import Outcome, flight_outcome, has_landed
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario, goal_position, sample_initial_state
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram, HardwareConfig, image_codecs
from splatpilot.diagrams.hardware.vehicle import BuildVehicleDiagram
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.drake import vector_input, vector_output, weak_callback
from splatpilot.systems.common.files import claim_folder, locks_folder, write_text
from splatpilot.systems.common.processes import available_cores, map_processes
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import revision
from splatpilot.systems.common.validation import Config, bounded, require
from splatpilot.systems.messaging import codecs
from splatpilot.systems.messaging.failsafe import FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.generated import lcmt_bridge_status as status
from splatpilot.systems.messaging.lcm_ports import PUBLISH_OFFSET, UnixClock
from splatpilot.systems.messaging.receiver import TimeOfFlightStream, UdpConfig
from splatpilot.systems.policies.hypotheses import HEADER_SIZE
from splatpilot.systems.sensing.time_of_flight import GRID_MAGIC
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState, set_state

KINDS = (
    *("dropped", "delayed", "duplicated", "reordered", "clock_jump"),
    *("state_frozen", "state_jumped", "body_lost", "body_dropped", "grid_dropped", "grid_corrupt"),
    *("policy_nonsense", "policy_raises", "policy_stalled", "policy_killed"),
    *("not_finite", "corrupt"),
)
"""Types of faults; of two, the earlier one here is applied first. Messages that are "not_finite"
contain NaN, those that are "corrupt" are truncated and have flipped bits."""

PX4_KINDS = (
    *("state_off", "state_frozen", "state_garbage", "state_jumped", "state_slow", "state_delayed"),
    *("state_dropped", "heading_jumped", "body_dropped", "offboard_left"),
    *("link_off", "corrupt", "slow", "delayed", "dropped"),
    *("policy_killed", "policy_stalled", "policy_nonsense"),
)
"""Types of faults by which PX4's failures appear on its link, see `docs/px4.md`; ``_off`` affects
every message, ``slow`` leaves 2 to 5 messages per second."""

FAULTY_POLICIES = (
    *("straight", "reactive", "diffaero", "depthnav", "agile_autonomy", "diffaero_tof"),
    *("student_depth", "student_rgb", "diffaero_rgb", "distilled_rgb"),
)
"""Policies that trials alternate between: those for a vehicle, which know no map."""

_TABLES = {"messages": KINDS, "px4": PX4_KINDS}

DELAY = 0.3  # [s] of delayed messages.
TICK = 0.01  # [s] of both diagrams.

_PORTS = {
    **{"body_lost": "motion_capture_pose", "body_dropped": "motion_capture_pose"},
    **{"grid_dropped": "depth_grid", "grid_corrupt": "depth_grid"},
    **dict.fromkeys(("state_frozen", "state_jumped", "state_off", "state_garbage"), "state"),
    **dict.fromkeys(("state_slow", "state_delayed", "state_dropped", "heading_jumped"), "state"),
}
"""Faults of one signal."""

_FOREVER = 1e6  # [s]
_SETTLING = 4.0  # [s] after the fault, until the vehicle is at rest or continues.
_LATEST = 12.0  # [s], the end of a trial.
_RESTING = 0.35  # [m/s]
_SLACK = 1.1  # [-] tolerance of speed and tilt, and
_TOLERANCE = 0.01  # [m] of distances.
_BODY = "vehicle"
_SAFE = "goal", "hover", "landing", "landed", "flies on"  # outcomes


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
            fraction=1.0 if kind.endswith("_off") else float(random.uniform(0.3, 1.0)),
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
    def sample(
        cls, number: int, random: np.random.Generator, table: tuple[str, ...] = KINDS
    ) -> "Trial":
        """Samples the trial of a number. Types of faults, commands and policies alternate; about
        half of the trials have two faults. Faults of grids need the policy with that input."""
        turn, kind = divmod(number, len(table))
        kinds = [kind]
        if random.random() < 0.5:
            kinds.append(int(random.choice([k for k in range(len(table)) if k != kind])))
        faults = tuple(Fault.sample(table[k], random) for k in sorted(kinds))
        needs_grid = any(fault.kind.startswith("grid") for fault in faults)
        policy = "diffaero_tof" if needs_grid else FAULTY_POLICIES[turn // 2 % len(FAULTY_POLICIES)]
        return cls(faults, policy, ("velocity", "body_rates")[turn % 2])


class Relay:
    """Carries messages between the LCMs of vehicle and bridge, with faults; grids go to a UDP port,
    if given, as packets of the sensor."""

    def __init__(
        self,
        vehicle: LCM,
        bridge: LCM,
        from_vehicle: list[codecs.Codec],
        from_bridge: list[codecs.Codec],
        faults: tuple[Fault, ...],
        random: np.random.Generator,
        grid_port: int | None = None,
    ) -> None:
        self._faults, self._random, self._grid_port = faults, random, grid_port
        self._ends, self._count, self._now = (vehicle, bridge), 0, 0.0
        self._waiting: list[tuple[float, int, Callable[[bytes], None], bytes]] = []
        self._state: bytes | None = None  # that is frozen
        self._passed: dict[tuple[Fault, str], float] = {}  # [s] of the last message, while slow
        take = weak_callback(self._take)  # The relay owns LCM, which owns its callbacks.
        for sender, signals in ((vehicle, from_vehicle), (bridge, from_bridge)):
            for codec in signals:
                sender.subscribe(codec.channel, partial(take, codec, sender is vehicle))

    def step(self, now: float) -> None:
        """Receives messages, and delivers those that are due at a time [s]."""
        self._now = now
        for end in self._ends:
            while end.handle_timeout(0):
                pass
        while self._waiting and self._waiting[0][0] <= now:
            _, _, send, data = heapq.heappop(self._waiting)
            send(data)

    def _send_grid(self, packet: bytes) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto(packet, ("127.0.0.1", self._grid_port))

    def _take(self, codec: codecs.Codec, from_vehicle: bool, channel: str, data: bytes) -> None:
        send = partial(self._ends[1 if from_vehicle else 0].publish, channel)
        if codec.port == "depth_grid" and self._grid_port is not None:
            send, message = self._send_grid, codec.message.decode(data)
            head = GRID_MAGIC, message.header.seq, message.header.utime * 1000
            data = struct.pack(f"<IIQ{message.num_values}f", *head, *message.values)
        copies = [(0.0, data)]
        for fault in self._faults:
            copies = [
                (delay + later, changed)
                for delay, sent in copies
                for later, changed in self._apply(fault, codec, sent, from_vehicle)
            ]
        for delay, sent in copies:
            self._count += 1
            heapq.heappush(self._waiting, (self._now + delay, self._count, send, sent))

    def _apply(
        self, fault: Fault, codec: codecs.Codec, data: bytes, from_vehicle: bool
    ) -> list[tuple[float, bytes]]:
        """Applies a fault to a message; returns delays [s] and contents of its copies."""
        random, is_on, unchanged = self._random, fault.is_on(self._now), [(0.0, data)]
        is_affected = codec.port == _PORTS.get(fault.kind, codec.port)
        if fault.kind == "clock_jump" and from_vehicle and codec.port != "depth_grid":
            jump = round(fault.size * 1e6) if self._now >= fault.begin else 0  # [us]
            message = codec.message.decode(data)
            message.header.utime += jump
            return [(0.0, message.encode())]
        if fault.kind == "state_frozen" and is_affected:
            self._state = (self._state or data) if is_on else None
            return _edited(codec, self._state or data, header=codec.message.decode(data).header)
        if not is_on:
            return unchanged
        if fault.kind == "state_jumped" and is_affected:
            jump = math.copysign(1.0 + 2.0 * fault.fraction, fault.size)  # [m]
            p_WB = np.add(codec.message.decode(data).p_WB, [0.0, jump, 0.0])
            return _edited(codec, data, p_WB=p_WB)
        if fault.kind == "heading_jumped" and is_affected:
            angle = math.copysign(0.5 + 2.0 * fault.fraction, fault.size)  # [rad]
            R_WB = Rotation.from_quat(codec.message.decode(data).q_WB, scalar_first=True)
            return _edited(codec, data, q_WB=_quaternion(Rotation.from_euler("z", angle) * R_WB))
        if fault.kind == "offboard_left":  # The autopilot follows no command any more.
            if codec.port == "vehicle_status":
                return _edited(codec, data, offboard=False)
            return unchanged if from_vehicle else []
        if fault.kind in ("slow", "state_slow") and is_affected:
            key = fault, codec.channel
            if self._now - self._passed.get(key, -math.inf) < 0.5 * fault.fraction:
                return []
            self._passed[key] = self._now
            return unchanged
        if random.random() > fault.fraction or not is_affected:
            return unchanged
        match fault.kind:
            case kind if kind == "dropped" or kind.endswith(("_dropped", "_off")):
                return []
            case "delayed" | "state_delayed":
                return [(DELAY, data)]
            case "duplicated":
                return [(0.0, data), (float(random.uniform(0.0, DELAY)), data)]
            case "reordered":
                return [(float(random.uniform(0.0, DELAY)), data)]
            case "state_garbage":
                p_WB, v_WB = random.normal(scale=10 ** random.uniform(0.0, 4.0), size=(2, 3))
                q_WB = _quaternion(Rotation.random(rng=random))
                return _edited(codec, data, p_WB=p_WB, v_WB=v_WB, q_WB=q_WB)
            case "body_lost":
                return _edited(codec, data, tracked=False)
            case "corrupt" | "grid_corrupt":
                broken = bytearray(data[: random.integers(0, len(data) + 1)])
                for index in random.integers(0, max(len(broken), 1), 8) if broken else ():
                    broken[index] ^= 1 << int(random.integers(8))
                return [(0.0, bytes(broken))]
            case "not_finite":  # Any number becomes NaN.
                at = 8 * int(random.integers(1, max(len(data) // 8, 2))) - 4
                return [(0.0, data[:at] + struct.pack(">d", math.nan) + data[at + 8 :])]
        return unchanged


def _edited(codec: codecs.Codec, data: bytes, **fields: Any) -> list[tuple[float, bytes]]:
    """Returns a message, without delay, with other values of some fields."""
    message = codec.message.decode(data)
    for name, value in fields.items():
        setattr(message, name, value)
    return [(0.0, message.encode())]


def _quaternion(rotation: Rotation) -> list[float]:
    return rotation.as_quat(scalar_first=True).tolist()


class Nonsense(LeafSystem):
    """Passes a decision, or replaces it by NaN, huge values or an exception during faults."""

    def __init__(self, faults: tuple[Fault, ...], size: int) -> None:
        super().__init__()
        self._faults = faults
        self.DeclareVectorInputPort("sense", size)
        self.DeclareVectorOutputPort("decision", size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        decision = np.array(vector_input(self, "sense", context))
        start = HEADER_SIZE if len(decision) > HEADER_SIZE else 0  # hypotheses without time: none
        for fault in (each for each in self._faults if each.is_on(context.get_time())):
            if fault.kind == "policy_raises":
                raise RuntimeError("the policy fails")
            if fault.kind == "policy_nonsense":
                decision[start:] = 1e6 if fault.fraction > 0.65 else np.nan
        output.SetFromVector(decision)


def _faulty_policy(scenario: Scenario, world: World, faults: tuple[Fault, ...]) -> Diagram:
    """Builds the scenario's policy with `Nonsense` after its decision."""
    builder = DiagramBuilder()
    policy = builder.AddNamedSystem("policy", make_policy(scenario, world))
    decision = decision_port(policy)
    nonsense = builder.AddNamedSystem("nonsense", Nonsense(faults, decision.size()))
    builder.Connect(decision, nonsense.get_input_port())
    for index in range(policy.num_input_ports()):
        port = policy.get_input_port(index)
        builder.ExportInput(port, port.get_name())
    builder.ExportOutput(nonsense.get_output_port(), decision.get_name())
    if policy.HasOutputPort("heading"):
        builder.ExportOutput(policy.GetOutputPort("heading"), "heading")
    return builder.Build()


def fly_trial(
    scenario: Scenario, world: World, trial: Trial, limits: FlightLimits, seed: int
) -> dict[str, Any]:
    """Flies a scenario through faults.

    Returns the trial; `max_speed` [m/s], `max_tilt` [rad] and, except during landing,
    `min_clearance` [m] and `min_inside` [m], the distance of the collision sphere from the fence;
    `outcome`; the bridge's `reasons`; and `safe`.
    """
    # Vehicle, bridge and relay.
    config = HardwareConfig(
        tick=TICK,
        setpoints=trial.setpoints,
        body=_BODY,
        time_of_flight=TimeOfFlightStream(UdpConfig(port=0)),
        failsafe=FailsafeConfig(limits=limits),
    )
    near, far, faults = LCM("memq://"), LCM("memq://"), trial.faults
    policy = _faulty_policy(scenario, world, faults)
    vehicle = BuildVehicleDiagram(scenario, world, near, config)
    bridge = BuildHardwareDiagram(scenario, world, far, config, policy=policy)
    grid_port = None
    if bridge.HasSubsystemNamed("depth_grid_receiver"):
        grid_port = cast(Any, bridge.GetSubsystemByName("depth_grid_receiver")).port
    sent = [codecs.StateCodec(), codecs.VehicleStatusCodec(), codecs.MotionCaptureCodec(_BODY)]
    sent += image_codecs(scenario, policy)
    commands = [codecs.CommandCodec(), codecs.VelocitySetpointCodec()]
    relay = Relay(near, far, sent, commands, faults, np.random.default_rng(seed), grid_port)
    vehicle_simulator, bridge_simulator = Simulator(vehicle), Simulator(bridge)
    ApplySimulatorConfig(scenario.simulator, vehicle_simulator)
    root, bridge_root = (s.get_mutable_context() for s in (vehicle_simulator, bridge_simulator))
    plant = vehicle.GetSubsystemByName("plant").GetMyMutableContextFromRoot(root)
    set_state(plant, sample_initial_state(scenario, world))
    autopilot = vehicle.GetSubsystemByName("failsafe")
    clock = cast(UnixClock, bridge.GetSubsystemByName("clock"))

    # Flight.
    p_WG, box = goal_position(scenario, world), world.distance_field
    lower_W, upper_W = map(np.array, limits.geofence or (box.lower_W, box.upper_W))
    max_speed, max_tilt, min_clearance, min_inside = 0.0, 0.0, math.inf, math.inf
    reasons, outcome, mode, stalled = set[int](), None, status.WAITING, 0.0
    last = max(fault.begin + min(fault.duration, 4.0) for fault in faults)
    end = min(last + _SETTLING, _LATEST)
    for tick in range(round(end / TICK)):
        now = tick * TICK
        vehicle_simulator.AdvanceTo(now + 2 * PUBLISH_OFFSET)
        relay.step(now)
        # A stalled process loses time.
        if any(f.kind in ("policy_killed", "policy_stalled") and f.is_on(now) for f in faults):
            stalled += TICK
        else:
            clock.set_epoch(bridge_root, stalled)
            bridge_simulator.AdvanceTo(now - stalled + 2 * PUBLISH_OFFSET)
            mode, reason = vector_output(bridge, "status", bridge_root)[:2]
            reasons.add(int(reason))
        state = QuadrotorState.of(vector_output(vehicle, "state", root))
        max_speed = max(max_speed, float(np.linalg.norm(state.v_WB)))
        max_tilt = max(max_tilt, float(state.tilt))
        if has_landed(vehicle, root):
            outcome = Outcome.LANDED
            break
        own_mode = vector_output(autopilot, "mode", autopilot.GetMyContextFromRoot(root))[0]
        if status.LANDING not in (mode, own_mode):
            min_clearance = min(min_clearance, float(vector_output(vehicle, "clearance", root)[0]))
            to_fence = np.min([state.p_WB - lower_W, upper_W - state.p_WB])
            min_inside = min(min_inside, float(to_fence) - VEHICLE_RADIUS)
        outcome = flight_outcome(vehicle, root, p_WG, scenario.goal_radius)
        if outcome is not None:
            break

    # Result.
    v_WB = QuadrotorState.of(vector_output(vehicle, "state", root)).v_WB
    if outcome is not None:
        ended = str(outcome)
    elif np.linalg.norm(v_WB[:2]) < _RESTING and v_WB[2] < _RESTING:
        ended = "hover" if abs(v_WB[2]) < _RESTING else "landing"
    else:
        is_on = any(fault.is_on(end) for fault in faults)
        ended = "flies on" if mode == status.FLYING and not is_on else "adrift"
    kept = (
        max_speed <= _SLACK * limits.max_speed
        and max_tilt <= _SLACK * limits.max_tilt
        and min_clearance >= limits.min_clearance - _TOLERANCE
        and min_inside >= -_TOLERANCE
    )
    return {
        **asdict(trial),
        "seed": seed,
        **{"max_speed": max_speed, "max_tilt": max_tilt},
        **{"min_clearance": min_clearance, "min_inside": min_inside},
        "reasons": sorted(reasons - {status.NONE}),
        "outcome": ended,
        "safe": bool(kept and ended in _SAFE),
    }


@dataclass
class FaultsConfig(Config):
    """A campaign of trials, and the limits that safe ones keep."""

    # [-] Number of flights, which alternate between faults, commands and policies.
    trials: int = bounded(600, "[1, inf)")
    # Faults: of messages, sensors and policies, or as PX4's failures appear on its link.
    table: str = bounded("messages", "{messages, px4}")
    # Seed of everything random.
    seed: int = 0
    # [-] Number of worlds, which trials alternate between.
    worlds: int = bounded(10, "[1, inf)")
    # [m/s] Speed of the policies; `straight` collides without a failsafe.
    speed: float = 2.0
    # Limits that safe trials keep.
    limits: FlightLimits = field(default_factory=lambda: FlightLimits(max_speed=2.5))
    # Scenario of the trials, but for its policy and seed.
    scenario: Scenario = field(
        default_factory=lambda: Scenario(
            world=ForestConfig(length=14.0, width=8.0, rocks=2, logs=1)
        )
    )


@locks_folder("out")
def run(*, config: FaultsConfig, out: Path, jobs: int | None = None) -> dict[str, Any]:
    """Flies the trials in `jobs` worker processes, one for each core by default, or resumes an
    interrupted campaign of the same configuration and program.

    Writes into `out`: `trials.jsonl`, revision and results of `fly_trial`; `config.yaml`;
    `summary.json`, the number of safe trials and the outcomes by the type of fault, which is also
    returned."""
    config.validate()
    jobs = available_cores() if jobs is None else jobs
    require(jobs >= 1, "--jobs", "at least 1", jobs)
    claim_folder(out / "config.yaml", config)
    lines = out / "trials.jsonl"
    rows = [json.loads(line) for line in lines.read_text().splitlines()] if lines.exists() else []
    flown = {row["seed"] for row in rows}
    missing = [n for n in range(config.trials) if config.seed + n not in flown]
    flown_by = revision()
    for row in rows if missing else ():
        before, remedy = row.get("revision"), "go back to that revision, or choose another --out"
        require(before == flown_by, f"revision of {lines}", flown_by, before, remedy)
    flights = map_processes(partial(_fly, config), missing, jobs)
    for row in Progress(flights, "flying trials", config.trials, initial=len(rows), unit="trial"):
        rows.append({"revision": flown_by} | row)
        rows.sort(key=itemgetter("seed"))
        write_text(lines, "".join(json.dumps(row) + "\n" for row in rows))
    summary = summarize(rows, _TABLES[config.table])
    write_text(out / "summary.json", json.dumps(summary, indent=2) + "\n")
    print(f"{'fault':<16} {'safe':>9}  ended")
    for kind, row in summary["kinds"].items():
        ends = ", ".join(f"{name} {count}" for name, count in row["outcomes"].items())
        print(f"{kind:<16} {row['safe']:>4}/{row['trials']:<4}  {ends}")
    print(f"{summary['safe']} of {summary['trials']} trials were safe")
    return summary


def _fly(config: FaultsConfig, number: int) -> dict[str, Any]:
    """Flies the trial of a number."""
    seed, random = config.seed + number, np.random.default_rng([config.seed, number])
    world = make_world(config.scenario.world, config.seed + number % config.worlds)
    trial = Trial.sample(number, random, _TABLES[config.table])
    policy = policy_named(trial.policy, config.speed)
    scenario = replace(config.scenario, seed=seed, policy=policy)
    level = logging.root.manager.disable
    logging.disable(logging.ERROR)  # Packets are refused, and policies raise, on purpose.
    try:
        return fly_trial(scenario, world, trial, config.limits, seed)
    finally:
        logging.disable(level)


def summarize(rows: list[dict[str, Any]], table: tuple[str, ...] = KINDS) -> dict[str, Any]:
    """Counts safe trials, and outcomes by the type of fault."""
    kinds = {}
    for kind in table:
        of_kind = [row for row in rows if kind in {fault["kind"] for fault in row["faults"]}]
        kinds[kind] = {
            "trials": len(of_kind),
            "safe": sum(row["safe"] for row in of_kind),
            "outcomes": dict(sorted(Counter(row["outcome"] for row in of_kind).items())),
        }
    return {"trials": len(rows), "safe": sum(row["safe"] for row in rows), "kinds": kinds}
