"""The share of a scene's default flight that looks into what nobody captured."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.diagrams.flight_diagram import MakeCamera
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.scene_folder import read_scene_folder
from splatpilot.diagrams.worlds.scene_metadata import FRONTIER, read_scene_metadata
from splatpilot.systems.infeasible import InfeasibleFlightError
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.systems.splats.gaussian_ply import read_ply
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.splats.spherical_harmonics import C0

_POSES = 36


def unseen_share(scene: Path) -> float | None:
    """Returns the mean share of the onboard camera's pixels that show the frontier, along the route
    from the start to the goal of a scene folder, looking ahead; None if there is no route.

    Raises:
        FileNotFoundError, ValueError: for a damaged scene.
    """
    metadata = read_scene_metadata(scene)
    if not metadata.metric:
        return None
    world = read_scene_folder(scene)
    try:
        toa = time_of_arrival(world.esdf.conservative(), world.p_WG)
    except InfeasibleFlightError:
        return None
    if not toa.is_reachable(world.p_WS):
        return None
    if not metadata.frontier:
        return 0.0
    frontier = _painted(read_ply(scene / FRONTIER), 1.0)
    seen = _painted(read_ply(scene / "gaussians.ply"), 0.0).merged_with(frontier)
    camera = MakeCamera(Scenario(), replace(world, gaussians=seen, background=(0.0, 0.0, 0.0)))
    # Every point beyond the goal is the goal: the poses are those before it.
    reach = float(toa.value(world.p_WS))  # [m] at 1 m/s in the open, and no less than the length
    points, directions = toa.way(world.p_WS, np.linspace(0.0, reach, 8 * _POSES))
    before = np.flatnonzero(np.linalg.norm(directions[:, :2], axis=1) > 0.0)
    chosen = before[np.linspace(0, len(before) - 1, _POSES).astype(int)]
    shares = []
    for p_WB, direction in zip(points[chosen], directions[chosen], strict=True):
        yaw = np.arctan2(direction[1], direction[0])
        view = camera.render(RigidTransform(RollPitchYaw(0.0, 0.0, yaw), p_WB))
        shares.append((view.color[..., 0] > 0.5).mean())
    return float(np.mean(shares))


def _painted(gaussians: GaussianScene, level: float) -> GaussianScene:
    """The same Gaussians in one grey, 0 to 1."""
    sh = np.full((len(gaussians), 1, 3), (level - 0.5) / C0, dtype=np.float32)
    return replace(gaussians, sh=sh)
