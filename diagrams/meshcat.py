"""A flight in Meshcat: the world, the goal, the vehicle, its plans and what its camera sees."""

from typing import cast

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.framework import DiagramBuilder

from splatpilot.diagrams.pilot import goal_of
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.splats.background import Background, mean_color
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


def empty_meshcat(background: Background) -> Meshcat:
    """A Meshcat in which nothing stands before the background."""
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    for end in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background/<object>", end, list(mean_color(background)))
    return meshcat


def open_meshcat(scenario: Scenario, world: World) -> Meshcat:
    """
    A Meshcat that shows what stands still: goal, distance field and background.

    Its camera sees the start and the goal from behind and above the start.
    """
    meshcat = empty_meshcat(world.background)
    p_WG = goal_of(scenario, world)
    draw_goal(meshcat, "/splatpilot/goal", p_WG, scenario.goal_radius)
    draw_distance_slice(meshcat, "/splatpilot/distance_slice", world.distance_field, float(p_WG[2]))
    meshcat.SetProperty("/splatpilot/distance_slice", "visible", False)

    p_WS = np.asarray(world.p_WS if scenario.start is None else scenario.start, dtype=float)
    p_SG_W = p_WG - p_WS
    distance = max(float(np.linalg.norm(p_SG_W)), 1e-6)
    eye = p_WS - 0.2 * p_SG_W + [0.0, 0.0, 3.0 + 0.35 * distance]
    meshcat.SetCameraPose(eye, p_WS + 0.4 * p_SG_W)
    return meshcat


def AddMeshcat(builder: DiagramBuilder, scenario: Scenario, world: World, meshcat: Meshcat) -> None:
    """
    Draws the world's Gaussians and the vehicle, and adds the systems that draw what moves.

    Args:
        builder: of a flight with `plant`, `policy` and `camera`.
        scenario, world: what is flown.
        meshcat: where, as `open_meshcat` has made it.
    """
    field = world.distance_field
    margin = np.array([5.0, 5.0, 3.0])  # [m] of surroundings that are drawn too.
    draw_gaussians(
        meshcat,
        "/splatpilot/scene",
        world.gaussians,
        field.lower_W - margin,
        field.upper_W + margin,
    )
    draw_vehicle(meshcat, "/splatpilot/vehicle", VEHICLE_RADIUS)

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
