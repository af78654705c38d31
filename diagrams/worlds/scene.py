"""Scenes on disk as worlds: found by name, with start and goal drawn from the seed if wanted."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

from splatpilot.diagrams.worlds.scene_folder import read_scene
from splatpilot.diagrams.worlds.start_and_goal import SHORTEST, draw_start_and_goal
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.environment import require_scene
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS


@dataclass
class SceneSource:
    """A place on disk."""

    # A scene folder, or a file of Gaussians (PLY, SPZ or .splat); one that is not there is looked
    # for in the folder that the environment variable SPLATPILOT_SCENES names, or in `scenes`.
    path: str = ""
    # How to get the scene: what the error says if it is not there.
    source: str = ""
    # Whether start and goal are drawn from the seed; otherwise they are the scene's own.
    draw_ends: bool = False
    # [m] Least length of the shortest way between ends that are drawn.
    least_way: float = SHORTEST

    def validate(self) -> None:
        """
        Raises:
            ValueError: if no path is given, or the least way is negative or infinite.
        """
        if not self.path:
            raise ValueError("world.path is empty; name a scene folder or a file of Gaussians")
        if not 0 <= self.least_way < math.inf:
            raise ValueError(
                f"world.least_way is {self.least_way} m; it must be finite and at least 0"
            )


@dataclass
class SceneConfig(SceneSource):
    """A scene on disk. It is no base of others, for the reason that `ForestConfig` gives."""


def find_scene(config: SceneSource) -> Path:
    """The place of a scene.

    Raises:
        FileNotFoundError: if it is in none of the places where scenes are looked for; the message
            says how to get it.
    """
    config.validate()
    return require_scene(config.path, config.source)


def read_scene_world(config: SceneSource, seed: int) -> World:
    """Reads the scene of `config`.

    Raises:
        FileNotFoundError, ValueError: see `find_scene` and `read_scene`.
        InfeasibleFlightError: see `draw_start_and_goal`.
    """
    world = read_scene(find_scene(config))
    if not config.draw_ends:
        return world
    p_WS, p_WG, _ = draw_start_and_goal(world.esdf, VEHICLE_RADIUS, seed, least=config.least_way)
    return replace(world, p_WS=p_WS, p_WG=p_WG)
