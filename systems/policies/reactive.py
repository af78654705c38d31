"""Reactive: a classical policy that avoids the points seen in recent depth images.

Candidate velocities form a fan around the direction to the goal, each with a first-order response.
Its cost is the remaining distance, the proximity of seen points and the length in unseen space.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import KDTree

from splatpilot.systems.collision.distance_field import soft_barrier
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.policies.base import Observation, Policy, target_velocity
from splatpilot.systems.policies.lattice import rotation_to, velocity_fan
from splatpilot.systems.policies.velocity import RESPONSE_TIME, SLOWING_TIME, tracking_acceleration
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

_MAX_DISTANCE = 1.5  # [m] Points at a greater distance from a trajectory cost nothing.
_SAMPLE_PERIOD, _SAMPLES = 0.25, 6  # [s], of candidates
_FREE_RADIUS = 0.6  # [m] Space around the vehicle that counts as seen.

# Candidates over the maximum speed, in a frame with x toward the goal.
_YAWS, _PITCHES = (np.deg2rad(np.linspace(-end, end, n)) for end, n in ((100.0, 17), (25.0, 3)))
_FAN = velocity_fan(_YAWS, _PITCHES, [0.33, 0.67, 1.0])


@dataclass
class ReactiveConfig(Config):
    """The camera, the seen points and the clearance from them."""

    camera: OnboardCamera = field(default_factory=OnboardCamera)
    # [m/s] Maximum speed.
    speed: float = bounded(2.0, "(0, 20] m/s")
    # [Hz] Updates per second.
    rate: float = bounded(15.0, "(0, 1000] Hz")
    # [-] Blocks across the image; the nearest pixel of each is a seen point.
    columns: int = 16
    # [-] Blocks down the image.
    rows: int = 9
    # [-] Number of images whose points are kept.
    memory: int = bounded(20, "[1, 300]")
    # [m] Clearance for errors of tracking and for obstacles between pixels.
    margin: float = bounded(0.15, "[0, inf) m")
    # [m] Margin of the soft barrier.
    barrier_margin: float = bounded(0.5, "[0, inf) m")

    def check(self) -> None:
        for name, size in (("columns", self.camera.width), ("rows", self.camera.height)):
            value = getattr(self, name)
            divides = 1 <= value <= size and size % value == 0
            require_field(self, name, divides, f"a divisor of the camera's {size} pixels")


def nearest_points(depth: np.ndarray, config: ReactiveConfig) -> np.ndarray:
    """Returns the nearest point p_CQ (rows * columns, 3) [m] of each block, or NaN, from planar
    depth (H, W) [m]; infinity: nothing in range, 0: no measurement."""
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
    """Returns a fan of velocities (N, 3) [m/s] around the goal's direction, and zero."""
    return np.vstack([config.speed * _FAN @ rotation_to(to_goal).T, np.zeros(3)])


