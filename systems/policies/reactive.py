"""Reactive: a classical policy that sees depth and has learned nothing."""

import math
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F
from scipy.spatial import KDTree

from splatpilot.systems.collision.distance_field import soft_barrier
from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.common.validation import require_field
from splatpilot.systems.policies.motion_primitives import rotation_to, velocity_fan
from splatpilot.systems.policies.velocity import (
    RESPONSE_TIME,
    approach_velocity,
    tracking_acceleration,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state

# Avoidance from depth images alone: which velocity to take next, given a cloud of seen points.
#
# Candidate velocities point in a fan about the goal. Each is followed as a vehicle would, by a
# first-order response, and costs what is left of the way at its end, its nearness to points that
# were seen, and its way through space that no image has shown to be free.


_REACH = 1.5  # [m] Points farther than this from a trajectory cost nothing.
_SAMPLE_PERIOD = 0.25  # [s]
_FREE_RADIUS = 0.6  # [m] Space around the vehicle itself, taken to be free.


@dataclass
class ReactiveConfig:
    """The camera, the candidates and the weights of their cost; lengths are in metres.

    The cost of a candidate with samples p_i, d_i from the nearest seen point, is::

        |p_G - p_N| + height_weight |z_G - z_N|
        + sum (barrier_weight soft(d_i) + contact_weight max(0, r + margin - d_i)
               + unseen_weight [p_i unseen]) |p_i - p_(i-1)|
        + acceleration_weight |v - v_0|²

    with the soft barrier of equation (3), its margin `barrier_margin`.
    """

    camera: OnboardCamera = field(default_factory=OnboardCamera)
    # [m/s] Greatest speed.
    speed: float = 2.0
    # [Hz] Images and decisions per second.
    rate: float = 15.0
    # [-] Blocks across the image, of each of which the nearest pixel counts.
    columns: int = 16
    # [-] Blocks down the image.
    rows: int = 9
    # [-] How many images are remembered.
    memory: int = 20
    # [s] How far ahead candidates are followed.
    horizon: float = 1.5
    # [-] Number of directions to the sides.
    num_yaws: int = 17
    # [rad] Largest angle to the sides from the goal's direction.
    max_yaw: float = math.radians(100.0)
    # [-] Number of directions up and down.
    num_pitches: int = 3
    # [rad] Largest angle up and down.
    max_pitch: float = math.radians(25.0)
    # [-] Speeds as fractions of the greatest.
    speed_fractions: list[float] = field(default_factory=lambda: [0.33, 0.67, 1.0])
    # [m] Clearance kept for errors of tracking and for what lies between pixels.
    margin: float = 0.15
    # [m] Margin of the soft barrier.
    barrier_margin: float = 0.5
    # [-] Weight of a metre's difference of height from the goal.
    height_weight: float = 0.3
    # [1/m] Weight of nearness, along a metre of the way.
    barrier_weight: float = 4.0
    # [1/m] Weight of coming closer than radius and margin, along a metre of the way.
    contact_weight: float = 100.0
    # [-] Weight of a metre through what no image has shown.
    unseen_weight: float = 2.0
    # [s^2/m] Weight of the square of the change of velocity.
    acceleration_weight: float = 0.02

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        self.camera.validate()
        require_field(self, "speed", 0.0 < self.speed <= 20.0, "in (0, 20] m/s")
        require_field(self, "rate", 0.0 < self.rate <= 1000.0, "in (0, 1000] Hz")
        for name, size in (("columns", self.camera.width), ("rows", self.camera.height)):
            value = getattr(self, name)
            divides = 1 <= value <= size and size % value == 0
            require_field(self, name, divides, f"a divisor of the camera's {size} pixels")
        for name, largest in (("memory", 300), ("num_yaws", 100), ("num_pitches", 100)):
            require_field(self, name, 1 <= getattr(self, name) <= largest, f"1 to {largest}")
        require_field(self, "horizon", 0.3 <= self.horizon <= 10.0, "0.3 to 10 s")
        yaw, pitch = self.max_yaw, self.max_pitch
        require_field(self, "max_yaw", 0.0 <= yaw <= math.pi, "0 to pi rad")
        require_field(self, "max_pitch", 0.0 <= pitch < math.pi / 2, "0 to less than pi/2 rad")
        in_range = bool(self.speed_fractions) and all(0.0 < f <= 1.0 for f in self.speed_fractions)
        require_field(self, "speed_fractions", in_range, "one or more values in (0, 1]")
        weights = [f"{name}_weight" for name in ("height", "barrier", "contact", "unseen")]
        for name in (*weights, "acceleration_weight", "margin", "barrier_margin"):
            require_field(self, name, 0.0 <= getattr(self, name) < math.inf, "at least 0")


def nearest_points(depth: np.ndarray, config: ReactiveConfig) -> np.ndarray:
    """The nearest point of each block of pixels: p_CQ (rows * columns, 3) [m], NaN where none is.

    Args:
        depth: (H, W) [m] planar; infinity is nothing in range, 0 no measurement.
    """
    camera = config.camera
    shape = (config.rows, camera.height // config.rows, config.columns, -1)
    depth = np.where(depth > 0.0, depth, np.inf)
    blocks = depth.reshape(shape).swapaxes(1, 2).reshape(config.rows * config.columns, -1)
    nearest = blocks.argmin(axis=1)[:, None]
    z = np.take_along_axis(blocks, nearest, axis=1)  # (rows * columns, 1)
    slopes = camera.ray_slopes().reshape(*shape, 3).swapaxes(1, 2).reshape(*blocks.shape, 3)
    points = np.take_along_axis(slopes, nearest[..., None], axis=1)[:, 0]
    return np.where(np.isfinite(z), points * np.where(np.isfinite(z), z, 0.0), np.nan)


def candidate_velocities(to_goal: np.ndarray, config: ReactiveConfig) -> np.ndarray:
    """The velocities v (N, 3) [m/s] in a fan about the direction to the goal; the last is rest."""
    fan = velocity_fan(
        _even_angles(config.max_yaw, config.num_yaws),
        _even_angles(config.max_pitch, config.num_pitches),
        config.speed_fractions,
    )
    return np.vstack([config.speed * fan @ rotation_to(to_goal).T, np.zeros(3)])


def _even_angles(largest: float, count: int) -> np.ndarray:
    """`count` angles [rad] from -largest to largest. Of whole degrees, whose even parts a float
    holds exactly."""
    degrees = math.degrees(largest)
    return np.deg2rad(np.linspace(-degrees, degrees, count))


def responses(
    p_WB: np.ndarray, v_WB: np.ndarray, velocities: np.ndarray, horizon: float
) -> np.ndarray:
    """Positions (N, S, 3) [m] while the velocity approaches each of `velocities` (N, 3).

    v(t) = v + (v_0 - v) e^(-t/tau): the motion that `tracking_acceleration` leads to.
    """
    times = _SAMPLE_PERIOD * np.arange(1, round(horizon / _SAMPLE_PERIOD) + 1)[:, None]
    lag = RESPONSE_TIME * -np.expm1(-times / RESPONSE_TIME)  # (S, 1) [s]
    return p_WB + velocities[:, None] * (times - lag) + v_WB * lag


def is_seen(p_CQ: np.ndarray, depth: np.ndarray, camera: OnboardCamera) -> np.ndarray:
    """Whether the image shows the points p_CQ (..., 3) [m] to be free: (...,) bool.

    So it does inside the image and before its depth (H, W) [m].
    """
    z = np.maximum(p_CQ[..., 2], 1e-6)
    u = camera.focal_x * p_CQ[..., 0] / z + 0.5 * camera.width
    v = camera.focal_y * p_CQ[..., 1] / z + 0.5 * camera.height
    inside = (p_CQ[..., 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    row = np.where(inside, v, 0).astype(np.intp)
    column = np.where(inside, u, 0).astype(np.intp)
    return inside & (p_CQ[..., 2] < depth[row, column])


def candidate_costs(
    positions: np.ndarray,
    velocities: np.ndarray,
    p_WB: np.ndarray,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    points_W: np.ndarray,
    seen: np.ndarray,
    config: ReactiveConfig,
) -> np.ndarray:
    """The costs (N,) [m] of candidates, see `ReactiveConfig`.

    Args:
        positions: (N, S, 3) [m] along each.
        velocities: (N, 3) [m/s] that each leads to.
        p_WB, v_WB: where and how fast the vehicle is.
        p_WG: (3,) [m] the goal.
        points_W: (M, 3) [m] seen surfaces.
        seen: (N, S) whether the positions are seen to be free.
    """
    distances = np.full(positions.shape[:2], np.inf)
    farthest = np.linalg.norm(positions - p_WB, axis=2).max() + _REACH
    points_W = points_W[np.square(points_W - p_WB).sum(axis=1) < farthest**2]
    if len(points_W):
        distances = KDTree(points_W).query(positions, distance_upper_bound=_REACH)[0]
    starts = np.broadcast_to(p_WB, (len(positions), 1, 3))
    steps = np.linalg.norm(np.diff(positions, axis=1, prepend=starts), axis=2)  # (N, S) [m]
    barrier = soft_barrier(distances, VEHICLE_RADIUS, margin=config.barrier_margin)
    contact = np.maximum(VEHICLE_RADIUS + config.margin - distances, 0.0)
    away = np.linalg.norm(positions - p_WB, axis=2) > _FREE_RADIUS
    unseen = ~seen & away
    to_goal = p_WG - positions[:, -1]
    along = (
        config.barrier_weight * barrier
        + config.contact_weight * contact
        + config.unseen_weight * unseen
    )
    return (
        np.linalg.norm(to_goal, axis=1)
        + config.height_weight * np.abs(to_goal[:, 2])
        + (along * steps).sum(axis=1)
        + config.acceleration_weight * np.square(velocities - v_WB).sum(axis=1)
    )


class Reactive(LeafSystem):
    """Turns away from what its depth camera has seen in the last second.

    .. pydrake_system::

        name: Reactive
        input_ports:
        - state
        - goal
        - depth_image_32f
        output_ports:
        - acceleration

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``depth_image_32f``: planar depth [m] of the camera ``config.camera``.
    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded; zero before the first update.

    Updates at ``rate`` (15 Hz) from time 0: of a fan of velocities the cheapest by
    `candidate_costs`, and the acceleration that leads to it. The discrete state holds the
    acceleration and, in a ring, the points of the last ``memory`` images in the world frame, NaN
    where there are none.

    Raises:
        ValueError: from the constructor on a config out of range.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    depth_image_32f_input_port = input_port("depth_image_32f")
    acceleration_output_port = output_port("acceleration")

    def __init__(self, config: ReactiveConfig | None = None) -> None:
        super().__init__()
        self._config = config = config or ReactiveConfig()
        config.validate()
        camera = config.camera
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        self._depth_port = self.DeclareAbstractInputPort(
            "depth_image_32f", Value(ImageDepth32F(camera.width, camera.height))
        )
        self.DeclareStateOutputPort("acceleration", self.DeclareDiscreteState(3))
        self._points = self.DeclareDiscreteState(
            np.full(config.memory * config.rows * config.columns * 3, np.nan)
        )
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        config = self._config
        state = np.asarray(self._state_port.Eval(context))
        p_WG = np.asarray(self._goal_port.Eval(context))
        image = cast(ImageDepth32F, self._depth_port.Eval(context))
        depth = np.asarray(image.data)[..., 0].astype(float)
        p_WB, v_WB, _, _ = QuadrotorState.of(state)
        X_WC = pose_from_state(state) @ config.camera.X_BC()
        R_WC, p_WC = X_WC.rotation().matrix(), X_WC.translation()

        points = nearest_points(depth, config) @ R_WC.T + p_WC
        old = np.array(context.get_discrete_state(int(self._points)).value()).reshape(-1, 3)
        remembered = np.concatenate([points, old[: -len(points)]])

        v_fan = candidate_velocities(p_WG - p_WB, config)
        v_fan = np.vstack([v_fan, approach_velocity(p_WB, p_WG, config.speed)])
        positions = responses(p_WB, v_WB, v_fan, config.horizon)
        seen = is_seen((positions - p_WC) @ R_WC, depth, config.camera)
        known = remembered[np.isfinite(remembered[:, 0])]
        costs = candidate_costs(positions, v_fan, p_WB, v_WB, p_WG, known, seen, config)
        v_wanted = v_fan[np.argmin(costs)]

        discrete_state.set_value(0, tracking_acceleration(v_WB, v_wanted))
        discrete_state.set_value(int(self._points), remembered.ravel())
