"""From a scenario's `world` field to the world."""

from splatpilot.diagrams.worlds.branches import Branches, BranchesConfig
from splatpilot.diagrams.worlds.clutter import ClutterConfig, clutter_blueprint
from splatpilot.diagrams.worlds.forest.forest import Forest, ForestConfig
from splatpilot.diagrams.worlds.inserted import InsertedConfig, inserted_world
from splatpilot.diagrams.worlds.octomap_world import OctomapConfig, octomap_world
from splatpilot.diagrams.worlds.over_under import OverUnderConfig, over_under_blueprint
from splatpilot.diagrams.worlds.room import RoomConfig, room_blueprint
from splatpilot.diagrams.worlds.scene import SceneConfig, read_scene_world
from splatpilot.diagrams.worlds.solids.blueprint import Blueprint
from splatpilot.diagrams.worlds.solids.surfaces import merged
from splatpilot.diagrams.worlds.solids.surfels import draw
from splatpilot.diagrams.worlds.walls import WallsConfig, walls_blueprint
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field

ProceduralConfig = (
    ForestConfig | BranchesConfig | ClutterConfig | WallsConfig | RoomConfig | OverUnderConfig
)
WorldConfig = (
    ForestConfig
    | BranchesConfig
    | ClutterConfig
    | WallsConfig
    | RoomConfig
    | OverUnderConfig
    | SceneConfig
    | InsertedConfig
    | OctomapConfig
)


def make_world(config: WorldConfig, seed: int) -> World:
    """
    Generates or reads the world that `config` describes.

    Args:
        config: which kind of world, and its parameters.
        seed: of what is random: generated worlds, what is put into scenes, and start and goal where
            they are drawn.

    Raises:
        ValueError: for parameters no world can be made of, and for damaged scenes.
        FileNotFoundError: for a scene that is not there.
    """
    match config:
        case InsertedConfig():
            return inserted_world(config, seed)
        case OctomapConfig():
            return octomap_world(config, seed)
        case SceneConfig():
            return read_scene_world(config, seed)
        case BranchesConfig():
            return Branches(config, seed).world()
        case ForestConfig():
            return Forest(config, seed).world()
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
        case BranchesConfig():
            return Branches(config, seed).blueprint()
        case ForestConfig():
            return Forest(config, seed).blueprint()
        case ClutterConfig():
            return clutter_blueprint(config, seed)
        case WallsConfig():
            return walls_blueprint(config, seed)
        case RoomConfig():
            return room_blueprint(config, seed)
        case OverUnderConfig():
            return over_under_blueprint(config, seed)


def build(blueprint: Blueprint) -> World:
    """Draws a blueprint's Gaussians and samples its distance grid."""
    field = blueprint.distance_field
    esdf = esdf_from_distance_field(field, blueprint.voxel_size)
    light = blueprint.light(esdf)
    drawn = [draw(blueprint, blueprint.solids, light), *blueprint.surroundings()]
    return World(
        name=blueprint.name,
        gaussians=merged(drawn),
        distance_field=field,
        esdf=esdf,
        background=(float(light.haze[0]), float(light.haze[1]), float(light.haze[2])),
        p_WS=blueprint.p_WS,
        p_WG=blueprint.p_WG,
    )
