"""The pilot of the flight diagram behind messages: the vehicle is somewhere else."""

import contextlib
import logging
import math
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lcm import LCM
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort, System
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.diagrams.flight.blocks import (
    AddPilot,
    ConnectObservation,
    Pilot,
    camera_of,
    decision_period,
    goal_of,
    images_of,
    make_policy,
)
from splatpilot.diagrams.flight.flight import Outcome, flight_outcome, has_landed
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware.real_time import run_in_real_time
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.messaging.arrival_triggered import ArrivalTriggered, can_be_triggered
from splatpilot.systems.messaging.bridge_status import BridgeStatus, UnixClock
from splatpilot.systems.messaging.codecs import (
    Codec,
    ColorImageCodec,
    CommandCodec,
    DepthGridCodec,
    DepthImageCodec,
    HypothesesCodec,
    MotionCaptureCodec,
    StateCodec,
    StatusCodec,
    VehicleStatusCodec,
    VelocitySetpointCodec,
)
from splatpilot.systems.messaging.failsafe import Failsafe, FailsafeConfig
from splatpilot.systems.messaging.generated import lcmt_bridge_status
from splatpilot.systems.messaging.lcm_ports import (
    DEFAULT_URL,
    MessagePublisher,
    MessageSubscriber,
    open_lcm,
    recorded,
)
from splatpilot.systems.messaging.tof_receiver import TimeOfFlightReceiver, TimeOfFlightStream
from splatpilot.systems.policies.hypotheses import num_hypotheses_in
from splatpilot.systems.policies.velocity import VelocitySetpoint
from splatpilot.systems.sensing.time_of_flight import sensor_of
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import StatePredictor


