"""The vehicle of the flight diagram behind messages: its pilot is in another process."""

import dataclasses
import math
import time
from pathlib import Path

import numpy as np
from lcm import LCM
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    Demultiplexer,
    LogVectorOutput,
    MatrixGain,
    Multiplexer,
    Sine,
    ZeroOrderHold,
)

from splatpilot.diagrams.flight.blocks import AddObservation, decision_period, goal_of, make_policy
from splatpilot.diagrams.flight.flight import (
    Flight,
    Outcome,
    flight_outcome,
    has_landed,
    record_flight,
    sample_initial_state,
    write_flight,
    write_summary,
)
from splatpilot.diagrams.flight.flight_diagram import LOG_PERIOD
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.hardware.bridge import HardwareConfig, image_codecs, require_messages_for
from splatpilot.diagrams.hardware.real_time import run_in_real_time
from splatpilot.diagrams.worlds.appearance import seen_otherwise
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.esdf_collision import EsdfCollision
from splatpilot.systems.common.files import holds_folder, require_writable_folder
from splatpilot.systems.messaging.bridge_status import UnixClock
from splatpilot.systems.messaging.codecs import (
    Codec,
    CommandCodec,
    MotionCaptureCodec,
    StateCodec,
    VehicleStatusCodec,
    VelocitySetpointCodec,
)
from splatpilot.systems.messaging.failsafe import Failsafe, FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.lcm_ports import MessagePublisher, MessageSubscriber, open_lcm
from splatpilot.systems.policies.velocity import VelocityTracker
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.quadrotor import QuadrotorPlant
from splatpilot.systems.vehicle.state import StateToPose

SILENCE = 0.1
"""[s] without commands after which the vehicle holds where it is, until they come again."""

STATUS_PERIOD = 0.1
"""[s] between two messages that say who flies the vehicle."""

_NOISE = 1e-6
"""[m] in published positions: an estimator's output is never the same for long, and a failsafe
takes one that is for frozen."""


