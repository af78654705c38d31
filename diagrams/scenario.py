"""A scenario: everything one flight depends on, as a dataclass and as YAML."""

from dataclasses import dataclass, field

from pydrake.common.schema import Rotation, Transform
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.sensors import CameraConfig

from flysplat.diagrams.worlds.forest import ForestConfig
from flysplat.diagrams.worlds.make_world import WorldConfig
from flysplat.systems.policies.privileged_planner import PrivilegedPlannerConfig
from flysplat.systems.vehicle.flatness_controller import FlatnessControllerConfig
from flysplat.systems.vehicle.quadrotor_dynamics import QuadrotorParams

# Fields of Drake's CameraConfig about render engines and LCM, which a splat camera has no use for.
# Its background is the world's, and its depth image is registered with its colour image.
_WITHOUT_EFFECT = (
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
    # What is flown in: a generated world, or (!SceneConfig) a reconstructed scene.
    world: WorldConfig = field(default_factory=ForestConfig)
    # [m] Start p_WS and goal p_WG in the world frame; the world's own where left out.
    start: list[float] | None = None
    goal: list[float] | None = None
    # [m] The vehicle starts anywhere within this distance of the start, level and at rest.
    start_radius: float = 0.1
    # [m] The goal is reached within this distance.
    goal_radius: float = 0.3
    # [s] The flight ends after this time.
    timeout: float = 60.0
    vehicle: QuadrotorParams = field(default_factory=QuadrotorParams)
    camera: CameraConfig = field(default_factory=_default_camera)
    policy: PrivilegedPlannerConfig = field(default_factory=PrivilegedPlannerConfig)
    controller: FlatnessControllerConfig = field(default_factory=FlatnessControllerConfig)
    simulator: SimulatorConfig = field(default_factory=_default_simulator)

    def validate(self) -> None:
        """
        Checks what can be checked without building the world.

        Raises:
            ValueError: naming the field, its value and its limit.
        """
        for name in ("goal_radius", "timeout"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")
        for name in ("seed", "start_radius"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must not be negative")
        for name in ("start", "goal"):
            point = getattr(self, name)
            if point is not None and len(point) != 3:
                raise ValueError(f"{name} is {point}; it must be three numbers x, y, z in metres")
        camera = self.camera
        if camera.width < 1 or camera.height < 1:
            raise ValueError(
                f"camera is {camera.width}x{camera.height} pixels; both must be at least 1"
            )
        focal_lengths = (camera.focal_x(), camera.focal_y())
        if not all(0 < focal < float("inf") for focal in focal_lengths):
            raise ValueError(
                f"camera.focal gives focal lengths of {focal_lengths} pixels; they must be "
                "positive and finite"
            )
        if not camera.fps > 0:
            raise ValueError(f"camera.fps is {camera.fps}; it must be positive")
        for name in _WITHOUT_EFFECT:
            value, default = (repr(getattr(c, name)) for c in (camera, CameraConfig()))
            if value != default:
                raise ValueError(
                    f"camera.{name} is {value}, but a splat camera ignores it; leave it out"
                )
