"""Bridge: policy and controller that fly a vehicle by messages."""

import contextlib
import functools
import logging
import math
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lcm import LCM
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, System
from pydrake.systems.primitives import ConstantVectorSource
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.diagrams.flight import blocks
from splatpilot.diagrams.flight.monitor import Outcome, flight_outcome, has_landed
from splatpilot.diagrams.flight.scenario import Scenario, goal_position
from splatpilot.diagrams.hardware.real_time import MessagePorts, run_in_real_time
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.drake import vector_output
from splatpilot.systems.common.validation import Config, bounded, require
from splatpilot.systems.messaging import codecs
from splatpilot.systems.messaging.arrival_triggered import ArrivalTriggered, can_be_triggered
from splatpilot.systems.messaging.failsafe import Failsafe, FailsafeConfig
from splatpilot.systems.messaging.generated import lcmt_bridge_status
from splatpilot.systems.messaging.lcm_ports import (
    DEFAULT_URL,
    BridgeStatus,
    MessageSubscriber,
    open_lcm,
    recorded,
)
from splatpilot.systems.messaging.receiver import TimeOfFlightReceiver, TimeOfFlightStream
from splatpilot.systems.policies.hypotheses import num_hypotheses_in
from splatpilot.systems.policies.velocity import VelocitySetpoint
from splatpilot.systems.sensing.time_of_flight import equivalent_sensor
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import StatePredictor

_log = logging.getLogger(__name__)


@dataclass
class HardwareConfig(Config):
    """Transport, rates and timeouts of messages."""

    # LCM's URL.
    url: str = DEFAULT_URL
    # [s] Time between looks for messages: a tick of the wall clock.
    tick: float = bounded(0.002, "(0, inf) s")
    # [Hz] Rate of states.
    state_rate: float = bounded(50.0, "(0, inf) Hz")
    # [Hz] Rate of the bridge's status.
    status_rate: float = bounded(5.0, "(0, inf) Hz")
    # [s] Without a message after which bridge and vehicle give up.
    patience: float = bounded(10.0, "(0, inf) s")
    # Commands for a simulated vehicle: "body_rates" or "velocity"; px4 has `commander.setpoints`.
    setpoints: str = bounded("body_rates", "{velocity, body_rates}")
    # Body that motion capture must track; none if empty.
    body: str = ""
    # Stream of the time-of-flight sensor of a policy; LCM's DEPTH_GRID if left out.
    time_of_flight: TimeOfFlightStream | None = None
    # Limits, and when the failsafe takes over from the policy.
    failsafe: FailsafeConfig = field(default_factory=FailsafeConfig)


