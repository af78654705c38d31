"""The vehicle of the flight diagram behind messages: its pilot is in another process."""

import numpy as np
from lcm import LCM
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

from splatpilot.diagrams.flight_diagram import LOG_PERIOD
from splatpilot.diagrams.hardware_config import HardwareConfig
from splatpilot.diagrams.hardware_diagram import image_codecs, require_messages_for
from splatpilot.diagrams.observation import AddObservation, decision_period
from splatpilot.diagrams.pilot import make_policy
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_collision import EsdfCollision
from splatpilot.systems.messaging.codecs import (
    Codec,
    CommandCodec,
    MotionCaptureCodec,
    StateCodec,
    VehicleStatusCodec,
    VelocitySetpointCodec,
)
from splatpilot.systems.messaging.failsafe import Failsafe
from splatpilot.systems.messaging.failsafe_config import FailsafeConfig
from splatpilot.systems.messaging.message_publisher import MessagePublisher
from splatpilot.systems.messaging.message_subscriber import MessageSubscriber
from splatpilot.systems.messaging.unix_clock import UnixClock
from splatpilot.systems.policies.velocity_tracker import VelocityTracker
from splatpilot.systems.vehicle.flatness_controller import FlatnessController
from splatpilot.systems.vehicle.flight_limits import FlightLimits
from splatpilot.systems.vehicle.quadrotor_plant import QuadrotorPlant
from splatpilot.systems.vehicle.state_to_pose import StateToPose

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
    builder.Connect(clock.get_output_port(), subscriber.unix_time_input_port())
    told = subscriber.GetOutputPort(codec.port)
    commanded = told
    if velocities:
        commanded = _AddVelocityControl(builder, scenario, state, told)
        builder.Connect(told, failsafe.velocity_setpoint_input_port())
    builder.Connect(commanded, failsafe.command_input_port())
    builder.Connect(subscriber.age_output_port(), failsafe.observation_age_input_port())
    builder.Connect(state, failsafe.state_input_port())
    builder.Connect(no_age.get_output_port(), failsafe.state_age_input_port())
    builder.Connect(failsafe.command_output_port(), held.get_input_port())
    builder.Connect(command, plant.GetInputPort("command"))
    builder.Connect(state, pose.state_input_port())
    builder.Connect(state, collision.state_input_port())

    def add_publisher(codec: Codec, source: OutputPort, period: float) -> None:
        publisher = MessagePublisher(lcm, codec, period)
        builder.AddNamedSystem(f"{codec.port}_publisher", publisher)
        builder.Connect(source, publisher.GetInputPort(codec.port))
        builder.Connect(clock.get_output_port(), publisher.unix_time_input_port())

    policy = make_policy(scenario, world)  # Only to know what it sees, and how often.
    armed = builder.AddSystem(ConstantVectorSource(np.ones(1)))
    vehicle_status = builder.AddSystem(Multiplexer(2))
    builder.Connect(armed.get_output_port(), vehicle_status.get_input_port(0))
    builder.Connect(failsafe.is_ready_output_port(), vehicle_status.get_input_port(1))
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
    images = AddObservation(builder, scenario, world, state, pose.pose_output_port(), policy)
    for codec in image_codecs(scenario, policy):
        add_publisher(codec, images[codec.port], decision_period(scenario, policy))

    for name, port in (("state", state), ("command", command)):
        LogVectorOutput(port, builder, LOG_PERIOD).set_name(f"{name}_log")
        builder.ExportOutput(port, name)
    builder.ExportOutput(subscriber.age_output_port(), "command_age")
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
    builder.Connect(parts.get_output_port(0), tracker.velocity_input_port())
    builder.Connect(parts.get_output_port(1), controller.heading_input_port())
    builder.Connect(tracker.acceleration_output_port(), controller.acceleration_input_port())
    for system in (tracker, controller):
        builder.Connect(state, system.GetInputPort("state"))
    return controller.command_output_port()
