"""Geometry of the quadrotor, for SceneGraph, Meshcat and cameras of Gaussians."""

from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.geometry import (
    Box,
    Cylinder,
    FrameId,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    IllustrationProperties,
    PerceptionProperties,
    ProximityProperties,
    RenderLabel,
    Rgba,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort

from splatpilot.systems.common.drake import vector_input, weak_callback
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import pose_from_state


class Part(NamedTuple):
    """A solid of the vehicle at X_BP."""

    name: str
    shape: Box | Cylinder
    X_BP: RigidTransform
    color: Rgba


def quadrotor_parts(radius: float = VEHICLE_RADIUS) -> list[Part]:
    """Returns the parts of a quadrotor whose propeller tips reach `radius` [m].

    Frame B: x forward, z up.
    """
    propeller = 0.36 * radius
    arm = radius - propeller
    dark, front, rear = Rgba(0.1, 0.1, 0.12), Rgba(0.9, 0.2, 0.1, 0.6), Rgba(0.3, 0.3, 0.35, 0.6)
    body = Box(0.5 * radius, 0.35 * radius, 0.2 * radius)
    parts = [Part("body", body, RigidTransform(), dark)]
    for name, angle, color in (
        ("front_left", np.pi / 4, front),
        ("rear_left", 3 * np.pi / 4, rear),
        ("rear_right", -3 * np.pi / 4, rear),
        ("front_right", -np.pi / 4, front),
    ):
        R_BA = RotationMatrix.MakeZRotation(angle)
        X_BP = RigidTransform(R_BA, R_BA @ [arm / 2, 0, 0])
        parts.append(Part(f"{name}_arm", Box(arm, 0.02, 0.02), X_BP, dark))
        X_BP = RigidTransform(R_BA @ np.array([arm, 0, 0.03]))
        parts.append(Part(f"{name}_propeller", Cylinder(propeller, 0.01), X_BP, color))
    return parts


_SPACING = 0.03  # [m] between Gaussians on a surface
_THICKNESS = 0.002  # [m], standard deviation across a surface


@cache
def quadrotor_gaussians(radius: float = VEHICLE_RADIUS) -> GaussianScene:
    """Returns the surfaces of a quadrotor, with discs for its rotors, as Gaussians in frame B."""
    means, quats, scales, colors = [], [], [], []
    for part in quadrotor_parts(radius):
        for X_PF, points, sigma in _faces(part.shape):
            X_BF = part.X_BP @ X_PF
            means.append(X_BF.multiply(points.T).T)
            quats.append(np.tile(X_BF.rotation().ToQuaternion().wxyz(), (len(points), 1)))
            scales.append(np.tile([*sigma, _THICKNESS], (len(points), 1)))
            color = [part.color.r(), part.color.g(), part.color.b()]
            colors.append(np.tile(color, (len(points), 1)))
    p_BQ, q_BQ, sigmas, rgb = map(np.concatenate, (means, quats, scales, colors))
    return GaussianScene.from_colors(p_BQ, q_BQ, sigmas, np.full(len(p_BQ), 0.95), rgb)


def _faces(
    shape: Box | Cylinder,
) -> Iterator[tuple[RigidTransform, NDArray[np.float64], NDArray[np.float64]]]:
    """Yields the pose of each face, points (n, 3) [m] in its xy plane and their spread (2,) [m].

    A cylinder has one face, a disc.
    """
    if isinstance(shape, Cylinder):
        points, sigma = _grid(np.full(2, 2.0 * shape.radius()))
        yield RigidTransform(), points[np.linalg.norm(points, axis=1) < shape.radius()], sigma
        return
    size = np.asarray(shape.size())
    for axis in range(3):
        points, sigma = _grid(np.delete(np.roll(size, -axis - 1), 2))
        for side in (-0.5, 0.5):
            # Cyclic permutations turn z into the axis.
            R_PF = RotationMatrix(np.roll(np.eye(3), axis + 1, axis=0))
            yield RigidTransform(R_PF, side * size * np.eye(3)[axis]), points, sigma


def _grid(size: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the middles (n, 3) of the cells of a rectangle in xy, and their spread (2,) [m]."""
    counts = np.maximum(1, np.ceil(size / _SPACING)).astype(int)
    x, y = (
        (np.arange(count) + 0.5 - count / 2) * length / count
        for count, length in zip(counts, size, strict=True)
    )
    points = np.stack(np.meshgrid(x, y, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    return points, 0.5 * size / counts


class QuadrotorGeometry(LeafSystem):
    """Outputs the pose of a quadrotor's frame for a SceneGraph, as Drake's class of that name.

    .. pydrake_system::

        name: QuadrotorGeometry
        input_ports: [state]
        output_ports: [geometry_pose]

    - ``state`` (13): that of `QuadrotorPlant`.
    """

    def __init__(self, frame: FrameId) -> None:
        super().__init__()
        self._frame = frame
        state = self.DeclareVectorInputPort("state", 13)
        self.DeclareAbstractOutputPort(
            "geometry_pose",
            lambda: Value(FramePoseVector()),
            weak_callback(self._calc),
            {state.ticket()},
        )

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        state_port: OutputPort,
        scene_graph: SceneGraph,
        name: str = "quadrotor",
        label: RenderLabel | None = None,
        radius: float = VEHICLE_RADIUS,
    ) -> "QuadrotorGeometry":
        """Registers the vehicle and adds the system of its pose, both named `name`.

        Renderers and viewers show `quadrotor_parts`. Contacts and distances are those of a sphere,
        which is left out beside a MultibodyPlant in the builder: it refuses contacts with others.

        Args:
            label: of the vehicle in label images; `RenderLabel.kDontCare` if None.
            radius: of the vehicle [m].
        """
        source = scene_graph.RegisterSource(name)
        frame = scene_graph.RegisterFrame(source, GeometryFrame(name))
        for part in quadrotor_parts(radius):
            geometry = GeometryInstance(part.X_BP, part.shape, part.name)
            perception, illustration = PerceptionProperties(), IllustrationProperties()
            for properties in (perception, illustration):
                properties.AddProperty("phong", "diffuse", part.color)
            perception.AddProperty("label", "id", label or RenderLabel.kDontCare)
            geometry.set_perception_properties(perception)
            geometry.set_illustration_properties(illustration)
            scene_graph.RegisterGeometry(source, frame, geometry)
        sphere = GeometryInstance(RigidTransform(), Sphere(radius), "collision")
        sphere.set_proximity_properties(ProximityProperties())
        if not any(isinstance(system, MultibodyPlant) for system in builder.GetSystems()):
            scene_graph.RegisterGeometry(source, frame, sphere)
        system = QuadrotorGeometry(frame)
        builder.AddNamedSystem(name, system)
        builder.Connect(state_port, system.GetInputPort("state"))
        builder.Connect(system.get_output_port(), scene_graph.get_source_pose_port(source))
        return system

    def get_frame_id(self) -> FrameId:
        """Returns the frame B of the vehicle in SceneGraph."""
        return self._frame

    def _calc(self, context, output) -> None:
        pose = pose_from_state(vector_input(self, "state", context))
        output.get_mutable_value().set_value(self._frame, pose)
