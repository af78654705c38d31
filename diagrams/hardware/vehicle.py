"""Simulated vehicle that is flown by messages, as a real one."""

import dataclasses
import math
import time
from pathlib import Path

import numpy as np
from lcm import LCM
from pydrake.systems import primitives
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from splatpilot.diagrams.flight import blocks
from splatpilot.diagrams.flight.monitor import AddLogs, Outcome, flight_outcome, has_landed
from splatpilot.diagrams.flight.scenario import Scenario, goal_position, sample_initial_state
from splatpilot.diagrams.flight.simulation import record_flight, write_flight, write_summary
from splatpilot.diagrams.hardware.bridge import HardwareConfig, image_codecs, require_messages_for
from splatpilot.diagrams.hardware.real_time import MessagePorts, run_in_real_time
from splatpilot.diagrams.worlds.appearance import randomize_appearance
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.drake import vector_output
from splatpilot.systems.common.files import locks_folder, require_writable_folder
from splatpilot.systems.messaging import codecs
from splatpilot.systems.messaging.failsafe import Failsafe, FailsafeConfig
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.lcm_ports import open_lcm
from splatpilot.systems.policies.velocity import VelocityTracker
from splatpilot.systems.vehicle.flatness import FlatnessController
from splatpilot.systems.vehicle.quadrotor import QuadrotorPlant
from splatpilot.systems.vehicle.state import set_state

SILENCE = 0.1
"""[s] without commands after which the vehicle holds its position, until they come again."""

STATUS_PERIOD = 0.1  # [s] between messages of the vehicle's status.
_NOISE = 1e-6  # [m] in published positions: a failsafe takes a constant state for frozen.


def BuildVehicleDiagram(
    scenario: Scenario, world: World, lcm: LCM, config: HardwareConfig | None = None
) -> Diagram:
    """Builds the diagram of a simulated vehicle, in a world, with the messages of a real one.

    Its failsafe hovers and then lands if commands cease, as autopilots do.

    .. pydrake_system::

        name: vehicle
        output_ports: [state, command, command_age, clearance, barrier, gradient, in_collision,
            field_state]

    The ports are those of `BuildFlightDiagram`; `command_age` [s] is infinite before the first
    command.
    """
    config = config or HardwareConfig()
    config.validate()
    require_messages_for(scenario, world)
    builder = DiagramBuilder()
    ports = MessagePorts(builder, lcm, config.tick)

    # Vehicle.
    plant = builder.AddNamedSystem("plant", QuadrotorPlant(scenario.vehicle))
    state = plant.GetOutputPort("state")
    blocks.AddWind(builder, scenario, plant)
    pose, collision = blocks.AddPoseAndCollision(builder, world, state, scenario.vehicle.radius)

    # Commands, by a failsafe that knows no map and limits speed as MPC_XY_VEL_MAX of PX4.
    by_velocity = config.setpoints == "velocity"
    codec = codecs.VelocitySetpointCodec() if by_velocity else codecs.CommandCodec()
    hover = [0.0, 0.0, 0.0, np.nan] if by_velocity else [scenario.vehicle.gravity, 0.0, 0.0, 0.0]
    subscriber = ports.subscribe(codec, np.array(hover), "command")
    received, command_age = subscriber.GetOutputPort(codec.port), subscriber.GetOutputPort("age")
    command = received
    if by_velocity:
        parts = ports.add("setpoint", primitives.Demultiplexer([3, 1]), u0=received)
        velocity, heading = parts.get_output_port(0), parts.get_output_port(1)
        tracker = ports.add("velocity_tracker", VelocityTracker(), state=state, velocity=velocity)
        controller = FlatnessController(scenario.controller, scenario.vehicle)
        acceleration = tracker.GetOutputPort("acceleration")
        sources = {"state": state, "acceleration": acceleration, "heading": heading}
        command = ports.add("controller", controller, **sources).GetOutputPort("command")
    limits = FlightLimits(max_speed=config.failsafe.limits.max_speed)
    autopilot = FailsafeConfig(max_age=SILENCE, recovery=config.tick, limits=limits)
    model, box = (scenario.controller, scenario.vehicle), np.full(3, np.inf)
    no_age = ports.add("no_age", primitives.ConstantVectorSource(np.zeros(1)))
    failsafe = ports.add(
        "failsafe",
        Failsafe(autopilot, *model, -box, box),
        state=state,
        state_age=no_age.get_output_port(),
        observation_age=command_age,
        velocity_setpoint=received if by_velocity else None,
        command=command,
    )
    hold = primitives.ZeroOrderHold(config.tick, 4)
    held = ports.add("held_command", hold, u=failsafe.GetOutputPort("command")).get_output_port()
    builder.Connect(held, plant.GetInputPort("command"))

    # Status, state and motion capture.
    armed = builder.AddSystem(primitives.ConstantVectorSource(np.ones(1))).get_output_port()
    ready = failsafe.GetOutputPort("is_ready")
    status = ports.add("status", primitives.Multiplexer(2), u0=armed, u1=ready)
    ports.publish(codecs.VehicleStatusCodec(), status.get_output_port(0), STATUS_PERIOD)
    sizes = np.repeat([_NOISE, 0.0], [3, 10])
    noise = builder.AddSystem(primitives.Sine(sizes, np.ones(13), np.zeros(13))).get_output_port(0)
    estimate = ports.add("estimate", primitives.Adder(2, 13), u0=state, u1=noise)
    ports.publish(codecs.StateCodec(), estimate.get_output_port(), 1 / config.state_rate)
    if config.body:
        pick = primitives.MatrixGain(np.eye(13)[[0, 1, 2, 6, 7, 8, 9]])
        tracked = ports.add("tracked", pick, u0=state).get_output_port()
        ports.publish(codecs.MotionCaptureCodec(config.body), tracked, 1 / config.state_rate)

    # Images, whose size and rate are the policy's.
    policy = blocks.make_policy(scenario, world)
    images = blocks.AddObservation(
        builder, scenario, world, state, pose, policy, blocks.policy_images(policy)
    )
    for codec in image_codecs(scenario, policy):
        ports.publish(codec, images[codec.port], blocks.decision_period(scenario, policy))

    logged = {"state": state, "command": held, "clearance": collision.GetOutputPort("clearance")}
    AddLogs(builder, logged)
    for name, port in {"state": state, "command": held, "command_age": command_age}.items():
        builder.ExportOutput(port, name)
    blocks.ExportCollision(builder, collision)
    diagram = builder.Build()
    diagram.set_name("vehicle")
    return diagram


