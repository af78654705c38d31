"""From a scenario's `world` field to the world."""

from dataclasses import dataclass

from flysplat.diagrams.worlds.forest import ForestConfig, make_forest
from flysplat.diagrams.worlds.scene_folder import read_scene
from flysplat.diagrams.worlds.world import World


@dataclass
class SceneConfig:
    """A scene on disk."""

    # A scene folder, or a PLY file of Gaussians.
    path: str = ""

    def validate(self) -> None:
        """
        Raises:
            ValueError: if no path is given.
        """
        if not self.path:
            raise ValueError("world.path is empty; name a scene folder or a PLY file")


WorldConfig = ForestConfig | SceneConfig


def make_world(config: WorldConfig, seed: int) -> World:
    """
    Generates or reads the world that `config` describes.

    Args:
        config: which kind of world, and its parameters.
        seed: of what is random in a generated world; nothing is random in a scene on disk.

    Raises:
        ValueError: for parameters no world can be made of, and for damaged scenes.
        FileNotFoundError: for a scene that is not there.
    """
    match config:
        case ForestConfig():
            return make_forest(config, seed)
        case SceneConfig():
            return read_scene(config.path)
