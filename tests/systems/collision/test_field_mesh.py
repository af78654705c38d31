import numpy as np
import pytest
import trimesh
from pydrake.geometry import GeometryInstance, Mesh, ProximityProperties, SceneGraph
from pydrake.math import RigidTransform

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.field_mesh import field_mesh, write_mesh

LOWER, VOXEL, SHAPE = np.array([-1.0, -2.0, 0.5]), 0.1, (30, 36, 24)
CENTER, RADIUS = np.array([0.4, -0.3, 1.95]), 0.7


def field(distance, unknown=None) -> Esdf:
    p_WQ = LOWER + VOXEL * (np.moveaxis(np.indices(SHAPE), 0, -1) + 0.5)
    distances = distance(p_WQ).astype(np.float32)
    states = np.where(distances > 0, FieldState.FREE, FieldState.OCCUPIED).astype(np.uint8)
    if unknown is not None:
        states[unknown(p_WQ)] = FieldState.UNKNOWN
    return Esdf(distances, states, LOWER, VOXEL)


def sphere(p_WQ):
    return np.linalg.norm(p_WQ - CENTER, axis=-1) - RADIUS


def floor(p_WQ):
    """A floor that is 1 m high and slightly tilted."""
    return (p_WQ @ [0.05, 0.1, 1.0] - 1.0) / np.linalg.norm([0.05, 0.1, 1.0])


def drakes_distances(path, p_WQ) -> np.ndarray:
    scene_graph = SceneGraph()
    source = scene_graph.RegisterSource("test")
    instance = GeometryInstance(RigidTransform(), Mesh(path), "mesh")
    geometry = scene_graph.RegisterAnchoredGeometry(source, instance)
    scene_graph.AssignRole(source, geometry, ProximityProperties())
    query = scene_graph.get_query_output_port().Eval(scene_graph.CreateDefaultContext())
    return np.array([query.ComputeSignedDistanceToPoint(p)[0].distance for p in p_WQ])


@pytest.mark.parametrize(("conservative", "within"), [(False, 0.5), (True, 0.85)])
def test_drakes_distances_are_the_fields(tmp_path, conservative, within):
    esdf = field(
        lambda p: np.minimum(sphere(p), floor(p)),
        unknown=lambda p: (p[..., 0] > 1.5) & (p[..., 2] > 1.3),
    )
    path = tmp_path / "scene.obj"
    write_mesh(path, field_mesh(esdf, conservative))
    p_WQ = np.random.default_rng(0).uniform(LOWER + 0.1, esdf.upper_W - 0.1, (3000, 3))
    expected = (esdf.conservative() if conservative else esdf).distance(p_WQ)
    near = np.abs(expected) < VOXEL
    assert near.sum() > 200
    error = np.abs(drakes_distances(path, p_WQ[near]) - expected[near]) / VOXEL
    assert error.max() < within
    assert np.quantile(error, 0.95) < 0.5


def test_what_is_solid_ends_at_the_box():
    esdf = field(floor)
    mesh = field_mesh(esdf)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds[0], LOWER, atol=0.1 * VOXEL)
    np.testing.assert_allclose(mesh.bounds[1][:2], esdf.upper_W[:2], atol=0.1 * VOXEL)
    free = np.prod(esdf.upper_W - LOWER) - mesh.volume
    shell = field_mesh(esdf, conservative=True)
    assert shell.is_watertight
    np.testing.assert_allclose(shell.bounds, [LOWER - VOXEL, esdf.upper_W + VOXEL], atol=1e-6)
    solid = np.prod(np.ptp(shell.bounds, axis=0)) - shell.volume
    assert solid == pytest.approx(free, rel=0.02)


@pytest.mark.parametrize(("name", "axes"), [("a.obj", ([0, 1, 2], 1)), ("a.gltf", ([0, 2, 1], -1))])
def test_mesh_of_a_sphere_keeps_its_shape_in_files_that_others_read(tmp_path, name, axes):
    mesh = field_mesh(field(sphere))
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)
    assert np.abs(sphere(mesh.vertices)).max() < 0.3 * VOXEL
    assert len(mesh.faces) < 2 * 4 * np.pi * RADIUS**2 / VOXEL**2
    write_mesh(tmp_path / name, mesh)
    again = (tmp_path / name).read_bytes()
    write_mesh(tmp_path / name, field_mesh(field(sphere)))
    assert (tmp_path / name).read_bytes() == again
    read = trimesh.load(tmp_path / name, force="mesh")
    center = CENTER[axes[0]] * [1, 1, axes[1]]
    np.testing.assert_allclose(read.bounds.mean(axis=0), center, atol=0.02)
    assert len(read.faces) == len(mesh.faces)
    assert read.volume == pytest.approx(mesh.volume, rel=1e-3)
    assert [file.name for file in tmp_path.iterdir()] == [name]
    with pytest.raises(ValueError, match=r"a\.stl: suffix must be .* got .stl"):
        write_mesh(tmp_path / "a.stl", mesh)


def test_without_anything_solid_there_is_no_mesh():
    with pytest.raises(ValueError, match="no surface in this field"):
        field_mesh(field(lambda p: sphere(p) + 10.0))
