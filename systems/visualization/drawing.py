"""What stands still on a Meshcat scene: world, goal, vehicle, distance field."""

import numpy as np
from pydrake.geometry import Box, Cylinder, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.perception import BaseField, Fields, PointCloud

from splatpilot.systems.collision.distance_field import DistanceField, FieldState
from splatpilot.systems.splats.gaussian_scene import GaussianScene


def draw_gaussians(
    meshcat: Meshcat,
    path: str,
    scene: GaussianScene,
    lower_W: np.ndarray,
    upper_W: np.ndarray,
    max_points: int = 120_000,
) -> None:
    """
    Draws the centres of the Gaussians inside a box as coloured points, evenly thinned.

    The points are as large as the median Gaussian, so that surfaces look closed.

    Args:
        path: Meshcat path of the point cloud.
        lower_W, upper_W: corners of the box (3,) [m]; what lies outside (sky, far hills) is left
            out.
        max_points: most points drawn.
    """
    inside = np.flatnonzero(np.all((scene.means >= lower_W) & (scene.means <= upper_W), axis=1))
    if len(inside) > max_points:
        inside = inside[np.linspace(0, len(inside) - 1, max_points).astype(int)]
    cloud = PointCloud(len(inside), Fields(BaseField.kXYZs | BaseField.kRGBs))
    cloud.mutable_xyzs()[:] = scene.means[inside].T
    # Meshcat takes the colours of points for linear light and encodes them for the screen itself.
    cloud.mutable_rgbs()[:] = (scene.base_colors[inside].T ** 2.2 * 255).astype(np.uint8)
    extent = np.median(scene.scales[inside].max(axis=1)) if len(inside) else 0.05
    meshcat.SetObject(path, cloud, point_size=2.0 * float(extent))


GOAL_COLOR, START_COLOR = Rgba(0.1, 0.9, 0.3, 0.4), Rgba(0.1, 0.5, 1.0, 0.4)
BALL = 0.25  # [m], radius of what marks start and goal where nobody flies


def draw_goal(
    meshcat: Meshcat, path: str, p_WG: np.ndarray, radius: float, color: Rgba = GOAL_COLOR
) -> None:
    """Draws the goal region, a translucent ball of `radius` [m] about p_WG (3,) [m], below a pole
    of 3 m that is seen from afar."""
    meshcat.SetObject(path, Sphere(radius), color)
    meshcat.SetObject(f"{path}/pole", Cylinder(0.04, 3.0), color)
    meshcat.SetTransform(f"{path}/pole", RigidTransform(np.array([0.0, 0.0, 1.5])))
    meshcat.SetTransform(path, RigidTransform(p_WG))


def box_edges(lower_W: np.ndarray, upper_W: np.ndarray) -> np.ndarray:
    """The ends (12, 2, 3) [m] of the edges of the box from lower_W (3,) to upper_W (3,) [m]."""
    corners = np.array(list(np.ndindex(2, 2, 2)))
    starts, ends = np.nonzero(np.abs(corners[:, None] - corners).sum(axis=-1) == 1)
    once = starts < ends
    p_WQ = np.where(corners == 0, lower_W, upper_W)
    return np.stack([p_WQ[starts[once]], p_WQ[ends[once]]], axis=1)


def draw_box(meshcat: Meshcat, path: str, lower_W: np.ndarray, upper_W: np.ndarray) -> None:
    """Draws the edges of the box from lower_W (3,) to upper_W (3,) [m]."""
    edges = box_edges(lower_W, upper_W)
    meshcat.SetLineSegments(path, edges[:, 0].T, edges[:, 1].T, 1.0, Rgba(1.0, 1.0, 1.0))


