"""A small room, ray-traced for cameras of any kind."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

# The inside of a box [m], z up.
LOWER, UPPER = np.array([0.0, -1.5, 0.0]), np.array([6.0, 1.5, 2.5])


def color_at(p_W: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(p_W, -1, 0)
    waves = [np.sin(3.1 * x) * np.cos(4 * z + 1), np.cos(5 * y + x), np.sin(2.2 * z + 1.7 * x + y)]
    return np.round(127.5 + 90 * np.stack(waves, axis=-1)).astype(np.uint8)


def level_camera(p: tuple, yaw: float, pitch: float, roll: float = 0.0) -> RigidTransform:
    R_WC = (
        RotationMatrix.MakeZRotation(yaw)
        @ RotationMatrix.MakeYRotation(-pitch)
        @ RotationMatrix(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]))
        @ RotationMatrix.MakeZRotation(roll)
    )
    return RigidTransform(R_WC, p)


@dataclass
class RoomView:
    X_WC: RigidTransform
    image: np.ndarray  # (H, W, 3) red, green, blue
    depth: np.ndarray  # (H, W) [m]


POSES = [
    level_camera((1.0 + 0.25 * i, 0.4 * np.sin(i), 1.2 + 0.1 * np.cos(i)), yaw, pitch)
    for i, (yaw, pitch) in enumerate(
        [(0.0, 0.0), (0.2, -0.2), (0.35, -0.3), (0.5, -0.1), (0.3, 0.1), (0.1, 0.2),
         (-0.1, 0.0), (-0.3, -0.3), (-0.15, -0.4), (0.05, -0.2)]
    )
]  # fmt: skip


def trace(X_WC: RigidTransform, rays: np.ndarray, finer: float = 1.0) -> RoomView:
    d_C = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
    d_W = d_C @ X_WC.rotation().matrix().T
    p_W = X_WC.translation()
    with np.errstate(divide="ignore"):
        depth = np.where(d_W > 0, UPPER - p_W, p_W - LOWER) / np.abs(d_W)
    depth = depth.min(axis=-1)
    return RoomView(X_WC, color_at(finer * (p_W + depth[..., None] * d_W)), depth)


def pinhole_rays(K: np.ndarray, width: int, height: int) -> np.ndarray:
    v, u = np.mgrid[0:height, 0:width] + 0.5
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1)


def assert_shows_room(capture, X_RW=None, color=6.0, depth: float | None = 1e-5) -> None:
    X_RW = X_RW or RigidTransform()
    for i in range(len(capture)):
        frame = capture.frame(i)
        X_RC = X_RW @ frame.X_WC
        seen = trace(X_RC, pinhole_rays(capture.K, capture.width, capture.height))
        assert frame.image.shape == seen.image.shape
        assert np.abs(frame.image.astype(float) - seen.image).mean() < color
        if depth is not None:
            known = frame.depth > 0
            assert known.mean() > 0.5
            assert np.median(np.abs(frame.depth[known] / seen.depth[known] - 1)) < depth


@pytest.fixture(scope="session")
def room_views() -> Callable[..., list[RoomView]]:
    def views(K, width: int, height: int, poses=POSES, finer: float = 1.0) -> list[RoomView]:
        return [trace(X_WC, pinhole_rays(K, width, height), finer) for X_WC in poses]

    return views


@pytest.fixture(scope="session")
def trace_rays() -> Callable[..., RoomView]:
    return trace


@pytest.fixture(scope="session")
def room_poses() -> list[RigidTransform]:
    return POSES


@pytest.fixture(scope="session")
def shows_room() -> Callable[..., None]:
    return assert_shows_room


@pytest.fixture(scope="session")
def K() -> np.ndarray:
    return np.array([[50.0, 0, 31.0], [0, 52.0, 25.0], [0, 0, 1]])
