from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.training.captures.capture import OPTICAL_AXES, Capture, pinhole

# The inside of a box [m], in north-east-down: 6 m north, 3 m east, 2.5 m high, floor at z = 0.
LOWER_N = np.array([0.0, -1.5, -2.5])
UPPER_N = np.array([6.0, 1.5, 0.0])


def room_color(p_N: np.ndarray) -> np.ndarray:
    """Color (..., 3), 0 to 1, of the points (..., 3) on the walls: broad colored waves."""
    north, east, down = np.moveaxis(p_N, -1, 0)
    return np.stack(
        [
            0.5 + 0.3 * np.sin(1.5 * north) * np.cos(2 * down),
            0.5 + 0.3 * np.cos(2 * east),
            0.45 + 0.25 * np.sin(1.2 * down + north),
        ],
        axis=-1,
    )


def tiled_color(p_N: np.ndarray) -> np.ndarray:
    """The same with tiles of 8 cm, each of a brightness of its own: something to match."""
    i, j, k = np.moveaxis(np.floor(p_N / 0.08 + 1e-6).astype(np.int64), -1, 0)
    brightness = (i * 73856093 ^ j * 19349663 ^ k * 83492791) % 1009 / 1009
    return 0.5 * room_color(p_N) + 0.5 * brightness[..., None]


def trace_room(p_N: np.ndarray, R_NB: np.ndarray, width: int, height: int, color_at=room_color):
    """Depth (H, W) [m] along the body's x axis and color (H, W, 3) of the room from inside."""
    K = pinhole(width / 2, width / 2, width / 2, height / 2)
    d_N = np.dstack([np.ones((height, width)), pinhole_rays(K, width, height)]) @ R_NB.T
    depth = wall_depth(p_N, d_N, LOWER_N, UPPER_N)
    return depth, color_at(p_N + depth[..., None] * d_N)


def pinhole_rays(K: np.ndarray, width: int, height: int) -> np.ndarray:
    """Rays x/z, y/z (H, W, 2) of the pixels."""
    v, u = np.mgrid[0:height, 0:width] + 0.5
    return np.dstack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]])


def wall_depth(p: np.ndarray, d: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Lengths (...) of rays d (..., 3) from a point p in a box to its sides."""
    with np.errstate(divide="ignore"):
        return (np.where(d > 0, upper - p, p - lower) / np.abs(d)).min(axis=-1)


def rotation_from_yaw_pitch(yaw: float, pitch: float) -> tuple[np.ndarray, np.ndarray]:
    """R_NB and the quaternion xyzw of a yaw to the right followed by a pitch up (NED) [rad]."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    R_NB = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array(
        [[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]
    )
    a, b, c, d = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    return R_NB, np.array([-b * d, a * d, b * c, a * c])


# Poses that walk through the room and look around: position in N [m], yaw and pitch [rad].
ROOM_POSES = [
    ((0.8 + 0.4 * i, 0.6 * np.sin(i), -1.2 + 0.1 * np.cos(i)), yaw, pitch)
    for i, (yaw, pitch) in enumerate(
        [(0, 0), (0.5, -0.5), (-0.9, -0.3), (1.5, 0.3), (3.0, -0.2), (-2.2, -0.4)] * 2
    )
]


def write_room_capture(
    path: Path,
    *,
    width: int = 64,
    height: int = 48,
    poses: list = ROOM_POSES,
    brightness: Callable[[int, np.ndarray], np.ndarray] = lambda i, rho_squared: np.ones(1),
    color_at: Callable[[np.ndarray], np.ndarray] = room_color,
) -> Path:
    """Writes the room, colored as `color_at` says, as a TartanAir V1 sequence, image i times
    brightness(i, (H, W) rho^2)."""
    (path / "image_left").mkdir(parents=True)
    (path / "depth_left").mkdir()
    v, u = np.mgrid[0:height, 0:width] + 0.5
    rho_squared = ((u - width / 2) ** 2 + (v - height / 2) ** 2) / ((width**2 + height**2) / 4)
    lines = []
    for i, (p_N, yaw, pitch) in enumerate(poses):
        R_NB, xyzw = rotation_from_yaw_pitch(yaw, pitch)
        depth, color = trace_room(np.array(p_N), R_NB, width, height, color_at)
        color = np.clip(color * brightness(i, rho_squared)[..., None], 0, 1)
        bgr = np.round(color[..., ::-1] * 255).astype(np.uint8)
        cv2.imwrite(str(path / "image_left" / f"{i:06d}_left.png"), bgr)
        np.save(path / "depth_left" / f"{i:06d}_left_depth.npy", depth.astype(np.float32))
        lines.append(" ".join(f"{x:.9f}" for x in (*p_N, *xyzw)))
    (path / "pose_left.txt").write_text("\n".join(lines) + "\n")
    return path


def tiled_flight(turn: float = 1.0, aside: float = 1.0) -> Capture:
    """A flight along the tiled room, in images of 320x240 px without depth."""
    K, poses, images = pinhole(160, 160, 160, 120), [], []
    R_WN = RotationMatrix(np.diag([1.0, -1, -1]))
    R_BC = RotationMatrix(np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]))
    for i in range(8):
        R_NB, _ = rotation_from_yaw_pitch(0.3 * turn * np.sin(i), 0.1 * turn * np.cos(2 * i))
        y, z = 0.4 * aside * np.sin(1.3 * i), -1.2 + 0.2 * aside * np.cos(i)
        p_N = np.array([0.5 + 0.15 * i, y, z])
        image = trace_room(p_N, R_NB, 320, 240, tiled_color)[1]
        images.append((255 * image).astype(np.uint8))
        poses.append(RigidTransform(R_WN @ RotationMatrix(R_NB) @ R_BC, R_WN.multiply(p_N)))
    return Capture("flight", "a flight", K, 320, 240, poses, lambda i: images[i], axes=OPTICAL_AXES)


