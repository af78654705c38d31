"""Scenario: everything that determines one flight, as a dataclass and as YAML."""

from dataclasses import dataclass, field
from math import inf
from typing import ClassVar

import numpy as np
from pydrake.geometry import Rgba
from pydrake.systems.analysis import GetIntegrationSchemes, SimulatorConfig
from pydrake.systems.sensors import CameraConfig

from splatpilot.diagrams.flight.policies import POLICIES, PolicyConfig
from splatpilot.diagrams.flight.sensors import ESTIMATORS, SENSORS, SensorConfig
from splatpilot.diagrams.scenarios import profile_file
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.moving_spheres import MovingSphere
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import WORLDS, WorldConfig
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.common.config import dump_config, equal_by_fields, registry_field
from splatpilot.systems.common.distributions import pickle_by_fields, sample_distributions
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import (
    Config,
    FieldError,
    bounded,
    check_seed,
    require,
    require_field,
)
from splatpilot.systems.policies.planner import PrivilegedPlannerConfig
from splatpilot.systems.sensing.estimators import TrueState
from splatpilot.systems.sensing.imaging import Imaging
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.sensing.onboard_camera import level_mount
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams, hover_state
from splatpilot.systems.vehicle.vehicles import VEHICLES
from splatpilot.systems.vehicle.wind import Wind

pickle_by_fields(
    CameraConfig, CameraConfig.FocalLength, CameraConfig.FovDegrees, Rgba, SimulatorConfig
)

_MAX_PIXELS = 4096 * 2304  # [-] limit of H.264

# Fields of Drake's CameraConfig that a splat camera ignores. Its background is the world's, and its
# depth image is registered with its color image.
WITHOUT_EFFECT = (
    "X_BD",
    "renderer_name",
    "renderer_class",
    "background",
    "capture_offset",
    "label",
    "show_rgb",
    "do_compress",
    "lcm_bus",
)
_IGNORED_DEFAULTS = {name: repr(getattr(CameraConfig(), name)) for name in WITHOUT_EFFECT}


def _default_camera() -> CameraConfig:
    """Returns a forward-looking 320x240 camera; X_PB is its pose on the vehicle."""
    config = CameraConfig(name="camera", width=320, height=240, fps=15.0, z_near=0.1, z_far=20.0)
    config.focal, config.X_PB = CameraConfig.FovDegrees(x=90.0), level_mount()
    return config


def _default_simulator() -> SimulatorConfig:
    """Returns fixed steps, for repeatability; accurate to 0.2 mm after 5 s of harsh commands."""
    return SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=0.02, use_error_control=False
    )


