import numpy as np
import pytest
from scipy.integrate import solve_ivp

from splatpilot import _native
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import (
    AnalyticDistanceField,
    Capsule,
    Cylinder,
    HalfSpace,
    Shape,
    Sphere,
    shape_rows,
)
from splatpilot.systems.policies.velocity import (
    MAX_ACCELERATION,
    RESPONSE_TIME,
    tracking_acceleration,
)
from splatpilot.systems.vehicle.flatness import (
    FlatnessControllerConfig,
    flatness_command,
    native_control,
    reaching_acceleration,
)
from splatpilot.systems.vehicle.quadrotor import (
    QuadrotorParams,
    actuated_derivatives,
    component_derivatives,
    limit_command,
    native_vehicle,
)

LOWER, UPPER = np.array([0.0, -4.0, 0.0]), np.array([9.0, 4.0, 3.0])
CONTROL = FlatnessControllerConfig()
IDEAL = QuadrotorParams()
LAGGING = QuadrotorParams(
    motor_time_constant=0.04,
    yaw_time_ratio=2.0,
    thrust_scale=0.97,
    min_thrust=1.0,
    max_thrust=15.0,
    max_tilt_rate=2.0,
    max_yaw_rate=0.5,
    rotor_drag=[0.1, 0.2, 0.3],
    quadratic_drag=[0.03, 0.02, 0.01],
)
WIND = [0.5, -0.3, 0.1]


def shapes(count: int = 40) -> list[Shape]:
    random = np.random.default_rng(0)
    made: list[Shape] = [HalfSpace([0, 0, 1], 0.0)]
    for _ in range(count):
        a, b, c = random.uniform(LOWER, UPPER, (3, 3))
        made += [Sphere(a, 0.2), Cylinder(b, b + np.eye(3)[2], 0.1), Capsule(c, c + 1.0, 0.05)]
    return made


def add_shapes(worlds: _native.FlightWorlds, solids: list[Shape]) -> int:
    rows, kinds = shape_rows(solids)
    return worlds.add_shapes(shapes=rows, kinds=kinds, lower_W=LOWER, upper_W=UPPER)


@pytest.mark.parametrize("kind", ["shapes", "grid", "occupied outside"])
def test_distances_are_those_of_the_field(kind):
    worlds, field = _native.FlightWorlds(), AnalyticDistanceField(shapes(), LOWER, UPPER)
    if kind == "shapes":
        number = add_shapes(worlds, shapes())
    else:
        grid = esdf_from_distance_field(field, 0.3)
        states = np.random.default_rng(0).integers(3, size=grid.shape).astype(np.uint8)
        outside = kind == "occupied outside"
        field = Esdf(grid.distances, states, grid.lower_W, grid.voxel_size, outside)
        names = ("distances", "states", "lower_W", "upper_W", "voxel_size", "occupied_outside")
        number = worlds.add_grid(**{name: getattr(field, name) for name in names})
    points = np.random.default_rng(1).uniform(field.lower_W - 1, field.upper_W + 1, (2000, 3))
    points[:3] = field.lower_W, field.upper_W, [np.nan] * 3
    distances, gradients = np.empty(2000), np.empty((2000, 3))
    states, world = np.empty(2000, np.uint8), np.full(2000, number)
    given = {"p_WQ": points, "world": world, "distances": distances, "states": states}
    worlds.query(**given, gradients=gradients)
    with np.errstate(invalid="ignore"):
        truth = field.query(points)
    np.testing.assert_array_equal(distances, truth.distance)
    np.testing.assert_array_equal(gradients, truth.gradient)
    np.testing.assert_array_equal(states, truth.state)


def test_derivatives_are_those_of_the_formula():
    random = np.random.default_rng(0)
    state, command = random.normal(size=13), random.normal(size=4)
    wind, disturbance, rates = random.normal(size=3), random.normal(size=3), np.empty(13)
    for extra in ((None, None), (wind, None), (wind, disturbance)):
        truth = component_derivatives(state, command, 0.4, 0.05, 9.81, *extra)
        _native.quadrotor_derivatives(state, command, 0.4, 0.05, 9.81, rates, *extra)
        np.testing.assert_allclose(rates, np.array(truth), rtol=1e-12, atol=1e-12)


def parameters(vehicle: QuadrotorParams) -> np.ndarray:
    """Returns the numbers of `FLIGHT_PARAMETERS`."""
    wind = WIND if vehicle is LAGGING else [0.0] * 3
    known = native_vehicle(vehicle, wind) | native_control(CONTROL, vehicle)
    known |= {"response_time": RESPONSE_TIME, "max_acceleration": MAX_ACCELERATION}
    return np.array([known[name] for name in _native.FLIGHT_PARAMETERS])


