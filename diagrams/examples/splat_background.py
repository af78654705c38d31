"""Drake's bodies in a forest of Gaussians: a ball and a box, thrown across the view, bounce between
the trunks.

    python -m splatpilot.diagrams.examples.splat_background --out out/splat_background

Nothing here but `SplatRenderEngine` is particular to splats: a MultibodyPlant, a SceneGraph and
an RgbdSensor that names the renderer.
"""

import argparse
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    RenderCameraCore,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    MultibodyPlant,
)
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U, RgbdSensor

from splatpilot.diagrams.worlds.forest.config import ForestConfig
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.files import require_writable_folder, written_atomically
from splatpilot.systems.splats.splat_render_engine import SplatRenderEngine
from splatpilot.systems.visualization.video_recorder import colorize_depth

RADIUS = 0.35  # [m] of the ball, and half the edge of the box
MAX_DEPTH = 20.0  # [m]
RENDERER = "splats"

# Optical axes (x right, y down, z forward) in a body with x forward, y left, z up.
R_BC = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))


def BuildSplatBackgroundDiagram(world: World, width: int = 640, height: int = 480) -> Diagram:
    """A ball and a box above the ground of `world`, watched from its start by an RgbdSensor.

    The diagram exports the sensor's `color_image`, `depth_image_32f` and `label_image`; its systems
    are named `plant`, `scene_graph` and `camera`.

    Args:
        width, height: size of the images [pixels].
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    scene_graph.AddRenderer(RENDERER, SplatRenderEngine(world.baked, background=world.background))
    _add_bodies(plant)
    plant.Finalize()
    camera = _make_camera(world, width, height)
    builder.AddNamedSystem("camera", camera)
    builder.Connect(scene_graph.get_query_output_port(), camera.query_object_input_port())
    for name in ("color_image", "depth_image_32f", "label_image"):
        builder.ExportOutput(camera.GetOutputPort(name), name)
    return builder.Build()


def _add_bodies(plant: MultibodyPlant) -> None:
    friction = CoulombFriction(0.6, 0.5)
    # The ground is seen as Gaussians already: it needs to collide only.
    plant.RegisterCollisionGeometry(
        plant.world_body(),
        RigidTransform(np.array([0, 0, -0.5])),
        Box(200, 200, 1),
        "ground",
        friction,
    )
    for name, shape, inertia, color in (
        ("ball", Sphere(RADIUS), UnitInertia.SolidSphere(RADIUS), [0.85, 0.08, 0.05, 1]),
        ("box", Box(*[2 * RADIUS] * 3), UnitInertia.SolidCube(2 * RADIUS), [0.1, 0.25, 0.9, 1]),
    ):
        body = plant.AddRigidBody(name, SpatialInertia(1.0, np.zeros(3), inertia))
        plant.RegisterVisualGeometry(body, RigidTransform(), shape, name, np.array(color))
        plant.RegisterCollisionGeometry(body, RigidTransform(), shape, name, friction)


def _make_camera(world: World, width: int, height: int) -> RgbdSensor:
    core = RenderCameraCore(
        RENDERER,
        CameraInfo(width, height, fov_y=np.deg2rad(60)),
        ClippingRange(0.1, 100.0),
        RigidTransform(),
    )
    return RgbdSensor(
        parent_id=SceneGraph.world_frame_id(),
        X_PB=RigidTransform(R_BC, world.p_WS),
        color_camera=ColorRenderCamera(core),
        depth_camera=DepthRenderCamera(core, DepthRange(0.1, MAX_DEPTH)),
    )


def widest_lane(world: World, nearest: float, farthest: float, half_length: float) -> float:
    """The x [m], from `nearest` to `farthest` [m] beyond the start, at which a line along y, to
    `half_length` [m] on either side of the start, keeps the greatest distance from all surfaces."""
    x = world.p_WS[0] + np.arange(nearest, farthest, 0.1)
    y = world.p_WS[1] + np.arange(-half_length, half_length, 0.1)
    p_WQ = np.stack(np.meshgrid(x, y, [1.0], indexing="ij"), axis=-1)
    return float(x[world.distance_field.distance(p_WQ).min(axis=(1, 2)).argmax()])


def throw(diagram: Diagram, world: World) -> Simulator:
    """A simulator at the moment when ball and box leave the hand, on lanes at two distances."""
    simulator = Simulator(diagram)
    plant = diagram.GetSubsystemByName("plant")
    assert isinstance(plant, MultibodyPlant)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    for name, nearest, farthest, start, speed in (
        ("ball", 3.0, 6.0, 4.0, -4.0),
        ("box", 6.0, 11.0, -5.5, 8.0),
    ):
        lane = widest_lane(world, nearest, farthest, abs(start))
        body = plant.GetBodyByName(name)
        plant.SetFloatingBaseBodyPoseInWorldFrame(
            context, body, RigidTransform(np.array([lane, world.p_WS[1] + start, 1.0]))
        )
        velocity = SpatialVelocity(np.array([speed / 2, 0, 0.5]), np.array([0, speed, 3.0]))
        plant.SetFreeBodySpatialVelocity(context, body, velocity)
    return simulator


def run(*, out: Path, frames: int = 8, seconds: float = 2.1) -> None:
    """Writes `color_K.png` and `depth_K.png` for `frames` moments evenly spread over `seconds`.

    Raises:
        OSError: if `out` cannot be written.
    """
    require_writable_folder(out)
    world = make_world(ForestConfig(), 0)
    diagram = BuildSplatBackgroundDiagram(world)
    simulator = throw(diagram, world)
    for k, moment in enumerate(np.linspace(0, seconds, frames)):
        simulator.AdvanceTo(moment)
        context = simulator.get_context()
        color = cast(ImageRgba8U, diagram.GetOutputPort("color_image").Eval(context))
        depth = cast(ImageDepth32F, diagram.GetOutputPort("depth_image_32f").Eval(context))
        for name, picture in (
            (f"color_{k}.png", cv2.cvtColor(np.asarray(color.data), cv2.COLOR_RGBA2BGR)),
            (f"depth_{k}.png", colorize_depth(np.asarray(depth.data)[..., 0], MAX_DEPTH)),
        ):
            with written_atomically(out / name) as partial:
                if not cv2.imwrite(str(partial), picture):
                    raise OSError(f"{out / name}: OpenCV cannot write a PNG here")
    print(f"{frames} colour and depth images in {out}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Drake's bodies in a forest of Gaussians.")
    parser.add_argument("--out", type=Path, default=Path("out/splat_background"))
    run(out=parser.parse_args().out)