@dataclass
class Scenario(Config):
    """One flight. Flights of the same scenario are bitwise identical.

    Any field of numbers may hold a distribution of `pydrake.common.schema` instead, as may the
    transforms of cameras; `sample_scenario` draws its value from the seed.
    """

    # Seed of everything random: generated world, start, noise.
    seed: int = 0
    # World: a generated one, (!SceneConfig) a reconstructed scene, or another of the registry.
    world: WorldConfig = registry_field(WORLDS, ForestConfig)
    # [-] Visual randomization of paint, light, exposure, hue and sky, from 0 (none) to 1. Surfaces
    # stay in place.
    appearance: float = bounded(0.0, "[0, 1]")
    # [m] Start p_WS in the world frame; the world's own if left out.
    start: list[float] | None = None
    # [m] Goal p_WG in the world frame; the world's own if left out.
    goal: list[float] | None = None
    # [m] The vehicle starts at random within this distance of the start, level and at rest.
    start_radius: float = bounded(0.1, "[0, 1] m")
    # [m] The goal is reached within this distance.
    goal_radius: float = bounded(0.3, "(0, inf) m")
    # [s] The flight ends after this time.
    timeout: float = bounded(60.0, "(0, 3600] s")
    # Vehicle: that of the benchmark, or (!Kingfisher, ...) another of the registry.
    vehicle: QuadrotorParams = registry_field(VEHICLES, QuadrotorParams)
    # Wind at the vehicle; calm by default.
    wind: Wind = field(default_factory=Wind)
    # Camera of videos and viewers; policies have cameras of their own.
    camera: CameraConfig = field(default_factory=_default_camera)
    # Policy: the privileged planner, or (!ReactiveConfig, ...) another of the registry.
    policy: PolicyConfig = registry_field(POLICIES, PrivilegedPlannerConfig)
    # Further onboard sensors, by name; see `sensors.py`.
    sensors: dict[str, SensorConfig] = registry_field(SENSORS, dict)
    # Spheres that move through the world, by name.
    moving: dict[str, MovingSphere] = field(default_factory=dict)
    # Noise and latency of the policy's camera; none by default.
    observation: ObservationNoise = field(default_factory=ObservationNoise)
    # Image formation of the policy's camera; none by default.
    imaging: Imaging = field(default_factory=Imaging)
    # Estimator of the state for policy and controller: the true state, or (!VisualInertial, ...)
    # another of the registry.
    estimator: SensorConfig = registry_field(ESTIMATORS, TrueState)
    # [s] Range from which the delay of each decision is drawn, for inference and link; none if
    # empty.
    decision_delay: list[float] = bounded(list, "[0, 1] s")
    controller: FlatnessControllerConfig = field(default_factory=FlatnessControllerConfig)
    simulator: SimulatorConfig = field(default_factory=_default_simulator)

    OVERLAYS: ClassVar = {"profile": profile_file}
    """Overrides that read several fields from a file, see `load_config`."""

    __eq__ = equal_by_fields
    __hash__ = None  # pyright: ignore

    def __repr__(self) -> str:
        """Shows all fields as YAML; Drake's distributions do not show their parameters."""
        return dump_config(self)

    def validate(self) -> None:
        drawn = sample_scenario(self)
        if drawn is not self:
            drawn.validate()
            return
        parts = [(WORLDS, self.world), (POLICIES, self.policy), (VEHICLES, self.vehicle)]
        parts.append((ESTIMATORS, self.estimator))
        for registry, part in [*parts, *((SENSORS, sensor) for sensor in self.sensors.values())]:
            registry.entry_for(part)
        try:
            super().validate()
        except FieldError as error:
            raise error.within(self) from None

    def check(self) -> None:
        check_seed(self.seed)
        for name in ("start", "goal"):
            point = getattr(self, name)
            valid = point is None or (len(point) == 3 and np.isfinite(point).all())
            require_field(self, name, valid, "three finite numbers x, y, z [m]")
        delay = self.decision_delay
        valid = not delay or (len(delay) == 2 and delay[0] <= delay[1])
        require_field(self, "decision_delay", valid, "two numbers in ascending order, or empty")
        _check_rates(self)
        _check_camera(self.camera)
        _check_simulator(self.simulator)
        step = self.simulator.max_step_size
        lag = self.vehicle.min_time_constant()
        require(
            self.simulator.use_error_control or lag >= 0.5 * step,
            "the shortest time constant of the vehicle",
            f"at least half of simulator.max_step_size, {step} s, for stable integration",
            f"{lag:g} s",
            f"set simulator.max_step_size to at most {2.0 * lag:g}",
        )


def sample_scenario(scenario: Scenario) -> Scenario:
    """Returns the scenario with values drawn from its distributions, or itself without any.

    The values are of its seed and the path of their field alone.
    """
    return sample_distributions(scenario, scenario.seed)


def goal_position(scenario: Scenario, world: World) -> np.ndarray:
    """Returns p_WG (3,) [m] of the scenario, or of the world if the scenario has none."""
    return np.asarray(world.p_WG if scenario.goal is None else scenario.goal, dtype=float)


def start_position(scenario: Scenario, world: World) -> np.ndarray:
    """Returns p_WS (3,) [m] of the scenario, or of the world if the scenario has none."""
    return np.asarray(world.p_WS if scenario.start is None else scenario.start, dtype=float)


def sample_initial_state(scenario: Scenario, world: World) -> np.ndarray:
    """Samples the initial state (13,): level, at rest, with the heading to the goal.

    By the scenario's seed the position is uniform in the sphere of `start_radius` about the start.

    Raises:
        InfeasibleFlightError: if a vehicle at start or goal would collide or be in unknown space,
            or if the start is at the goal.
    """
    scenario = sample_scenario(scenario)
    p_WG, p_WS = goal_position(scenario, world), start_position(scenario, world)
    radius = scenario.vehicle.radius
    _check_free(world, "start", p_WS, radius)
    _check_free(world, "goal", p_WG, radius)
    distance = float(np.linalg.norm(p_WG - p_WS))
    if distance <= scenario.goal_radius:
        raise InfeasibleFlightError(
            f"the distance from start to goal must be > goal_radius, {scenario.goal_radius} m, got "
            f"{distance:.2f} m in {world.name}; set start and goal"
        )

    generator = np.random.default_rng(scenario.seed)
    p_WB = None
    # A neighborhood of the start is free: the search ends.
    while p_WB is None or not _is_free(world, p_WB, radius):
        direction = generator.normal(size=3)
        distance = scenario.start_radius * generator.uniform() ** (1 / 3)
        p_WB = p_WS + distance * direction / np.linalg.norm(direction)
    heading = p_WG - p_WB
    return hover_state(p_WB, yaw=np.arctan2(heading[1], heading[0]))


