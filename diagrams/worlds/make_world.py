"""From a scenario's `world` field to the world."""

from dataclasses import dataclass

from flysplat.diagrams.worlds.blueprint import Blueprint
from flysplat.diagrams.worlds.forest import Forest, ForestConfig, make_forest
from flysplat.diagrams.worlds.scene_folder import read_scene
from flysplat.diagrams.worlds.solid_surfels import draw
from flysplat.diagrams.worlds.walls import WallsConfig, walls_blueprint
from flysplat.diagrams.worlds.world import World
from flysplat.systems.collision.esdf_build import esdf_from_distance_field


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


ProceduralConfig = ForestConfig | WallsConfig
WorldConfig = ForestConfig | WallsConfig | SceneConfig


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
        case _:
            return build(make_blueprint(config, seed))


def make_blueprint(config: ProceduralConfig, seed: int) -> Blueprint:
    """
    Generates a procedural world as solids, start and goal, without Gaussians and grids: cheap.
    `write_gltf` exports it as a mesh, `make_world` of the same arguments gives the same place.

    Raises:
        ValueError: for parameters no world can be made of.
    """
    match config:
        case ForestConfig():
            return Forest(config, seed).blueprint()
        case WallsConfig():
            return walls_blueprint(config, seed)


def build(blueprint: Blueprint) -> World:
    """Draws a blueprint's Gaussians and samples its distance grid."""
    field = blueprint.distance_field
    esdf = esdf_from_distance_field(field, blueprint.voxel_size)
    light = blueprint.light(esdf)
    return World(
        name=blueprint.name,
        gaussians=draw(blueprint, light),
        distance_field=field,
        esdf=esdf,
        background=(float(light.haze[0]), float(light.haze[1]), float(light.haze[2])),
        p_WS=blueprint.p_WS,
        p_WG=blueprint.p_WG,
    )
