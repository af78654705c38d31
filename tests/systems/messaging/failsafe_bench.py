"""A failsafe in closed loop: the real law, controller and dynamics, flown in steps of 20 ms."""

import math
from dataclasses import replace

import numpy as np
from pydrake.systems.analysis import Simulator

from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.messaging.failsafe import Failsafe, FailsafeConfig
from splatpilot.systems.policies.velocity import RESPONSE_TIME, tracking_acceleration
from splatpilot.systems.vehicle import quadrotor
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig, flatness_command
from splatpilot.systems.vehicle.state import predict_state

LOWER, UPPER = np.array([0.0, -5.0, 0.0]), np.array([20.0, 5.0, 6.0])
HOVER = np.array([quadrotor.GRAVITY, 0.0, 0.0, 0.0])
LAW, VEHICLE = FlatnessControllerConfig(), quadrotor.QuadrotorParams()
PERIOD = LAW.period


class Bench:
    """A failsafe and a vehicle that it flies by velocities or by body rates.

    The test gives inputs; the state, which is `age` [s] old, comes by itself, unless the test gives
    one.
    """

    def __init__(
        self,
        config: FailsafeConfig | None = None,
        p_WB=(10.0, 0.0, 3.0),
        v_WB=(1e-3, 0.0, 0.0),  # At exact rest a state would not change, and seem frozen.
        age: float = 0.0,
        by: str = "body_rates",
        box=(LOWER, UPPER),
        field: DistanceField | None = None,
        radius: float = VEHICLE.radius,
    ):
        vehicle, self.radius = replace(VEHICLE, radius=radius), radius
        self.failsafe = Failsafe(config or FailsafeConfig(), LAW, vehicle, *box, field)
        self.simulator = Simulator(self.failsafe)
        self.context = self.simulator.get_mutable_context()
        self.age, self.by, self.box, self.field = age, by, box, field
        self.state = quadrotor.hover_state(p_WB)
        self.state[3:6] = v_WB
        moved = np.append(PERIOD * self.state[3:6], np.zeros(10))
        self.states = [self.state - k * moved for k in range(round(age / PERIOD), -1, -1)]
        self.tick, self.min_room = 0, math.inf
        self.give(velocity_setpoint=[0.0, 0.0, 0.0, 0.5], command=HOVER)
        self.give_state()

    def give(self, **inputs) -> None:
        for name, value in inputs.items():
            self.failsafe.GetInputPort(name).FixValue(self.context, np.atleast_1d(value))

    def give_state(self, measured: np.ndarray | None = None) -> None:
        """Gives the failsafe a state, that of the vehicle by default."""
        if measured is None:
            measured = self.states[-1 - round(self.age / PERIOD)]
        state = predict_state(measured, self.age)
        self.give(state=state, measured_state=measured, state_age=self.age)
        if self.field is not None:
            sample = self.field.query(state[:3])
            self.give(clearance=sample.distance - self.radius, gradient=sample.gradient)

    def accelerate(self, a_WB, v_WB=None) -> None:
        """Gives setpoint and command of a policy that desires an acceleration."""
        state = np.asarray(self.failsafe.GetInputPort("state").Eval(self.context))
        command = flatness_command(state, a_WB, state[3:6], math.nan, LAW, VEHICLE)
        setpoint = state[3:6] + RESPONSE_TIME * a_WB if v_WB is None else v_WB
        self.give(velocity_setpoint=[*setpoint, math.nan], command=command)

    def advance(self, duration: float, measured=None, desired=None) -> None:
        """Flies on; `measured` is the state that the failsafe gets at a time, by default the
        vehicle's; `desired` is the velocity of the policy."""
        for _ in range(round(duration / PERIOD)):
            now = self.tick * PERIOD
            self.give_state(None if measured is None else measured(now))
            if desired is not None:
                state = np.asarray(self.failsafe.GetInputPort("state").Eval(self.context))
                self.accelerate(tracking_acceleration(state[3:6], np.asarray(desired)), desired)
            self.simulator.AdvanceTo(now + 1e-6)
            command = self.out("command")
            if self.by == "velocity":
                setpoint = self.out("velocity_setpoint")
                acceleration = tracking_acceleration(self.state[3:6], setpoint[:3])
                command = flatness_command(
                    self.state, acceleration, np.zeros(3), setpoint[3], LAW, VEHICLE
                )
            self.state = quadrotor.rk4_step(self.state, command, VEHICLE, PERIOD)
            self.states.append(self.state)
            self.min_room = min(self.min_room, self._room())
            self.tick += 1

    def _room(self) -> float:
        """The distance [m] by which limits are kept: min_clearance, and the sphere in the box."""
        p_WB, (lower, upper) = self.state[:3], self.box
        room = float(np.min([p_WB - lower, upper - p_WB])) - self.radius
        if self.field is not None:
            room = min(room, float(self.field.distance(p_WB)) - self.radius - 0.1)
        return room

    def out(self, name: str) -> np.ndarray:
        return self.failsafe.GetOutputPort(name).Eval(self.context)

    def mode(self) -> tuple[float, float]:
        return tuple(self.out("mode"))