@locks_folder("out")
def run(*, scenario: Scenario, config: HardwareConfig, out: Path) -> dict[str, float | str]:
    """Hovers at the scenario's start and flies by commands until the flight ends.

    Writes the files of `write_flight` and `write_summary` into `out`. Time begins with the first
    command. Returns `Flight.summary()` and `overruns`, of ticks.
    """
    scenario.validate()
    config.validate()
    lcm = open_lcm(config.url)
    world = make_world(scenario.world, scenario.seed)
    world = randomize_appearance(world, scenario.appearance, scenario.seed)
    start = sample_initial_state(scenario, world)
    require_writable_folder(out)
    diagram = BuildVehicleDiagram(scenario, world, lcm, config)
    simulator = Simulator(diagram)
    ApplySimulatorConfig(scenario.simulator, simulator)
    root = simulator.get_mutable_context()
    set_state(diagram.GetSubsystemByName("plant").GetMyMutableContextFromRoot(root), start)
    p_WG = goal_position(scenario, world)
    took_off = math.inf

    def outcome() -> Outcome | None:
        if has_landed(diagram, root):
            return Outcome.LANDED
        return flight_outcome(diagram, root, p_WG, scenario.goal_radius)

    def over(now: float) -> bool:
        nonlocal took_off
        if math.isinf(vector_output(diagram, "command_age", root)[0]):
            if now > config.patience:
                raise TimeoutError(
                    f"no command has come for {config.patience:g} s; start the bridge, with the "
                    "same URL and scenario"
                )
            return False
        took_off = min(took_off, now)
        return outcome() is not None or now - took_off >= scenario.timeout

    print(f"Hovering at {config.url} until commands come...", flush=True)
    started = time.monotonic()
    overruns = run_in_real_time(simulator, diagram, config.tick, over)
    wall_time = time.monotonic() - started - took_off
    diagram.ForcedPublish(root)  # The bridge needs the last state too.
    flight = record_flight(diagram, root, outcome() or Outcome.TIMEOUT, wall_time)
    names, rows = ("times", "states", "commands", "clearances"), flight.times >= took_off
    flight = dataclasses.replace(flight, **{name: getattr(flight, name)[rows] for name in names})
    flight.times[:] -= took_off
    write_flight(out, scenario, flight)
    summary = flight.summary() | {"overruns": overruns}
    write_summary(out, summary)
    print(*(f"{name:<18} {value}" for name, value in summary.items()), sep="\n")
    return summary