def BuildHardwareDiagram(
    scenario: Scenario,
    world: World,
    lcm: LCM,
    config: HardwareConfig | None = None,
    *,
    policy: System | None = None,
    controller: System | None = None,
) -> Diagram:
    """Builds the diagram that flies a vehicle by messages: that of `BuildFlightDiagram` with
    subscribers instead of plant and camera. It runs with the wall clock, see `run_in_real_time`.

    .. pydrake_system::

        name: hardware
        input_ports: [overruns, lag]
        output_ports: [state, command, hypotheses, color_image, depth_image_32f, clearance,
            barrier, gradient, in_collision, field_state, velocity_setpoint, status, in_charge]

    `status` and `overruns` are those of `BridgeStatus`; `command`, `velocity_setpoint`, `in_charge`
    and `lag` those of `Failsafe`; the others those of `BuildFlightDiagram`. The scenario's vehicle
    is the model of the real one; the world is its map, as far as known.
    """
    config = config or HardwareConfig()
    config.validate()
    require_messages_for(scenario, world)
    builder = DiagramBuilder()
    ports = MessagePorts(builder, lcm, config.tick)

    # State: received, and predicted for now, up to the age at which it is still used.
    receivers: dict[str, System] = {}
    receivers["state"] = ports.subscribe(codecs.StateCodec(), hover_state(np.zeros(3)))
    measured, state_age = (receivers["state"].GetOutputPort(name) for name in ("state", "age"))
    predictor = StatePredictor(config.failsafe.max_age)
    ports.add("state_predictor", predictor, measured_state=measured, age=state_age)
    state = predictor.GetOutputPort("state")

    # Policy, which updates when images arrive, and controller.
    policy = policy or blocks.make_policy(scenario, world)
    cameras, period = image_codecs(scenario, policy), blocks.decision_period(scenario, policy)
    if can_be_triggered(policy):
        policy = ArrivalTriggered(policy, config.tick)
    else:
        _log.warning(
            f"{type(policy).__name__} has state, updates or outputs other than discrete state of "
            "one period and vectors: it waits for no images, and its exceptions end the bridge"
        )
    decided, failed, heading, plans = (
        policy.GetOutputPort(name) if policy.HasOutputPort(name) else None
        for name in ("decided", "failed", "heading", "hypotheses")
    )
    _, collision = blocks.AddPoseAndCollision(builder, world, state, scenario.vehicle.radius)
    blocks.ExportCollision(builder, collision)
    autonomy = blocks.AddPolicyAndController(
        builder, scenario, state, policy, controller, guarded=True
    )

    # Images.
    for codec in cameras:
        if codec.port == "depth_grid" and config.time_of_flight is not None:
            receiver = TimeOfFlightReceiver(config.time_of_flight, config.tick)
            receivers[codec.port] = ports.add("depth_grid_receiver", receiver)
        else:
            initial = np.zeros(codec.size) if codec.port == "depth_grid" else None
            receivers[codec.port] = ports.subscribe(codec, initial)
    observed = {name: receiver.GetOutputPort(name) for name, receiver in receivers.items()}
    observed["state"] = state

    # Status. A policy without images updates by states.
    images = list(receivers)[1:]
    signals = {
        f"{name}_{signal}": receiver.GetOutputPort(signal)
        for name, receiver in receivers.items()
        for signal in ("age", "gaps", "rejected")
    }
    status = ports.add("status", BridgeStatus(images), **signals)
    builder.ExportInput(status.GetInputPort("overruns"), "overruns")
    observation_age = status.GetOutputPort("observation_age")
    age = observation_age if images else state_age
    goal = ports.add("goal", ConstantVectorSource(goal_position(scenario, world)))
    others = {"observation_age": age, "goal": goal.get_output_port()}
    blocks.ConnectObservation(builder, "policy", autonomy.policy, observed | others)

    # Failsafe.
    target = {autonomy.target.get_name(): autonomy.target}
    setpoint = VelocitySetpoint(scenario.controller)
    ports.add("velocity_setpoint", setpoint, state=state, heading=heading, **target)
    vehicle_status = ports.subscribe(codecs.VehicleStatusCodec())
    body = ports.subscribe(codecs.MotionCaptureCodec(config.body)) if config.body else None
    field = world.distance_field
    limits = config.failsafe, scenario.controller, scenario.vehicle
    failsafe = ports.add(
        "failsafe",
        Failsafe(*limits, field.lower_W, field.upper_W, field),
        state=state,
        measured_state=measured,
        state_age=state_age,
        observation_age=observation_age,
        velocity_setpoint=setpoint.GetOutputPort("velocity_setpoint"),
        command=autonomy.command,
        clearance=collision.GetOutputPort("clearance"),
        gradient=collision.GetOutputPort("gradient"),
        vehicle_status=vehicle_status.GetOutputPort("vehicle_status"),
        vehicle_status_age=vehicle_status.GetOutputPort("age"),
        policy_failed=failed,
        body_age=None if body is None else body.GetOutputPort("age"),
    )
    builder.ExportInput(failsafe.GetInputPort("lag"), "lag")
    builder.Connect(failsafe.GetOutputPort("mode"), status.GetInputPort("mode"))

    # Publishers.
    command, setpoint, is_known, is_ready = (
        failsafe.GetOutputPort(name)
        for name in ("command", "velocity_setpoint", "state_is_known", "is_ready")
    )
    ports.publish(codecs.CommandCodec(), command, scenario.controller.period, is_known)
    codec = codecs.VelocitySetpointCodec()
    ports.publish(codec, setpoint, scenario.controller.period, is_ready, decided)
    ports.publish(codecs.StatusCodec(), status.GetOutputPort("status"), 1 / config.status_rate)
    if plans is not None:
        codec = codecs.HypothesesCodec(num_hypotheses_in(plans.size()))
        ports.publish(codec, plans, period, decided=decided)
        builder.ExportOutput(plans, "hypotheses")

    for name, port in observed.items():
        builder.ExportOutput(port, name)
    for name in ("command", "velocity_setpoint", "in_charge"):
        builder.ExportOutput(failsafe.GetOutputPort(name), name)
    builder.ExportOutput(status.GetOutputPort("status"), "status")
    diagram = builder.Build()
    diagram.set_name("hardware")
    return diagram


def image_codecs(scenario: Scenario, policy: System) -> list[codecs.Codec]:
    """Returns the codecs of a policy's images."""
    camera, frame = blocks.policy_camera(scenario, policy), "policy_camera"
    size, tof = (camera.width, camera.height), equivalent_sensor(camera)
    images = {
        "depth_image_32f": codecs.DepthImageCodec(ImageDepth32F(*size), frame),
        "color_image": codecs.ColorImageCodec(ImageRgba8U(*size), frame),
        "depth_grid": codecs.DepthGridCodec(tof.columns, tof.rows, tof.max_range, frame),
    }
    return [images[name] for name in blocks.policy_images(policy)]


