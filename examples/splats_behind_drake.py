"""Splats behind an existing Drake simulation: one line adds a scene to its camera images.

    python examples/splats_behind_drake.py --out out/sphere.png

A sphere of Drake's MultibodyPlant flies through a forest of Gaussians, and an RgbdSensor sees both:
trunks hide the sphere, and the sphere hides trunks. Only the line `AddRenderer` is about splats.
RenderEngineVtk draws shapes and needs OpenGL (see docs/troubleshooting.md).
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image
from pydrake.geometry import (
    ClippingRange,
    DepthRange,
    DepthRenderCamera,
    RenderCameraCore,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo, RgbdSensor

import splatpilot as sp


def main(out: Path, width: int, seconds: float) -> None:
    scenario = sp.load_config(sp.Scenario(), overrides=["world.length=12"])
    world = sp.make_world(scenario.world, seed=0)

    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    body = plant.AddRigidBody("sphere", SpatialInertia.SolidSphereWithMass(1.0, 0.2))
    red = np.array([0.8, 0.1, 0.1, 1.0])
    plant.RegisterVisualGeometry(body, RigidTransform(), Sphere(0.2), "sphere", red)
    plant.Finalize()

    splats = sp.SplatRenderEngine(world.baked, background=world.background)
    scene_graph.AddRenderer("splats", splats)

    intrinsics = CameraInfo(width, width * 3 // 4, fov_y=np.deg2rad(60))
    core = RenderCameraCore("splats", intrinsics, ClippingRange(0.1, 100), RigidTransform())
    # Optical axes (x right, y down, z forward) of a camera that looks along x of the world.
    R_WC = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
    X_WC = RigidTransform(R_WC, world.p_WS)
    sees = DepthRenderCamera(core, DepthRange(0.1, 20.0))  # and colors, by the same camera
    camera = builder.AddSystem(RgbdSensor(SceneGraph.world_frame_id(), X_WC, sees))
    builder.Connect(scene_graph.get_query_output_port(), camera.query_object_input_port())
    simulator = Simulator(builder.Build())

    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    p_WB, v_WB = world.p_WS + np.array([4.0, 2.5, -0.5]), [0.0, -3.0, 4.0]
    plant.SetFloatingBaseBodyPoseInWorldFrame(context, body, RigidTransform(p_WB))
    plant.SetFreeBodySpatialVelocity(context, body, SpatialVelocity(np.zeros(3), v_WB))
    simulator.AdvanceTo(seconds)
    context = camera.GetMyContextFromRoot(simulator.get_context())
    image = camera.color_image_output_port().Eval(context).data
    depth = camera.depth_image_32F_output_port().Eval(context).data
    Image.fromarray(image[..., :3]).save(out)
    print(f"Wrote {out}; the nearest surface in it is {depth.min():.2f} m away.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("sphere.png"))
    parser.add_argument("--width", type=int, default=640, help="of the image [px]")
    parser.add_argument("--seconds", type=float, default=0.5, help="until it is taken")
    main(**vars(parser.parse_args()))