def responses(p_WB: np.ndarray, v_WB: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """Returns positions (N, S, 3) [m] while the velocity approaches each of `velocities` (N, 3).

    v(t) = v + (v_0 - v) e^(-t/tau), the motion under `tracking_acceleration`.
    """
    times = _SAMPLE_PERIOD * np.arange(1, _SAMPLES + 1)[:, None]
    lag = RESPONSE_TIME * -np.expm1(-times / RESPONSE_TIME)  # (S, 1) [s]
    return p_WB + velocities[:, None] * (times - lag) + v_WB * lag


def is_seen(p_CQ: np.ndarray, depth: np.ndarray, camera: OnboardCamera) -> np.ndarray:
    """Checks that points p_CQ (..., 3) [m] are inside the image and before its depth (H, W) [m]."""
    slopes = p_CQ[..., :2] / np.maximum(p_CQ[..., 2:], 1e-6)
    if camera.distortion is not None:
        slopes = camera.distortion.project(slopes)
    u = camera.focal_x * slopes[..., 0] + 0.5 * camera.width
    v = camera.focal_y * slopes[..., 1] + 0.5 * camera.height
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
    free: np.ndarray,
    config: ReactiveConfig,
) -> np.ndarray:
    """Computes the costs (N,) [m] of candidates by their positions (N, S, 3), velocities (N, 3),
    the seen points_W (M, 3) and whether they are known `free` (N, S).

    The cost with samples p_i, d_i from the nearest seen point, is::

        |p_G - p_N| + 0.3 |z_G - z_N| + 0.02 |v - v_0|²
        + sum (4 soft(d_i) + 100 max(0, r + margin - d_i) + 2 [p_i unseen]) |p_i - p_(i-1)|

    with the soft barrier of equation (3), its margin `barrier_margin`.
    """
    distances = np.full(positions.shape[:2], np.inf)
    farthest = np.linalg.norm(positions - p_WB, axis=2).max() + _MAX_DISTANCE
    points_W = points_W[np.square(points_W - p_WB).sum(axis=1) < farthest**2]
    if len(points_W):
        distances = KDTree(points_W).query(positions, distance_upper_bound=_MAX_DISTANCE)[0]
    starts = np.broadcast_to(p_WB, (len(positions), 1, 3))
    steps = np.linalg.norm(np.diff(positions, axis=1, prepend=starts), axis=2)  # (N, S) [m]
    barrier = soft_barrier(distances, VEHICLE_RADIUS, margin=config.barrier_margin)
    contact = np.maximum(VEHICLE_RADIUS + config.margin - distances, 0.0)
    unseen = ~free & (np.linalg.norm(positions - p_WB, axis=2) > _FREE_RADIUS)
    to_goal = p_WG - positions[:, -1]
    along = 4.0 * barrier + 100.0 * contact + 2.0 * unseen
    return (
        np.linalg.norm(to_goal, axis=1)
        + 0.3 * np.abs(to_goal[:, 2])
        + (along * steps).sum(axis=1)
        + 0.02 * np.square(velocities - v_WB).sum(axis=1)
    )


def compute_command(
    observed: Observation, points_W: np.ndarray, config: ReactiveConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Computes a_WB (3,) [m/s^2], gravity excluded, and the points (M, 3) [m] to remember, from
    depth and the points_W of earlier images, whose missing ones are NaN."""
    depth = observed.image.astype(float)
    p_WB, v_WB, _, _ = observed.state
    X_WC = observed.X_WB @ config.camera.mount()
    R_WC, p_WC = X_WC.rotation().matrix(), X_WC.translation()
    points = nearest_points(depth, config) @ R_WC.T + p_WC
    points_W = np.concatenate([points, points_W[: -len(points)]])
    known = points_W[np.isfinite(points_W[:, 0])]

    straight = target_velocity(p_WB, observed.p_WG, config.speed, SLOWING_TIME)
    velocities = np.vstack([candidate_velocities(observed.p_WG - p_WB, config), straight])
    positions = responses(p_WB, v_WB, velocities)
    free = is_seen((positions - p_WC) @ R_WC, depth, config.camera)
    costs = candidate_costs(positions, velocities, p_WB, v_WB, observed.p_WG, known, free, config)
    return tracking_acceleration(v_WB, velocities[np.argmin(costs)]), points_W


class Reactive(Policy):
    """Takes the candidate velocity of lowest cost, by the points of recent depth images.

    .. pydrake_system::

        name: Reactive
        input_ports: [state, goal, depth_image_32f]
        output_ports: [acceleration]

    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded.

    The second group of the discrete state holds the points of the last ``memory`` images in the
    world frame; missing ones are NaN.
    """

    def __init__(self, config: ReactiveConfig | None = None) -> None:
        config = config or ReactiveConfig()
        super().__init__(config, "depth_image_32f")
        self.declare_state(np.zeros(3), "acceleration")
        self.declare_state(np.full(config.memory * config.rows * config.columns * 3, np.nan))

    def decide(self, observed: Observation, *state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a_WB, points = compute_command(observed, state[1].reshape(-1, 3), self.config)
        return a_WB, points.ravel()
