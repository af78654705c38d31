"""Color images of many vehicles in training worlds, whose appearance changes while they fly."""

import os

import torch
from pydrake.math import RigidTransform, RotationMatrix
from torch import Tensor

from splatpilot.diagrams.worlds.appearance import randomize_appearance
from splatpilot.diagrams.worlds.world_registry import make_world, scene_config
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.baked_scene import BatchRenderer
from splatpilot.systems.splats.splat_camera import color_pixels
from splatpilot.training.corpus import library
from splatpilot.training.policies.evaluation import camera_poses
from splatpilot.training.policies.training_worlds import WorldSelection, world_turns
from splatpilot.training.policies.vehicles import Vehicle


class WorldViews:
    """The Gaussians of the worlds of a `WorldBatch`, seen by the vehicles' cameras.

    Args:
        count, first: number of worlds, and the seed of the first, as in `training_worlds`.
        camera: its `merged_spread` may be larger in training than in flight.
    """

    def __init__(
        self, selection: WorldSelection, count: int, first: int, camera: OnboardCamera
    ) -> None:
        scenes = {
            scene: make_world(scene_config(library.training_scene(scene)), seed=0)
            for scene in selection.scenes
        }
        turns = Progress(world_turns(selection, count, first), "rendering worlds", unit="world")
        self._worlds = [
            scenes.get(turn) or make_world(library.scenario_world(turn), seed)
            for seed, turn in turns
        ]
        self._seen = list(self._worlds)
        # (W, 2), seed and strength of each appearance; a strength of 0 is the world's own.
        self.looks = torch.zeros(count, 2, dtype=torch.float64)
        self._camera, self._renderer = camera, BatchRenderer(os.cpu_count() or 1)

    def repaint(self, strength: float, generator: torch.Generator) -> None:
        """Gives a random world another appearance, of a strength up to `strength`."""
        drawn = torch.rand(3, generator=generator, dtype=torch.float64, device=generator.device)
        world, seed, part = drawn.tolist()
        index = int(world * len(self._worlds))
        self.looks[index, 0], self.looks[index, 1] = int(seed * 2**31), part * strength
        self._paint(index)

    def restore(self, looks: Tensor) -> None:
        """Restores the appearances `looks`."""
        self.looks = looks
        for index in looks[:, 1].nonzero()[:, 0].tolist():
            self._paint(index)

    def _paint(self, index: int) -> None:
        seed, strength = self.looks[index].tolist()
        self._seen[index] = randomize_appearance(self._worlds[index], strength, int(seed))

    @torch.no_grad()
    def render(self, vehicle: Vehicle, world: Tensor) -> Tensor:
        """Renders colors (N, H, W, 3), uint8, from the vehicles' cameras, each in its `world`
        (N,)."""
        poses = (part.double().cpu().numpy() for part in camera_poses(vehicle))
        X_WCs = [
            RigidTransform(RotationMatrix.ProjectToRotationMatrix(R_WC), p_WC)
            for p_WC, R_WC in zip(*poses, strict=True)
        ]
        worlds = [self._seen[index] for index in world.tolist()]
        info = self._camera.camera_info()
        color = self._renderer.render_color(
            [world.baked for world in worlds],
            info.intrinsic_matrix(),
            info.width(),
            info.height(),
            X_WCs,
            backgrounds=[world.background for world in worlds],
            merged_spread=self._camera.merged_spread,
        )
        return torch.from_numpy(color_pixels(color)).to(world.device)