def some_states(count: int) -> np.ndarray:
    random = np.random.default_rng(3)
    states = random.normal(size=(count, 13))
    states[:, :3] = [4.0, 0.0, 1.5]
    states[:, 6:10] = [1.0, 0.0, 0.0, 0.0] + 0.5 * random.normal(size=(count, 4))
    states[:, 6:10] /= np.linalg.norm(states[:, 6:10], axis=1, keepdims=True)
    states[0, 3:6] = 0.0  # at rest
    return states


def advance(
    vehicle: QuadrotorParams,
    kind: str,
    actions: np.ndarray,
    simd="",
    steps=1,
    states=None,
    solids=(),
) -> tuple[np.ndarray, np.ndarray]:
    """Returns states (N, 13) after one period of the controller, and ends (N,)."""
    count = len(actions)
    states = some_states(count) if states is None else states
    worlds, ends = _native.FlightWorlds(), np.zeros(count, np.uint8)
    add_shapes(worlds, list(solids))
    packs = np.repeat(parameters(vehicle)[None, :, None], 16, axis=-1)
    vehicles = _native.Vehicles(
        states=states,
        thrusts=np.full(count, vehicle.gravity),
        parameters=np.repeat(packs, -(-count // 16), axis=0),
        world=np.zeros(count, np.int64),
        goals=np.tile([8.0, 0.0, 1.5], (count, 1)),
        radii=np.full(count, 0.3),
        goal_radii=np.full(count, 0.3),
        remaining=np.full(count, 9, np.int32),
        distances=np.full(count, np.inf),
        field_states=np.zeros(count, np.uint8),
        ends=ends,
    )
    _native.FlightThreads(2, simd).advance(
        worlds,
        vehicles,
        kind=kind,
        actions=actions,
        earlier=actions,
        delays=np.zeros(count, np.int32),
        flying=np.ones(count, bool),
        actuated=not vehicle.is_ideal(),
        periods=1,
        step=CONTROL.period / steps,
        steps=steps,
    )
    return states, ends


def command_of_python(kind: str, state: np.ndarray, action: np.ndarray, vehicle: QuadrotorParams):
    if kind == "command":
        return action
    a_WB, motion_W = action, state[3:6]
    if kind == "velocity":
        a_WB = tracking_acceleration(state[3:6], action)
    if kind == "waypoint":
        a_WB = reaching_acceleration(action, state[:3], state[3:6], CONTROL.lookahead)
        motion_W = (action - state[:3]) / CONTROL.lookahead
    return flatness_command(state, a_WB, motion_W, None, CONTROL, vehicle)


@pytest.mark.parametrize("vehicle", [IDEAL, LAGGING], ids=["ideal", "lagging"])
@pytest.mark.parametrize("kind", ["command", "acceleration", "velocity", "waypoint"])
def test_flights_solve_the_equations_of_motion(kind, vehicle):
    actions = np.random.default_rng(4).normal(size=(8, 4 if kind == "command" else 3))
    actions += [9.0, 0.0, 0.0, 0.0] if kind == "command" else 2.0
    flown, _ = advance(vehicle, kind, actions, steps=8)
    for state, action, end in zip(some_states(8), actions, flown, strict=True):
        command = limit_command(command_of_python(kind, state, action, vehicle).tolist(), vehicle)

        def rates(_, x, command=command):
            if vehicle is IDEAL:
                return component_derivatives(x, command, vehicle.drag, 0.05, vehicle.gravity)
            states = [*x[:13], 1.0, x[13]]  # with the charge of the battery
            rates = actuated_derivatives(states, command, vehicle, WIND)
            return [*rates[:13], rates[14]]

        start = state if vehicle is IDEAL else [*state, vehicle.gravity]
        truth = solve_ivp(rates, (0, CONTROL.period), start, "DOP853", rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(end, truth.y[:13, -1], atol=1e-9)


@pytest.mark.parametrize("vehicle", [IDEAL, LAGGING], ids=["ideal", "lagging"])
def test_simd_levels_agree_bitwise(vehicle):
    actions = np.random.default_rng(5).normal(size=(37, 3))
    levels = _native.simd_levels()
    first, *others = (advance(vehicle, "velocity", actions, level)[0] for level in levels)
    for other in others:
        np.testing.assert_array_equal(first, other)


def test_the_first_end_counts():
    states = np.zeros((5, 13))
    states[:, 6] = 1.0
    states[:, 0] = 2.0, 4.0, 4.0, 8.2, 7.8
    states[2, 1], states[:, 2] = 5.0, 1.5
    solids: list[Shape] = [Sphere([4.0, 0.0, 1.0], 0.3), Sphere([7.5, 0.0, 1.5], 0.1)]
    hover = np.tile([IDEAL.gravity, 0.0, 0.0, 0.0], (5, 1))
    _, ends = advance(IDEAL, "command", hover, states=states, solids=solids)
    # None, collision, left volume, goal, and collision at the goal.
    assert ends.tolist() == [0, 1, 2, 3, 1]
