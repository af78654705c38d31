"""Blueprints made into worlds."""

from splatpilot.diagrams.worlds.solids.blueprint import Blueprint
from splatpilot.diagrams.worlds.solids.surfaces import merge
from splatpilot.diagrams.worlds.solids.surfels import draw
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field


def build(blueprint: Blueprint) -> World:
    """Draws a blueprint's Gaussians and samples its distance grid."""
    field = blueprint.distance_field
    esdf = esdf_from_distance_field(field, blueprint.voxel_size)
    light = blueprint.light(esdf)
    if blueprint.gaussians is not None:
        gaussians = blueprint.gaussians(light)
    else:
        solids = draw(blueprint, blueprint.solids, light)
        gaussians = merge([solids, *blueprint.surroundings()])
    return World(
        name=blueprint.name,
        gaussians=gaussians,
        distance_field=field,
        esdf=esdf,
        background=(float(light.haze[0]), float(light.haze[1]), float(light.haze[2])),
        p_WS=blueprint.p_WS,
        p_WG=blueprint.p_WG,
    )