# The same box with z up, in finer waves, seen by a pinhole camera of 64x48 pixels.
LOWER_W, UPPER_W = np.array([0.0, -1.5, 0.0]), np.array([6.0, 1.5, 2.5])
K = pinhole(50.0, 52.0, 31.0, 25.0)
R_LEVEL = RotationMatrix(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]))
CAMERA_POSES = [
    RigidTransform(
        RotationMatrix.MakeZRotation(yaw) @ RotationMatrix.MakeYRotation(-pitch) @ R_LEVEL,
        [1.0 + 0.25 * i, 0.4 * np.sin(i), 1.2 + 0.1 * np.cos(i)],
    )
    for i, (yaw, pitch) in enumerate(
        [(0.0, 0.0), (0.2, -0.2), (0.35, -0.3), (0.5, -0.1), (0.3, 0.1), (0.1, 0.2),
         (-0.1, 0.0), (-0.3, -0.3), (-0.15, -0.4), (0.05, -0.2)]
    )
]  # fmt: skip


@dataclass
class RoomView:
    X_WC: RigidTransform
    image: np.ndarray  # (H, W, 3) red, green, blue
    depth: np.ndarray  # (H, W) [m]


def trace(X_WC: RigidTransform, rays: np.ndarray, finer: float = 1.0) -> RoomView:
    """The room along the rays (H, W, 2) of a camera."""
    d_C, p_WC = np.dstack([rays, np.ones(rays.shape[:2])]), X_WC.translation()
    d_W = d_C @ X_WC.rotation().matrix().T
    depth = wall_depth(p_WC, d_W, LOWER_W, UPPER_W)
    x, y, z = np.moveaxis(finer * (p_WC + depth[..., None] * d_W), -1, 0)
    waves = [np.sin(3.1 * x) * np.cos(4 * z + 1), np.cos(5 * y + x), np.sin(2.2 * z + 1.7 * x + y)]
    return RoomView(X_WC, np.round(127.5 + 90 * np.stack(waves, axis=-1)).astype(np.uint8), depth)


def room_views(K, width: int, height: int, poses=CAMERA_POSES, finer: float = 1.0):
    return [trace(X_WC, pinhole_rays(K, width, height), finer) for X_WC in poses]


def assert_shows_room(capture, X_RW=None, color=6.0, depth: float | None = 1e-5) -> None:
    rays = pinhole_rays(capture.K, capture.width, capture.height)
    for frame in capture.frames():
        seen = trace((X_RW or RigidTransform()) @ frame.X_WC, rays)
        assert frame.image.shape == seen.image.shape
        assert np.abs(frame.image.astype(float) - seen.image).mean() < color
        if depth is not None:
            known = frame.depth > 0
            assert known.mean() > 0.5
            assert np.median(np.abs(frame.depth[known] / seen.depth[known] - 1)) < depth
