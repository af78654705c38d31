"""The true depth of what is flown in: of generated worlds along flights, and of captures."""

from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import torch
from depth_errors import DepthFrame
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.systems.sensors import ImageDepth32F

from splatpilot.analysis.reconstruction.measure_scene import SceneViews
from splatpilot.diagrams.flight.flight import fly
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.sensors import make_camera
from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.diagrams.worlds.solids.surfaces import merge
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_spec, make_world
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.splat_camera import ranged_depth
from splatpilot.systems.splats.splat_files import read_ply
from splatpilot.systems.vehicle.state import pose_from_state
from splatpilot.training.policies.ray_casting import PixelRays, ShapeGeometry
from splatpilot.training.reconstruction.metrics import has_true_depth

_BEYOND = 0.1
"""[m], how far outside the volume scenery may begin."""

_GHOST = 0.3
"""[m] from surfaces, from where on none may be seen: voxels and their errors are less."""

_VEIL = 0.01
"""Alpha from which scenery that has no solid may be what a pixel shows."""


class TrueDepth:
    """Exact depth images of the solids of a generated world.

    Scenery beyond the volume has no solids, and the trunks of forests end in crowns above it: what
    is there is not known.
    """

    def __init__(self, spec: WorldSpec) -> None:
        self._lower_W, self._upper_W = spec.lower_W - _BEYOND, spec.upper_W + _BEYOND
        shapes = [solid.shape for solid in (*spec.solids, *spec.scenery)]
        self._geometry = ShapeGeometry([shapes])
        scenery = spec.surroundings()
        self._scenery = BakedScene(merge(scenery)) if scenery else None

    def image(self, camera: OnboardCamera, X_WC: RigidTransform) -> NDArray[np.floating]:
        """Planar depth (H, W) [m] along the middles of the pixels, exact to 3 mm within reach of
        the camera; infinite where nothing is, NaN where unknown."""
        slopes_C = camera.ray_slopes()
        R_WC, p_WC = X_WC.rotation().matrix(), X_WC.translation()
        middles = PixelRays(slopes_C.reshape(-1, 3).astype(np.float32), half_pixel=0.0)
        p, R = (torch.tensor(x, dtype=torch.float32)[None] for x in (p_WC, R_WC))
        depth = self._geometry.depth(p, R, middles, torch.zeros(1).long()).numpy()
        depth = depth.reshape(slopes_C.shape[:2])
        with np.errstate(invalid="ignore"):
            p_WQ = p_WC + depth[..., None] * (slopes_C @ R_WC.T)
            outside = ~((p_WQ >= self._lower_W) & (p_WQ <= self._upper_W)).all(axis=-1)
            unknown = np.isfinite(depth) & (p_WQ[..., 2] > self._upper_W[2])
        if self._scenery is not None:
            K, size = camera.camera_info().intrinsic_matrix(), (camera.width, camera.height)
            view = self._scenery.render(K, *size, X_WC, near=0.01, far=camera.max_depth)
            unknown |= outside & (view.alpha > _VEIL)
        return np.where(unknown, np.nan, depth)


def frames_along_flight(
    scenario: Scenario, cameras: list[OnboardCamera], count: int
) -> list[list[DepthFrame]]:
    """Flies a scenario in a generated world, and returns of each camera `count` frames evenly in
    time.

    Raises:
        ValueError: for worlds that are not generated or cannot be made.
        InfeasibleFlightError: for flights that cannot be flown.
    """
    truth = TrueDepth(make_spec(scenario.world, scenario.seed))
    world = make_world(scenario.world, scenario.seed)
    poses = _poses_along_flight(scenario, world, count)
    frames = []
    for config in cameras:
        seen = _depth_images(config, world, poses)
        true = (truth.image(config, X_WB @ config.X_BC()) for X_WB in poses)
        frames.append([DepthFrame(*pair) for pair in zip(seen, true, strict=True)])
    return frames


def ghosts_along_flight(
    scenario: Scenario, camera: OnboardCamera, count: int
) -> NDArray[np.floating]:
    """Flies a scenario, and returns of `count` frames (count,) evenly in time the share of pixels
    with ghosts: depth that ends more than 0.3 m from all that the distance field knows, where it is
    free. Captured places have no other truth where their cameras never were.

    Raises:
        ValueError: for worlds that cannot be made.
        InfeasibleFlightError: for flights that cannot be flown.
    """
    world = make_world(scenario.world, scenario.seed)
    poses = _poses_along_flight(scenario, world, count)
    slopes_C, shares = camera.ray_slopes(), []
    for X_WB, depth in zip(poses, _depth_images(camera, world, poses), strict=True):
        X_WC = X_WB @ camera.X_BC()
        shown = np.isfinite(depth)
        p_CQ = depth[shown][:, None] * slopes_C[shown]
        there = world.distance_field.query(p_CQ @ X_WC.rotation().matrix().T + X_WC.translation())
        free = (there.state == FieldState.FREE) & (there.distance > _GHOST)
        shares.append(free.sum() / depth.size)
    return np.array(shares)


def _poses_along_flight(scenario: Scenario, world: World, count: int) -> list[RigidTransform]:
    """X_WB at `count` times of a flight."""
    flight = fly(BuildFlightDiagram(scenario, world, camera=False), scenario, world)
    rows = np.linspace(0, len(flight.states) - 1, count).astype(int)
    return [pose_from_state(state) for state in flight.states[rows]]


def _depth_images(
    config: OnboardCamera, world: World, poses: list[RigidTransform]
) -> Iterator[NDArray[np.floating]]:
    """What policies are handed: depth (H, W) [m]."""
    camera = make_camera(config, world)
    context = camera.CreateDefaultContext()
    for X_WB in poses:
        camera.GetInputPort("body_pose").FixValue(context, X_WB)
        image = cast(ImageDepth32F, camera.GetOutputPort("depth_image_32f").Eval(context))
        yield np.array(image.data)[..., 0]


def frames_of_capture(scene: Path, cameras: list[OnboardCamera]) -> list[list[DepthFrame]]:
    """Returns of each camera its frames where the capture of a scene folder was withheld, the
    truth being the nearest pixel of the captured depth.

    Raises:
        FileNotFoundError, ValueError, OSError: for a damaged scene or capture, or one of which
            nothing was withheld.
    """
    views = SceneViews(scene)
    if not views.metadata.held_out:
        raise ValueError(f"{scene}: no frames were withheld from it to compare it with")
    gaussians = BakedScene(read_ply(scene / "gaussians.ply"))
    frames: list[list[DepthFrame]] = [[] for _ in cameras]
    for i in views.metadata.held_out:
        captured = views.capture.frame(i)
        for config, seen in zip(cameras, frames, strict=True):
            K, size = config.camera_info().intrinsic_matrix(), (config.width, config.height)
            view = gaussians.render(K, *size, captured.X_WC, 0.01, 1e10)
            depth = ranged_depth(view.depth, config.min_depth, config.max_depth)
            truth = sampled(captured.depth, captured.K, config)
            seen.append(DepthFrame(depth, truth))
    return frames


def sampled(depth: NDArray, K: NDArray, camera: OnboardCamera) -> NDArray[np.floating]:
    """The depth image (H, W) [m] of the intrinsics K (3, 3) [px] as `camera` would see it from the
    same place: the nearest pixel, NaN where that has no depth or the image ends."""
    slopes_C = camera.ray_slopes()
    u, v = (np.floor(slopes_C @ K[k]).astype(int) for k in (0, 1))
    height, width = depth.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    found = depth[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
    return np.where(inside & has_true_depth(found), found, np.nan)
