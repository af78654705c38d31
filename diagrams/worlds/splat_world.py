"""AddSplatWorld: a world of Gaussians in a SceneGraph."""

from pydrake.geometry import SceneGraph
from pydrake.systems.framework import DiagramBuilder

from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.splats.render_engine import ObstacleGeometry, SplatRenderEngine


def AddSplatWorld(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    world: World,
    renderer_name: str = "splats",
) -> None:
    """Adds a renderer of the world's Gaussians, sky and moving obstacles to a SceneGraph.

    Cameras of the renderer show the SceneGraph's shapes among the Gaussians, see
    `SplatRenderEngine`. The world is static for contacts and distances of the SceneGraph.
    """
    engine = SplatRenderEngine(world.baked, background=world.background)
    scene_graph.AddRenderer(renderer_name, engine)
    if world.moving is not None:
        name = f"{renderer_name}_obstacles"
        ObstacleGeometry.AddToBuilder(builder, scene_graph, world.moving, name)
