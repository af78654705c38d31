"""A flight in Meshcat: the world, the goal, the vehicle, its plans and what its camera sees."""

from typing import cast

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.framework import DiagramBuilder

from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.splats.background import mean_color
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from splatpilot.systems.visualization.balls_visualizer import BallsVisualizer
from splatpilot.systems.visualization.camera_visualizer import CameraVisualizer
from splatpilot.systems.visualization.drawing import (
    draw_distance_slice,
    draw_gaussians,
    draw_goal,
    draw_vehicle,
)
from splatpilot.systems.visualization.flight_visualizer import FlightVisualizer


def AddMeshcat(
    builder: DiagramBuilder,
    scenario: Scenario,
    world: World,
    p_WG: NDArray[np.float64],
    meshcat: Meshcat,
) -> None:
    """
    Draws what stands still, and adds the systems that draw what moves.

    Args:
        builder: of a flight with `plant`, `policy` and `camera`.
        scenario, world: what is flown.
        p_WG: (3,) [m] the goal.
        meshcat: where.
    """
    field = world.distance_field
    margin = np.array([5.0, 5.0, 3.0])  # [m] of surroundings that are drawn too.
    for end in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background", end, list(mean_color(world.background)))
    draw_gaussians(
        meshcat,
        "/splatpilot/scene",
        world.gaussians,
        field.lower_W - margin,
        field.upper_W + margin,
    )
    draw_goal(meshcat, "/splatpilot/goal", p_WG, scenario.goal_radius)
    draw_vehicle(meshcat, "/splatpilot/vehicle", VEHICLE_RADIUS)
    draw_distance_slice(meshcat, "/splatpilot/distance_slice", field, float(p_WG[2]))
    meshcat.SetProperty("/splatpilot/distance_slice", "visible", False)

    plant, policy = (builder.GetSubsystemByName(name) for name in ("plant", "policy"))
    plans = policy.HasOutputPort("hypotheses")
    FlightVisualizer.AddToBuilder(
        builder,
        plant.GetOutputPort("state"),
        meshcat,
        policy.GetOutputPort("hypotheses") if plans else None,
    )
    if world.moving:
        BallsVisualizer.AddToBuilder(builder, world.moving.balls, meshcat)
    camera = cast(SplatCamera, builder.GetSubsystemByName("camera"))
    CameraVisualizer.AddToBuilder(builder, camera, meshcat, period=1 / scenario.camera.fps)