def _is_free(world: World, p_WQ: np.ndarray, radius: float) -> bool:
    sample = world.field_at(0.0).query(p_WQ)
    return bool(sample.state == FieldState.FREE and sample.distance > radius)


def _check_free(world: World, what: str, p_WQ: np.ndarray, radius: float) -> None:
    """Raises InfeasibleFlightError if a vehicle at p_WQ (3,) [m] would collide."""
    field = world.field_at(0.0)
    sample = field.query(p_WQ)
    where = f"{what} {np.round(p_WQ, 3).tolist()}"
    if sample.state >= FieldState.UNKNOWN:
        known = "outside the world" if sample.state == FieldState.OUTSIDE else "in unseen space"
        raise InfeasibleFlightError(
            f"{where} is {known}; the world spans {np.round(field.lower_W, 2).tolist()} to "
            f"{np.round(field.upper_W, 2).tolist()} m: choose a point in known free space, if "
            "`splatpilot view` shows any"
        )
    if sample.distance <= radius or sample.state != FieldState.FREE:
        raise InfeasibleFlightError(
            f"{where} is {float(sample.distance):.3f} m from the nearest surface, but the "
            f"vehicle's radius is {radius} m; choose a point with more clearance"
        )


def policy_rate(config: object) -> float:
    """Returns the `rate` [Hz] of a policy's configuration, or 15 Hz if it has none."""
    return getattr(config, "rate", 15.0)


def _check_rates(scenario: Scenario) -> None:
    """Checks the times of estimator and exposure against those of the policy."""
    rate, estimates = policy_rate(scenario.policy), getattr(scenario.estimator, "rate", inf)
    remedy = "a policy needs an estimate at each update"
    require(estimates >= rate, "estimator.rate", f"at least {rate:g} Hz", estimates, remedy)
    period = 1.0 / max([rate, *scenario.observation.frame_rate])
    exposure = scenario.imaging.exposure_time
    condition = f"at most {period:.4g} s, the period of the images"
    remedy = "shorten it, or lower observation.frame_rate"
    require(exposure <= period, "imaging.exposure_time", condition, exposure, remedy)


def _check_camera(camera: CameraConfig) -> None:
    pixels = camera.width * camera.height
    valid = camera.width > 1 and camera.height > 1 and pixels <= _MAX_PIXELS
    size = f"{camera.width}x{camera.height} pixels"
    require(valid, "camera", f"at least 2x2 and at most {_MAX_PIXELS} pixels", size)
    try:
        focal = (camera.focal_x(), camera.focal_y())
    except RuntimeError:
        raise ValueError("camera.focal must have x or y or both, got neither") from None
    require(all(0 < f < inf for f in focal), "camera.focal", "positive and finite [pixels]", focal)
    center = camera.principal_point()
    valid = np.all((center > 0) & (center < [camera.width, camera.height]))
    require(valid, "camera's principal point", "inside the image [pixels]", center.tolist())
    delay = camera.output_delay
    require(0.0 <= delay <= 1.0, "camera.output_delay", "in [0, 1] s", delay)
    require(0.01 <= camera.fps <= 1000, "camera.fps", "in [0.01, 1000] Hz", camera.fps)
    for name, default in _IGNORED_DEFAULTS.items():
        value = repr(getattr(camera, name))
        ignored = "a splat camera ignores it"
        require(value == default, f"camera.{name}", "left out", value, ignored)


def _check_simulator(simulator: SimulatorConfig) -> None:
    known = GetIntegrationSchemes()
    scheme = simulator.integration_scheme
    require(scheme in known, "simulator.integration_scheme", f"one of {', '.join(known)}", scheme)
    step = simulator.max_step_size
    require(1e-5 <= step <= 1, "simulator.max_step_size", "in [1e-5, 1] s", step)
    accuracy = simulator.accuracy
    require(0 < accuracy < 1, "simulator.accuracy", "in (0, 1)", accuracy)
    for name in ("start_time", "target_realtime_rate"):
        value = getattr(simulator, name)
        require(value == 0, f"simulator.{name}", "0", value, "flights start then and do not wait")
