import numpy as np
import pytest
from baked_scenes import moving, wall
from pydrake.common.value import Value
from pydrake.geometry import RenderLabel
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.sensors import CameraInfo

from splatpilot.systems.collision.esdf_collision import EsdfCollision
from splatpilot.systems.collision.shapes import (
    AnalyticDistanceField,
    FieldWithSpheres,
    HalfSpace,
)
from splatpilot.systems.splats.moving_bodies import Bodies, MovingBodies, Track
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS, hover_state
from splatpilot.systems.vehicle.quadrotor_geometry import quadrotor_gaussians

R_BC = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
INFO = CameraInfo(64, 48, 60.0, 60.0, 32.0, 24.0)
FIELD = AnalyticDistanceField([HalfSpace([0, 0, 1], -50.0)], np.full(3, -60.0), np.full(3, 60.0))


@pytest.fixture(scope="module")
def evaluate():
    """Evaluates a port of a camera or a distance at the origin, with a body at a pose."""
    builder = DiagramBuilder()
    others = builder.AddSystem(MovingBodies())
    camera = builder.AddSystem(SplatCamera(wall(0, 5.0, reach=20.0), INFO, RigidTransform(R_BC)))
    collision = builder.AddSystem(EsdfCollision(FIELD))
    pose = others.DeclareBody("other", quadrotor_gaussians(), VEHICLE_RADIUS)
    for system in (camera, collision):
        builder.Connect(others.moving_output_port(), system.GetInputPort("moving"))
    builder.ExportInput(pose, "other")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    for system, name, value in (
        (camera, "body_pose", RigidTransform()),
        (collision, "state", hover_state([0.0, 0.0, 0.0])),
    ):
        system.GetInputPort(name).FixValue(system.GetMyContextFromRoot(context), value)

    def evaluated(X_WO: RigidTransform, port: str):
        diagram.GetInputPort("other").FixValue(context, X_WO)
        system = camera if camera.HasOutputPort(port) else collision
        return system.GetOutputPort(port).Eval(system.GetMyContextFromRoot(context))

    return evaluated


@pytest.mark.parametrize(("x", "collides"), [(2.0, False), (0.7, True)])
def test_a_body_with_a_pose_is_seen_labeled_and_hit(evaluate, x, collides):
    X_WO = RigidTransform(RotationMatrix.MakeYRotation(np.pi / 2), [x, 0.0, 0.0])
    depth = evaluate(X_WO, "depth_image_32f").data[..., 0]
    labels = evaluate(X_WO, "label_image").data[..., 0]
    assert depth[24, 32] == pytest.approx(x - 0.1 * VEHICLE_RADIUS, abs=0.1)
    assert depth[0, 0] == pytest.approx(5.0, abs=0.01)
    shown = depth < 4.0
    assert shown.sum() > 40
    np.testing.assert_array_equal(labels == 0, shown)
    assert (labels[~shown] == int(RenderLabel.kUnspecified)).all()
    assert evaluate(X_WO, "distance")[0] == pytest.approx(x - VEHICLE_RADIUS)
    assert evaluate(X_WO, "in_collision")[0] == collides


def test_a_body_behind_a_surface_has_no_label(evaluate):
    labels = evaluate(RigidTransform([6.0, 0.0, 0.0]), "label_image").data
    assert (labels == int(RenderLabel.kUnspecified)).all()


class Flyby(LeafSystem):
    def __init__(self):
        super().__init__()
        self.DeclareAbstractOutputPort("pose", lambda: Value(RigidTransform()), self._calc)

    def _calc(self, context, output):
        time = context.get_time()
        output.set_value(RigidTransform(np.array([2.0 * time, 0.0, time])))


def test_poses_are_remembered_and_predicted():
    builder = DiagramBuilder()
    source, others = builder.AddSystem(Flyby()), builder.AddSystem(MovingBodies())
    pose = others.DeclareBody("other", quadrotor_gaussians(), 0.3)
    builder.Connect(source.get_output_port(), pose)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(2.513)
    context = others.GetMyContextFromRoot(simulator.get_context())
    bodies = others.GetOutputPort("moving").Eval(context)
    assert bodies.time == 2.513
    for time in (0.6, 1.333, 2.513, 3.7):
        np.testing.assert_allclose(bodies.centers(time), [[2.0 * time, 0.0, time]], atol=1e-9)
    np.testing.assert_array_equal(bodies.centers(-1.0), bodies.centers(0.0))
    for time in 0.1 * np.arange(1, 13) + 2.6:  # close to the times of samples, which are rounded
        simulator.AdvanceTo(time)
        bodies = others.GetOutputPort("moving").Eval(context)
        np.testing.assert_allclose(bodies.centers(5.0), [[10.0, 0.0, 5.0]], atol=1e-6)


def test_obstacles_and_bodies_are_together():
    obstacles = moving(quadrotor_gaussians(), [[0.0, 3.0, 0.0], [1.0, 3.0, 0.0]])
    both = obstacles.merged_with(moving(quadrotor_gaussians(), [[0.0, -3.0, 0.0]], radius=0.25))
    row = [0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    bodies = Bodies(1.0, both, (Track(quadrotor_gaussians(), 0.3, np.array([row])),))
    np.testing.assert_array_equal(bodies.centers(1.0), [[1, 3, 0], [0, -3, 0], [1, 0, 0]])
    np.testing.assert_array_equal(bodies.radii, [0.5, 0.25, 0.3])
    assert len(bodies.gaussians(1.0).means) == 3 * len(quadrotor_gaussians())
    times = np.array([0.0, 1.0])
    distances = bodies.along(FIELD, times).distance(np.zeros((1, 2, 3)))
    np.testing.assert_allclose(distances, [[0.7, 0.7]])
    seen = FieldWithSpheres(FIELD, np.zeros((1, 3)), np.zeros(1))  # a radius of 0 is none
    np.testing.assert_array_equal(seen.distance(np.ones(3)), FIELD.distance(np.ones(3)))


def test_invalid_bodies_are_refused():
    others = MovingBodies()
    others.DeclareBody("a", quadrotor_gaussians(), 0.3)
    for radius, message in ((-1, r"in \[0, inf\) m, got -1"), (0.3, "new among .* got 'a'")):
        with pytest.raises(ValueError, match=message):
            others.DeclareBody("a", quadrotor_gaussians(), radius)


def test_the_quadrotor_of_gaussians_fits_its_sphere():
    gaussians = quadrotor_gaussians()
    assert 200 < len(gaussians) < 700
    extent = np.linalg.norm(gaussians.means, axis=1).max()
    assert 0.9 * VEHICLE_RADIUS < extent < VEHICLE_RADIUS + 0.01