@dataclass
class HardwareConfig:
    """Where messages travel, how often, and how old they may be."""

    # LCM's URL.
    url: str = DEFAULT_URL
    # [s] Time between looks at what messages have come: of ticks of the wall clock.
    tick: float = 0.002
    # [Hz] Of states.
    state_rate: float = 50.0
    # [Hz] Of the bridge's status.
    status_rate: float = 5.0
    # [s] Without a message after which bridge and vehicle give up.
    patience: float = 10.0
    # What a simulated vehicle is told: "body_rates" or "velocity"; see `px4.setpoints` for PX4.
    setpoints: str = "body_rates"
    # The body that motion capture must see; none if empty.
    body: str = ""
    # The stream of the sensor of a policy that sees by time of flight; LCM's DEPTH_GRID where left
    # out.
    time_of_flight: TimeOfFlightStream | None = None
    # When the vehicle is taken from its policy, and what nobody may exceed.
    failsafe: FailsafeConfig = field(default_factory=FailsafeConfig)

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("tick", "state_rate", "status_rate", "patience"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(
                    f"{name} is {value}; it must be positive and finite, as "
                    f"{getattr(type(self), name)}"
                )
        if self.setpoints not in ("velocity", "body_rates"):
            raise ValueError(f"setpoints must be velocity or body_rates, got {self.setpoints!r}")
        self.failsafe.validate()
        if self.time_of_flight is not None:
            self.time_of_flight.validate()


def BuildHardwareDiagram(
    scenario: Scenario,
    world: World,
    lcm: LCM,
    config: HardwareConfig | None = None,
    *,
    policy: System | None = None,
    controller: System | None = None,
) -> Diagram:
    """
    Builds the diagram that flies a vehicle by messages: that of `BuildFlightDiagram` with
    subscribers in the place of plant and camera. It runs with the wall clock, see
    `run_in_real_time`.

    Systems, by name: those of `AddPilot`; `clock`; the subscribers `state_subscriber` and one
    `{image}_subscriber` for each image that the policy sees, or `depth_grid_receiver` for the
    stream of a time-of-flight sensor; `vehicle_status_subscriber`, which tells when the bridge is
    in charge; `state_predictor`, which brings the state up to date;
    `velocity_setpoint`, `failsafe`, through which all goes that is sent to the vehicle, `status`;
    where motion capture must see a body `motion_capture_pose_subscriber`; and one
    `{port}_publisher` for each of `command`, `velocity_setpoint`, `status`, and `hypotheses` where
    the policy has them. Until messages have come, states and images are arbitrary but finite.

    .. pydrake_system::

        name: hardware
        input_ports:
        - overruns
        - lag
        output_ports:
        - state
        - command
        - hypotheses
        - color_image
        - depth_image_32f
        - clearance
        - gradient
        - in_collision
        - field_state
        - velocity_setpoint
        - status
        - in_charge

    The ports are those of `BuildFlightDiagram`, the images those that the policy sees; `status` and
    `overruns` are those of `BridgeStatus`, `command`, `velocity_setpoint`, `in_charge` and `lag`
    those of `Failsafe`.

    Args:
        scenario: who flies, and where to. Its vehicle is what is known of the one that flies.
        world: what is flown in, as far as that is known.
        lcm: where messages travel.
        config: how often, how old they may be, and within what limits.
        policy, controller: see `BuildFlightDiagram`.

    Raises:
        ValueError: for a configuration out of range or that no policy has, a system without the
            ports it needs, sensors, and worlds in which something moves.
    """
    config = config or HardwareConfig()
    config.validate()
    require_messages_for(scenario, world)
    builder = DiagramBuilder()
    clock = UnixClock()
    builder.AddNamedSystem("clock", clock)

    def add_subscriber(codec: Codec) -> MessageSubscriber:
        initial = {"state": hover_state(np.zeros(3)), "depth_grid": np.zeros(codec.size)}
        subscriber = MessageSubscriber(lcm, codec, config.tick, initial.get(codec.port))
        builder.AddNamedSystem(f"{codec.port}_subscriber", subscriber)
        builder.Connect(clock.get_output_port(), subscriber.GetInputPort("unix_time"))
        return subscriber

    def add_publisher(
        codec: Codec,
        source: OutputPort,
        period: float,
        enabled: OutputPort | None = None,
        decided: OutputPort | None = None,
    ) -> None:
        publisher = MessagePublisher(lcm, codec, period, config.tick if decided else None)
        builder.AddNamedSystem(f"{codec.port}_publisher", publisher)
        builder.Connect(source, publisher.GetInputPort(codec.port))
        builder.Connect(clock.get_output_port(), publisher.GetInputPort("unix_time"))
        if enabled is not None:
            builder.Connect(enabled, publisher.GetInputPort("enabled"))
        if decided is not None:
            builder.Connect(decided, publisher.GetInputPort("decided"))

    received: dict[str, MessageSubscriber | TimeOfFlightReceiver] = {
        "state": add_subscriber(StateCodec())
    }
    predictor = StatePredictor(config.failsafe.max_age)  # As long as states are flown by.
    builder.AddNamedSystem("state_predictor", predictor)
    builder.Connect(
        received["state"].GetOutputPort("state"), predictor.GetInputPort("measured_state")
    )
    builder.Connect(received["state"].GetOutputPort("age"), predictor.GetInputPort("age"))
    state = predictor.GetOutputPort("state")
    policy = policy or make_policy(scenario, world)
    decided, decision = None, decision_period(scenario, policy)
    codecs = image_codecs(scenario, policy)
    if can_be_triggered(policy):
        policy = ArrivalTriggered(policy, config.tick)
        decided = policy.GetOutputPort("decided")
    pilot = AddPilot(builder, scenario, world, state, policy, controller, guarded=True)
    for codec in codecs:
        if codec.port == "depth_grid" and config.time_of_flight is not None:
            receiver = TimeOfFlightReceiver(config.time_of_flight, config.tick)
            builder.AddNamedSystem("depth_grid_receiver", receiver)
            received[codec.port] = receiver
        else:
            received[codec.port] = add_subscriber(codec)
    observed = {"state": state}
    observed |= {name: received[name].GetOutputPort(name) for name in list(received)[1:]}

    status = BridgeStatus(list(received)[1:])
    builder.AddNamedSystem("status", status)
    # A policy that sees nothing decides by states.
    oldest = status.GetOutputPort("observation_age")
    age = {"observation_age": oldest if codecs else received["state"].GetOutputPort("age")}
    ConnectObservation(builder, observed | age, pilot.policy)
    failsafe = Failsafe(
        config.failsafe,
        scenario.controller,
        scenario.vehicle,
        world.distance_field.lower_W,
        world.distance_field.upper_W,
        world.distance_field,
    )
    builder.AddNamedSystem("failsafe", failsafe)
    for signal, subscriber in received.items():
        for what in ("age", "gaps", "rejected"):
            port = status.GetInputPort(f"{signal}_{what}")
            builder.Connect(subscriber.GetOutputPort(what), port)
    builder.ExportInput(status.GetInputPort("overruns"), "overruns")
    builder.ExportInput(failsafe.GetInputPort("lag"), "lag")

    wanted = _AddVelocitySetpoint(builder, scenario, state, pilot).GetOutputPort(
        "velocity_setpoint"
    )
    collision = builder.GetSubsystemByName("collision")
    for source, name in (
        (state, "state"),
        (received["state"].GetOutputPort("state"), "measured_state"),
        (received["state"].GetOutputPort("age"), "state_age"),
        (status.GetOutputPort("observation_age"), "observation_age"),
        (wanted, "velocity_setpoint"),
        (pilot.controller.GetOutputPort("command"), "command"),
        (collision.GetOutputPort("clearance"), "clearance"),
        (collision.GetOutputPort("gradient"), "gradient"),
    ):
        builder.Connect(source, failsafe.GetInputPort(name))
    vehicle_status = add_subscriber(VehicleStatusCodec())
    builder.Connect(
        vehicle_status.GetOutputPort("vehicle_status"), failsafe.GetInputPort("vehicle_status")
    )
    builder.Connect(
        vehicle_status.GetOutputPort("age"), failsafe.GetInputPort("vehicle_status_age")
    )
    if pilot.policy.HasOutputPort("failed"):
        builder.Connect(
            pilot.policy.GetOutputPort("failed"), failsafe.GetInputPort("policy_failed")
        )
    if config.body:
        body = add_subscriber(MotionCaptureCodec(config.body))
        builder.Connect(body.GetOutputPort("age"), failsafe.GetInputPort("body_age"))
    builder.Connect(failsafe.GetOutputPort("mode"), status.GetInputPort("mode"))
    command, setpoint = (
        failsafe.GetOutputPort("command"),
        failsafe.GetOutputPort("velocity_setpoint"),
    )
    known, period = failsafe.GetOutputPort("state_is_known"), scenario.controller.period
    add_publisher(CommandCodec(), command, period, known)
    is_ready = failsafe.GetOutputPort("is_ready")
    add_publisher(VelocitySetpointCodec(), setpoint, period, is_ready, decided)
    add_publisher(StatusCodec(), status.GetOutputPort("status"), 1 / config.status_rate)
    if pilot.policy.HasOutputPort("hypotheses"):
        plans = pilot.policy.GetOutputPort("hypotheses")
        codec = HypothesesCodec(num_hypotheses_in(plans.size()))
        add_publisher(codec, plans, decision, decided=decided)

    for name, port in observed.items():
        builder.ExportOutput(port, name)
    builder.ExportOutput(command, "command")
    builder.ExportOutput(setpoint, "velocity_setpoint")
    builder.ExportOutput(status.GetOutputPort("status"), "status")
    builder.ExportOutput(failsafe.GetOutputPort("in_charge"), "in_charge")
    diagram = builder.Build()
    diagram.set_name("hardware")
    return diagram


def image_codecs(scenario: Scenario, policy: System) -> list[Codec]:
    """How the images travel that a policy sees."""
    camera = camera_of(scenario, policy)
    size, sensor = (camera.width, camera.height), sensor_of(camera)
    codecs = {
        "depth_image_32f": DepthImageCodec(ImageDepth32F(*size), "policy_camera"),
        "color_image": ColorImageCodec(ImageRgba8U(*size), "policy_camera"),
        "depth_grid": DepthGridCodec(
            sensor.columns, sensor.rows, sensor.max_range, "policy_camera"
        ),
    }
    return [codecs[name] for name in images_of(policy)]


def require_messages_for(scenario: Scenario, world: World) -> None:
    """Raises ValueError for what a scenario or its world has that no message carries."""
    sensors = getattr(scenario.policy, "sensors", {}) | scenario.sensors
    if sensors:
        raise ValueError(
            f"no message carries what the sensors {', '.join(sensors)} measure; leave them out"
        )
    if world.moving:
        raise ValueError(
            f"in {world.name} something moves, and no message says where it is; fly in another "
            "world"
        )


def _AddVelocitySetpoint(
    builder: DiagramBuilder, scenario: Scenario, state: OutputPort, pilot: Pilot
) -> VelocitySetpoint:
    setpoint = VelocitySetpoint(scenario.controller)
    builder.AddNamedSystem("velocity_setpoint", setpoint)
    builder.Connect(state, setpoint.GetInputPort("state"))
    builder.Connect(pilot.decision, setpoint.GetInputPort(pilot.decision.get_name()))
    if pilot.policy.HasOutputPort("heading"):
        builder.Connect(pilot.policy.GetOutputPort("heading"), setpoint.GetInputPort("heading"))
    return setpoint


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
