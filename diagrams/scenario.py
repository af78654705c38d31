"""A scenario: everything one flight depends on, as a dataclass and as YAML."""

from dataclasses import dataclass, field
from math import inf

import numpy as np
from pydrake.common.schema import Rotation, Transform
from pydrake.systems.analysis import GetIntegrationSchemes, SimulatorConfig
from pydrake.systems.sensors import CameraConfig

from splatpilot.diagrams.policies import POLICIES, PolicyConfig
from splatpilot.diagrams.sensors import SENSORS, SensorConfig
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.make_world import WORLDS, WorldConfig
from splatpilot.systems.configuration import open_field
from splatpilot.systems.policies.privileged_planner import PrivilegedPlannerConfig
from splatpilot.systems.sensing.observation_noise import ObservationNoise
from splatpilot.systems.vehicle.flatness_controller import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor_dynamics import QuadrotorParams

_MAX_PIXELS = 4096 * 2304  # the most that H.264 films

# Fields of Drake's CameraConfig about render engines and LCM, which a splat camera has no use for.
# Its background is the world's, and its depth image is registered with its colour image.
WITHOUT_EFFECT = (
    "X_BD",
    "renderer_name",
    "renderer_class",
    "background",
    "capture_offset",
    "output_delay",
    "label",
    "show_rgb",
    "do_compress",
    "lcm_bus",
)


def _default_camera() -> CameraConfig:
    """A forward-looking 320x240 camera at the nose; X_PB is its pose on the vehicle."""
    config = CameraConfig(name="camera", width=320, height=240, fps=15.0, z_near=0.1, z_far=20.0)
    config.focal = CameraConfig.FovDegrees(x=90.0)
    # Optical axes (x right, y down, z forward) from body axes (x forward, y left, z up).
    config.X_PB = Transform(
        translation=[0.1, 0.0, 0.0], rotation=Rotation(value=Rotation.Rpy(deg=[-90.0, 0.0, -90.0]))
    )
    return config


def _default_simulator() -> SimulatorConfig:
    """Fixed steps, for repeatability; within 0.2 mm of the solution after 5 s of harsh commands."""
    return SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=0.02, use_error_control=False
    )


@dataclass
class Scenario:
    """One flight. The same scenario gives the same flight, bit for bit."""

    # Seed of everything random: the world where it is generated, and the start's offset.
    seed: int = 0
    # What is flown in: a generated world, or (!SceneConfig) a reconstructed scene, or another of
    # `make_world.py` and of other packages.
    world: WorldConfig = open_field(WORLDS, ForestConfig)
    # [-] How much the world looks other than it is, drawn from the seed: 0 not at all, 1 all it
    # may, in paint, light, exposure, hue and sky. Its surfaces stay where they are.
    appearance: float = 0.0
    # [m] Start p_WS in the world frame; the world's own where left out.
    start: list[float] | None = None
    # [m] Goal p_WG in the world frame; the world's own where left out.
    goal: list[float] | None = None
    # [m] The vehicle starts anywhere within this distance of the start, level and at rest.
    start_radius: float = 0.1
    # [m] The goal is reached within this distance.
    goal_radius: float = 0.3
    # [s] The flight ends after this time.
    timeout: float = 60.0
    vehicle: QuadrotorParams = field(default_factory=QuadrotorParams)
    # What onlookers see from the vehicle; a policy that sees has a camera of its own.
    camera: CameraConfig = field(default_factory=_default_camera)
    # Who flies: the privileged planner, or (!ReactiveConfig, ...) another of `policies.py` and of
    # other packages.
    policy: PolicyConfig = open_field(POLICIES, PrivilegedPlannerConfig)
    # What is on board beside the cameras of onlookers and policy, by name; see `sensors.py`.
    sensors: dict[str, SensorConfig] = open_field(SENSORS, dict)
    # What lies between the policy's camera and the policy; nothing by default.
    observation: ObservationNoise = field(default_factory=ObservationNoise)
    controller: FlatnessControllerConfig = field(default_factory=FlatnessControllerConfig)
    simulator: SimulatorConfig = field(default_factory=_default_simulator)

    def validate(self) -> None:
        """
        Checks what can be checked without building the world; systems check their own parts.

        Raises:
            ValueError: naming the field, its value and its limit.
        """
        _check("seed", self.seed, self.seed >= 0, "at least 0")
        _check("appearance", self.appearance, 0 <= self.appearance <= 1, "0 to 1")
        _check("start_radius", self.start_radius, 0 <= self.start_radius <= 1, "0 to 1 m")
        _check("goal_radius", self.goal_radius, 0 < self.goal_radius < inf, "positive")
        _check("timeout", self.timeout, 0 < self.timeout <= 3600, "more than 0, at most 3600 s")
        for name in ("start", "goal"):
            point = getattr(self, name)
            valid = point is None or (len(point) == 3 and np.isfinite(point).all())
            _check(name, point, valid, "three finite numbers x, y, z in metres")
        parts = [(WORLDS, self.world), (POLICIES, self.policy)]
        for registry, part in [*parts, *((SENSORS, sensor) for sensor in self.sensors.values())]:
            registry.kind_of(part)
            part.validate()
        self.observation.validate()
        _check_camera(self.camera)
        _check_simulator(self.simulator)


def _check(name: str, value: object, valid: bool | np.bool_, limit: str) -> None:
    if not valid:
        raise ValueError(f"{name} is {value}; it must be {limit}")


def _check_camera(camera: CameraConfig) -> None:
    pixels = camera.width * camera.height
    valid = camera.width > 1 and camera.height > 1 and pixels <= _MAX_PIXELS
    size = f"{camera.width}x{camera.height} pixels"
    _check("camera", size, valid, f"at least 2x2 and at most {_MAX_PIXELS} pixels")
    try:
        focal = (camera.focal_x(), camera.focal_y())
    except RuntimeError:  # Drake's way to say that there is neither
        raise ValueError(
            "camera.focal is without x and y; it must have one of them at least"
        ) from None
    _check("camera.focal", focal, all(0 < f < inf for f in focal), "positive and finite [pixels]")
    center = camera.principal_point()
    valid = np.all((center > 0) & (center < [camera.width, camera.height]))
    _check("camera's principal point", center.tolist(), valid, "inside the image [pixels]")
    _check("camera.fps", camera.fps, 0.01 <= camera.fps <= 1000, "0.01 to 1000 Hz")
    for name in WITHOUT_EFFECT:
        value, default = (repr(getattr(c, name)) for c in (camera, CameraConfig()))
        _check(f"camera.{name}", value, value == default, "left out: a splat camera ignores it")


def _check_simulator(simulator: SimulatorConfig) -> None:
    known = GetIntegrationSchemes()
    scheme = simulator.integration_scheme
    _check("simulator.integration_scheme", scheme, scheme in known, f"one of {', '.join(known)}")
    step = simulator.max_step_size
    _check("simulator.max_step_size", step, 1e-5 <= step <= 1, "1e-5 to 1 s")
    accuracy = simulator.accuracy
    _check("simulator.accuracy", accuracy, 0 < accuracy < 1, "between 0 and 1")
    for name in ("start_time", "target_realtime_rate"):
        value = getattr(simulator, name)
        _check(f"simulator.{name}", value, value == 0, "0: flights start then, as fast as they can")