def require_messages_for(scenario: Scenario, world: World) -> None:
    """Raises ValueError for sensors and moving obstacles, which have no messages."""
    sensors = blocks.onboard_sensors(scenario)
    require(not sensors, "sensors", f"left out, {_NO_MESSAGES}", ", ".join(sensors))
    moving = world.moving or scenario.moving
    what, condition = f"the world {world.name}", f"without moving obstacles, {_NO_MESSAGES}"
    require(not moving, what, condition, "some", "choose another world")


_NO_MESSAGES = "which have no messages"


def run(
    *, scenario: Scenario, config: HardwareConfig, log: Path | None = None, overwrite: bool = False
) -> dict[str, float | str]:
    """Waits for a vehicle's messages and flies it to the scenario's goal.

    The flight begins when the bridge is in charge of a vehicle in the air. It ends at the goal;
    after the scenario's timeout; at a collision or outside of the map while in charge; after
    landing; and if state or images are too old for `config.patience`. Then messages cease.

    Returns `outcome` (of `Outcome`, "timeout" or "silence"), `flight_time_s`, and of `BridgeStatus`
    `gaps`, `rejected` and `overruns`; `log` gets all messages, as LCM's logger writes them.
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
        p_WG = goal_position(scenario, world)
        flight = BridgeFlight(diagram, root, scenario, p_WG, config)
        # Waits again, so that policies update just after images of the same rate.
        ready = functools.partial(wait_for_messages, diagram, config.patience)
        run_in_real_time(simulator, diagram, config.tick, flight.is_over, ready)
    counts = vector_output(diagram, "status", root)[4:]
    summary = {"outcome": flight.outcome, "flight_time_s": flight.duration}
    summary |= dict(zip(("gaps", "rejected", "overruns"), counts, strict=True))
    print(*(f"{name:<14} {value}" for name, value in summary.items()), sep="\n")
    return summary


@dataclass
class BridgeFlight:
    """Detects begin and end of a flight of `BuildHardwareDiagram`."""

    diagram: Diagram
    root: Context
    scenario: Scenario
    p_WG: np.ndarray  # (3,) [m]
    config: HardwareConfig
    outcome: str = ""  # Of `Outcome`, "timeout" or "silence"; empty until the flight is over.
    duration: float = 0.0  # [s]
    _in_charge: bool = False
    _began: float = math.inf  # [s]
    _fresh: float = -math.inf  # [s] when state and images were last fresh.

    def is_over(self, now: float) -> bool:
        """Checks at a time [s] if the flight is over, and how it ended."""
        status, charge, collision = (
            vector_output(self.diagram, name, self.root)
            for name in ("status", "in_charge", "in_collision")
        )
        in_charge, landed = bool(charge[0]), has_landed(self.diagram, self.root)
        if in_charge != self._in_charge:
            # Not printed: a closed pipe would end the flight.
            _log.warning("%.2f s: the bridge is %sin charge", now, "" if in_charge else "not ")
            self._in_charge = in_charge
        if in_charge and not landed and not collision[0]:
            self._began = min(self._began, now)
        if now < self._began:
            return False
        is_fresh = status[2:4].max() <= self.config.failsafe.max_age
        self._fresh = now if is_fresh else max(self._fresh, self._began)
        outcome = None
        if landed and (status[0] == lcmt_bridge_status.LANDING or not in_charge):
            outcome = Outcome.LANDED
        elif not is_fresh:
            outcome = "silence" if now > self._fresh + self.config.patience else None
        elif in_charge:
            radius = self.scenario.goal_radius
            outcome = flight_outcome(self.diagram, self.root, self.p_WG, radius)
        if now >= self._began + self.scenario.timeout:
            outcome = outcome or Outcome.TIMEOUT
        self.outcome, self.duration = str(outcome or ""), now - self._began
        return outcome is not None


def wait_for_messages(diagram: Diagram, patience: float) -> None:
    """Waits at most `patience` [s] for a message for each subscriber of a diagram; then raises
    TimeoutError."""
    deadline = time.monotonic() + patience
    for system in diagram.GetSystems():
        if not isinstance(system, MessageSubscriber | TimeOfFlightReceiver):
            continue
        while not system.has_message():
            if time.monotonic() > deadline:
                raise TimeoutError(
                    f"the first message on {system.source} must come within {patience:g} s, got "
                    "none; start the vehicle, with the same URL and scenario"
                )
            time.sleep(0.001)