def draw_vehicle(meshcat: Meshcat, path: str, radius: float) -> None:
    """Draws a quadrotor whose propeller tips reach `radius` [m]; frame B: x forward, z up."""
    propeller = 0.36 * radius
    arm = radius - propeller
    dark, front, rear = Rgba(0.1, 0.1, 0.12), Rgba(0.9, 0.2, 0.1, 0.6), Rgba(0.3, 0.3, 0.35, 0.6)
    meshcat.SetObject(f"{path}/body", Box(0.5 * radius, 0.35 * radius, 0.2 * radius), dark)
    for name, angle, color in (
        ("front_left", np.pi / 4, front),
        ("rear_left", 3 * np.pi / 4, rear),
        ("rear_right", -3 * np.pi / 4, rear),
        ("front_right", -np.pi / 4, front),
    ):
        R_BA = RotationMatrix.MakeZRotation(angle)
        meshcat.SetObject(f"{path}/{name}_arm", Box(arm, 0.02, 0.02), dark)
        meshcat.SetTransform(f"{path}/{name}_arm", RigidTransform(R_BA, R_BA @ [arm / 2, 0, 0]))
        meshcat.SetObject(f"{path}/{name}_propeller", Cylinder(propeller, 0.01), color)
        meshcat.SetTransform(
            f"{path}/{name}_propeller", RigidTransform(R_BA @ np.array([arm, 0, 0.03]))
        )


UNKNOWN_GREY = 0.4
"""Shade of space that nobody saw."""


def distance_colors(distances: np.ndarray) -> np.ndarray:
    """Colours (N, 3), 0 to 1, of distances (N,) in units of that from which on all are alike: red
    at or inside a surface, fading through yellow at one half to blue."""
    ramp = np.clip(distances, 0.0, 1.0)
    return np.stack([np.interp(ramp, (0.5, 1), (1, 0)), 1 - np.abs(2 * ramp - 1), ramp**2], -1)


def distance_slice(
    field: DistanceField, height: float, spacing: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    The horizontal slice of a distance field at z = `height` [m], as a coloured mesh.

    Red is at or inside a surface, fading through yellow to blue at `reach` [m] and more; unknown
    space is grey.

    Args:
        spacing: distance between the samples [m].

    Returns:
        Its vertices p_WQ (N, 3) [m], faces (M, 3), which are seen from above, and the colours of
        the vertices (N, 3), 0 to 1.
    """
    lower_W, upper_W = np.asarray(field.lower_W), np.asarray(field.upper_W)
    counts = np.maximum(2, np.ceil((upper_W[:2] - lower_W[:2]) / spacing).astype(int))
    # A little inside, where every field has an answer.
    margin = 1e-3 * (upper_W[:2] - lower_W[:2])
    xs, ys = (
        np.linspace(lower_W[i] + margin[i], upper_W[i] - margin[i], counts[i]) for i in range(2)
    )
    p_WQ = np.stack(np.meshgrid(xs, ys, [height], indexing="ij"), axis=-1).reshape(-1, 3)
    sample = field.query(p_WQ)
    colors = distance_colors(np.nan_to_num(sample.distance) / reach)
    colors[sample.state >= FieldState.UNKNOWN] = UNKNOWN_GREY

    i, j = np.meshgrid(np.arange(counts[0] - 1), np.arange(counts[1] - 1), indexing="ij")
    corner = (i * counts[1] + j).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + counts[1], corner + 1], axis=-1),
            np.stack([corner + 1, corner + counts[1], corner + counts[1] + 1], axis=-1),
        ]
    )
    return p_WQ, faces.astype(np.int32), colors


def draw_distance_slice(
    meshcat: Meshcat, path: str, field: DistanceField, height: float, spacing: float = 0.2
) -> None:
    """
    Draws the `distance_slice` of a field, blue from 2 m on.

    Args:
        path: Meshcat path of the coloured mesh.
        height: of the slice, z [m].
        spacing: distance between the samples [m].
    """
    p_WQ, faces, colors = distance_slice(field, height, spacing, reach=2.0)
    meshcat.SetTriangleColorMesh(path, p_WQ.T, faces.T, colors.T)
