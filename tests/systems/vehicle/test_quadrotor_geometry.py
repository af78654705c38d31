import numpy as np
import pytest
from pydrake.geometry import Box, GeometryInstance, ProximityProperties, RenderLabel, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.systems.framework import DiagramBuilder

from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, QuadrotorPlant, hover_state
from splatpilot.systems.vehicle.quadrotor_geometry import QuadrotorGeometry


def test_the_vehicle_is_seen_and_collides_in_a_scene_graph():
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    plant = builder.AddSystem(QuadrotorPlant(None, hover_state([1.0, 2.0, 3.0], yaw=0.5)))
    state = plant.GetOutputPort("state")
    first = QuadrotorGeometry.AddToBuilder(builder, state, scene_graph, label=RenderLabel(4))
    QuadrotorGeometry.AddToBuilder(builder, state, scene_graph, name="other")
    wall = GeometryInstance(RigidTransform([2.0, 2.0, 3.0]), Box(1, 1, 1), "wall")
    wall.set_proximity_properties(ProximityProperties())
    anchored = scene_graph.RegisterAnchoredGeometry(scene_graph.RegisterSource("wall"), wall)
    root = builder.Build().CreateDefaultContext()
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(root))
    X_WB = query.GetPoseInWorld(first.get_frame_id())
    np.testing.assert_allclose(X_WB.translation(), [1.0, 2.0, 3.0])
    assert X_WB.rotation().ToRollPitchYaw().yaw_angle() == pytest.approx(0.5)
    frame = first.get_frame_id()
    geometries = query.inspector().GetGeometries(frame)
    labels = [query.inspector().GetPerceptionProperties(id) for id in geometries]
    assert {int(p.GetProperty("label", "id")) for p in labels if p is not None} == {4}
    pairs = query.ComputeSignedDistancePairwiseClosestPoints()
    to_wall = [pair.distance for pair in pairs if anchored in (pair.id_A, pair.id_B)]
    assert to_wall == [pytest.approx(0.5 - VEHICLE_RADIUS)] * 2


def test_vehicles_pass_through_the_bodies_of_a_multibody_plant():
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform(), Box(1, 1, 1), "block", CoulombFriction()
    )
    plant.Finalize()
    vehicle = builder.AddSystem(QuadrotorPlant())  # at the origin, in the block
    QuadrotorGeometry.AddToBuilder(builder, vehicle.GetOutputPort("state"), scene_graph)
    root = builder.Build().CreateDefaultContext()
    results = plant.get_contact_results_output_port().Eval(plant.GetMyContextFromRoot(root))
    assert results.num_point_pair_contacts() == 0