def BuildVehicleDiagram(
    scenario: Scenario, world: World, lcm: LCM, config: HardwareConfig | None = None
) -> Diagram:
    """
    Builds the diagram of a simulated vehicle that speaks as a real one: it is told body rates or
    velocities, and says its state, who flies it, its pose in motion capture if that must see it,
    and, to policies that see, what its camera sees.

    Systems, by name: `clock`, `plant`, `pose`, `collision`, those of `AddObservation`,
    `command_subscriber`, `failsafe`, which hovers and then lands if commands cease, as
    autopilots do, `held_command`, `{port}_publisher` of `state`, `vehicle_status`,
    `motion_capture_pose` and each image that the scenario's policy sees, and the loggers
    `state_log`, `command_log`. A vehicle that is told velocities has `setpoint`,
    `velocity_tracker` and `controller`.

    .. pydrake_system::

        name: vehicle
        output_ports:
        - state
        - command
        - command_age
        - clearance
        - gradient
        - in_collision
        - field_state

    The ports are those of `BuildFlightDiagram`; `command_age` [s] is infinite until a command has
    come.

    Args:
        scenario: the vehicle, what its policy sees, and how well.
        world: what is flown in.
        lcm: where messages travel.
        config: how often, and what the vehicle is told.

    Raises:
        ValueError: for a configuration out of range or that no policy has, sensors, and worlds in
            which something moves.
    """
    config = config or HardwareConfig()
    config.validate()
    require_messages_for(scenario, world)
    builder = DiagramBuilder()
    velocities = config.setpoints == "velocity"
    gravity = scenario.vehicle.gravity
    initial = np.array([0.0, 0.0, 0.0, np.nan] if velocities else [gravity, 0.0, 0.0, 0.0])
    codec = VelocitySetpointCodec() if velocities else CommandCodec()
    subscriber = MessageSubscriber(lcm, codec, config.tick, initial)
    clock, plant, pose = UnixClock(), QuadrotorPlant(scenario.vehicle), StateToPose()
    field = world.distance_field
    max_speed = config.failsafe.limits.max_speed  # As MPC_XY_VEL_MAX of PX4.
    failsafe = Failsafe(
        FailsafeConfig(
            max_age=SILENCE, recovery=config.tick, limits=FlightLimits(max_speed=max_speed)
        ),
        scenario.controller,
        scenario.vehicle,
        np.full(3, -np.inf),  # It knows no map.
        np.full(3, np.inf),
    )
    held, no_age = ZeroOrderHold(config.tick, 4), ConstantVectorSource(np.zeros(1))
    collision = EsdfCollision(field)
    for name, system in (
        ("clock", clock),
        ("plant", plant),
        ("pose", pose),
        ("collision", collision),
        ("command_subscriber", subscriber),
        ("failsafe", failsafe),
        ("held_command", held),
        ("no_age", no_age),
    ):
        builder.AddNamedSystem(name, system)

    state, command = plant.GetOutputPort("state"), held.get_output_port()
    builder.Connect(clock.get_output_port(), subscriber.GetInputPort("unix_time"))
    told = subscriber.GetOutputPort(codec.port)
    commanded = told
    if velocities:
        commanded = _AddVelocityControl(builder, scenario, state, told)
        builder.Connect(told, failsafe.GetInputPort("velocity_setpoint"))
    builder.Connect(commanded, failsafe.GetInputPort("command"))
    builder.Connect(subscriber.GetOutputPort("age"), failsafe.GetInputPort("observation_age"))
    builder.Connect(state, failsafe.GetInputPort("state"))
    builder.Connect(no_age.get_output_port(), failsafe.GetInputPort("state_age"))
    builder.Connect(failsafe.GetOutputPort("command"), held.get_input_port())
    builder.Connect(command, plant.GetInputPort("command"))
    builder.Connect(state, pose.GetInputPort("state"))
    builder.Connect(state, collision.GetInputPort("state"))

    def add_publisher(codec: Codec, source: OutputPort, period: float) -> None:
        publisher = MessagePublisher(lcm, codec, period)
        builder.AddNamedSystem(f"{codec.port}_publisher", publisher)
        builder.Connect(source, publisher.GetInputPort(codec.port))
        builder.Connect(clock.get_output_port(), publisher.GetInputPort("unix_time"))

    policy = make_policy(scenario, world)  # Only to know what it sees, and how often.
    armed = builder.AddSystem(ConstantVectorSource(np.ones(1)))
    vehicle_status = builder.AddSystem(Multiplexer(2))
    builder.Connect(armed.get_output_port(), vehicle_status.get_input_port(0))
    builder.Connect(failsafe.GetOutputPort("is_ready"), vehicle_status.get_input_port(1))
    add_publisher(VehicleStatusCodec(), vehicle_status.get_output_port(0), STATUS_PERIOD)
    noise = builder.AddSystem(Sine(np.repeat([_NOISE, 0.0], [3, 10]), np.ones(13), np.zeros(13)))
    estimate = builder.AddSystem(Adder(2, 13))
    builder.Connect(state, estimate.get_input_port(0))
    builder.Connect(noise.get_output_port(0), estimate.get_input_port(1))
    add_publisher(StateCodec(), estimate.get_output_port(), 1 / config.state_rate)
    if config.body:
        seen = builder.AddSystem(MatrixGain(np.eye(13)[[0, 1, 2, 6, 7, 8, 9]]))
        builder.Connect(state, seen.get_input_port())
        add_publisher(
            MotionCaptureCodec(config.body), seen.get_output_port(), 1 / config.state_rate
        )
    images = AddObservation(builder, scenario, world, state, pose.GetOutputPort("pose"), policy)
    for codec in image_codecs(scenario, policy):
        add_publisher(codec, images[codec.port], decision_period(scenario, policy))

    for name, port in (("state", state), ("command", command)):
        LogVectorOutput(port, builder, LOG_PERIOD).set_name(f"{name}_log")
        builder.ExportOutput(port, name)
    builder.ExportOutput(subscriber.GetOutputPort("age"), "command_age")
    for name in ("clearance", "gradient", "in_collision", "field_state"):
        builder.ExportOutput(collision.GetOutputPort(name), name)
    diagram = builder.Build()
    diagram.set_name("vehicle")
    return diagram


def _AddVelocityControl(
    builder: DiagramBuilder, scenario: Scenario, state: OutputPort, setpoint: OutputPort
) -> OutputPort:
    """Adds what flies velocity setpoints by the vehicle's own state; returns its commands."""
    parts, tracker = Demultiplexer([3, 1]), VelocityTracker()
    controller = FlatnessController(scenario.controller, scenario.vehicle)
    for name, system in (
        ("setpoint", parts),
        ("velocity_tracker", tracker),
        ("controller", controller),
    ):
        builder.AddNamedSystem(name, system)
    builder.Connect(setpoint, parts.get_input_port())
    builder.Connect(parts.get_output_port(0), tracker.GetInputPort("velocity"))
    builder.Connect(parts.get_output_port(1), controller.GetInputPort("heading"))
    builder.Connect(tracker.GetOutputPort("acceleration"), controller.GetInputPort("acceleration"))
    for system in (tracker, controller):
        builder.Connect(state, system.GetInputPort("state"))
    return controller.GetOutputPort("command")


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
