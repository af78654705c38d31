import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.diagrams.worlds.solids.solid import MATERIALS, Solid, cut_faces
from splatpilot.systems.collision import shapes

BOX = shapes.Box(RigidTransform(RollPitchYaw(0.2, -0.4, 1.0), [1.0, 0, 2]), [1.0, 2.0, 0.5])
SHAPES = {
    "sphere": shapes.Sphere([1.0, 2, 3], 0.7),
    "capsule": shapes.Capsule([0.0, 0, 1], [1.0, 0.5, 2], 0.3),
    "cylinder": shapes.Cylinder([0.0, 0, 1], [1.0, 0.5, 2], 0.3),
    "box": BOX,
    "ground": shapes.HalfSpace([0.0, 0, 1], 0.0),
}
AREAS = {
    "sphere": 4 * np.pi * 0.7**2,
    "capsule": 2 * np.pi * 0.3 * 1.5 + 4 * np.pi * 0.3**2,
    "cylinder": 2 * np.pi * 0.3 * 1.5 + 2 * np.pi * 0.3**2,
    "box": 2 * (2.0 + 1.0 + 0.5),
    "ground": (10 + 56) * (4 + 56),
}
BOUNDS = np.array([0.0, -2, 0]), np.array([10.0, 2, 5])


@pytest.mark.parametrize("kind", SHAPES)
def test_faces_lie_on_the_surface_and_look_outwards(kind):
    shape = SHAPES[kind]
    rng = np.random.default_rng(0)
    for face in cut_faces(shape, *BOUNDS):
        p, n, t = face.at(rng.uniform(0.02, 0.98, (200, 2)) * face.size)
        np.testing.assert_allclose(shapes.ShapeUnion.of([shape]).distance(p), 0, atol=1e-12)
        outwards = shapes.ShapeUnion.of([shape]).nearest(p + 1e-6 * n)[1]
        np.testing.assert_allclose(outwards, n, atol=1e-4)
        np.testing.assert_allclose(np.einsum("nk,nk->n", n, t), 0, atol=1e-12)


@pytest.mark.parametrize("kind", SHAPES)
def test_faces_cover_the_whole_surface(kind):
    area = 0.0
    s = (np.stack(np.meshgrid(*2 * [np.arange(40)], indexing="ij"), -1).reshape(-1, 2) + 0.5) / 40
    for face in cut_faces(SHAPES[kind], *BOUNDS):
        step = 1e-5
        p, *_ = face.at(s * face.size)
        d_u = (face.at(s * face.size + (step, 0))[0] - p) / step
        d_v = (face.at(s * face.size + (0, step))[0] - p) / step
        area += np.linalg.norm(np.cross(d_u, d_v), axis=1).mean() * np.prod(face.size)
    assert area == pytest.approx(AREAS[kind], rel=2e-3)


@pytest.mark.parametrize("material", MATERIALS)
def test_materials_have_colors_and_something_to_see(material):
    rng = np.random.default_rng(1)
    uv = rng.uniform(0, 2, (4000, 2))
    ground = material in ("grass", "paving", "forest_floor")
    shape, height = (
        (shapes.HalfSpace([0.0, 0, 1], 0.0), 0 * uv[:, 0]) if ground else (BOX, 3 + uv[:, 1])
    )
    p = np.column_stack([uv, height])
    colors, again, other = (Solid(shape, material, seed).albedo(uv, p) for seed in (3, 3, 5))
    assert colors.shape == (4000, 3)
    assert np.min(colors) > -0.05 and np.max(colors) < 1.3
    np.testing.assert_array_equal(colors, again)
    assert np.std(colors, axis=0).max() > 0.02
    if not ground:
        assert np.abs(colors - other).mean() > 0.01


def test_unknown_material_and_tilted_ground_are_refused():
    with pytest.raises(ValueError, match=r"material must be one of brick, .* got 'gold'"):
        Solid(SHAPES["sphere"], "gold")
    with pytest.raises(ValueError, match=r"HalfSpace.normal must be vertical"):
        cut_faces(shapes.HalfSpace([0.1, 0, 1], 0.0), *BOUNDS)
