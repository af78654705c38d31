"""A scenario: everything one flight depends on, as a dataclass and as YAML."""

from dataclasses import dataclass, field
from math import inf
from pathlib import Path

import numpy as np
from pydrake.common.schema import Rotation, Transform
from pydrake.systems.analysis import GetIntegrationSchemes, SimulatorConfig
from pydrake.systems.sensors import CameraConfig

from splatpilot.diagrams.flight.policies import POLICIES, PolicyConfig
from splatpilot.diagrams.flight.sensors import SENSORS, SensorConfig
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import WORLDS, WorldConfig
from splatpilot.systems.common.config import open_field
from splatpilot.systems.common.seeds import check_seed
from splatpilot.systems.common.validation import FieldError, require, unknown
from splatpilot.systems.policies.planner import PrivilegedPlannerConfig
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams

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

    # Seed of everything random, in [0, 2147483647]: the environment if it is generated, and the
    # start's offset.
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
        check_seed(self.seed)
        require(0 <= self.appearance <= 1, "appearance", "in [0, 1]", self.appearance)
        require(0 <= self.start_radius <= 1, "start_radius", "in [0, 1] m", self.start_radius)
        require(0 < self.goal_radius < inf, "goal_radius", "positive and finite", self.goal_radius)
        require(0 < self.timeout <= 3600, "timeout", "in (0, 3600] s", self.timeout)
        for name in ("start", "goal"):
            point = getattr(self, name)
            valid = point is None or (len(point) == 3 and np.isfinite(point).all())
            require(valid, name, "three finite numbers x, y, z [m]", point)
        parts = [(WORLDS, self.world), (POLICIES, self.policy)]
        for registry, part in [*parts, *((SENSORS, sensor) for sensor in self.sensors.values())]:
            registry.kind_of(part)
            try:
                part.validate()
            except FieldError as error:
                raise error.within(self) from None
        try:
            self.observation.validate()
        except FieldError as error:
            raise error.within(self) from None
        _check_camera(self.camera)
        _check_simulator(self.simulator)


def _check_camera(camera: CameraConfig) -> None:
    pixels = camera.width * camera.height
    valid = camera.width > 1 and camera.height > 1 and pixels <= _MAX_PIXELS
    size = f"{camera.width}x{camera.height} pixels"
    require(valid, "camera", f"at least 2x2 and at most {_MAX_PIXELS} pixels", size)
    try:
        focal = (camera.focal_x(), camera.focal_y())
    except RuntimeError:  # Drake's way to say that there is neither
        raise ValueError("camera.focal must have x or y or both, got neither") from None
    require(all(0 < f < inf for f in focal), "camera.focal", "positive and finite [pixels]", focal)
    center = camera.principal_point()
    valid = np.all((center > 0) & (center < [camera.width, camera.height]))
    require(valid, "camera's principal point", "inside the image [pixels]", center.tolist())
    require(0.01 <= camera.fps <= 1000, "camera.fps", "in [0.01, 1000] Hz", camera.fps)
    for name in WITHOUT_EFFECT:
        value, default = (repr(getattr(c, name)) for c in (camera, CameraConfig()))
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


_FOLDER = Path(__file__).parents[1] / "scenarios"


def benchmark_scenarios() -> dict[str, Path]:
    """The files of the benchmark's scenarios by name."""
    return _files(_FOLDER)


def other_scenarios() -> dict[str, Path]:
    """The files of the scenarios that come with the program and are not in the benchmark."""
    return _files(_FOLDER / "others")


def _files(folder: Path) -> dict[str, Path]:
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def scenario_file(scenario: str) -> Path:
    """
    The file of a scenario that comes with the program, given by its name, or of another, given as a
    path.

    Raises:
        ValueError: if it is neither.
    """
    known = benchmark_scenarios() | other_scenarios()
    if scenario in known:
        return known[scenario]
    if Path(scenario).suffix in (".yaml", ".yml") or Path(scenario).is_file():
        return Path(scenario)
    raise ValueError(unknown("scenario", scenario, known, "and others as YAML files"))
