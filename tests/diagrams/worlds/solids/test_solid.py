import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from room import pinhole_rays

from splatpilot.diagrams.worlds.solids import solid
from splatpilot.systems.collision import shapes
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.training.captures.coverage import look_along

BOX = shapes.Box(RigidTransform(RollPitchYaw(0.2, -0.4, 1.0), [1.0, 0, 2]), [1.0, 2.0, 0.5])
ROUND = [0.0, 0, 1], [1.0, 0.5, 2], 0.3
SHAPES = {  # and their areas [m^2]
    "sphere": (shapes.Sphere([1.0, 2, 3], 0.7), 4 * np.pi * 0.7**2),
    "capsule": (shapes.Capsule(*ROUND), 2 * np.pi * 0.3 * 1.5 + 4 * np.pi * 0.3**2),
    "cylinder": (shapes.Cylinder(*ROUND), 2 * np.pi * 0.3 * 1.5 + 2 * np.pi * 0.3**2),
    "box": (BOX, 2 * (2.0 + 1.0 + 0.5)),
    "ground": (shapes.HalfSpace([0.0, 0, 1], 0.0), (10 + 56) * (4 + 56)),
}
BOUNDS = np.array([0.0, -2, 0]), np.array([10.0, 2, 5])


@pytest.mark.parametrize("kind", SHAPES)
def test_faces_cover_the_surface_and_look_outwards(kind):
    shape, expected = SHAPES[kind]
    union, area = shapes.ShapeUnion.of([shape]), 0.0
    rng = np.random.default_rng(0)
    s = (np.stack(np.meshgrid(*2 * [np.arange(40)], indexing="ij"), -1).reshape(-1, 2) + 0.5) / 40
    for face in solid.cut_faces(shape, *BOUNDS):
        p, n, t = face.at(rng.uniform(0.02, 0.98, (200, 2)) * face.size)
        np.testing.assert_allclose(union.distance(p), 0, atol=1e-12)
        np.testing.assert_allclose(union.nearest(p + 1e-6 * n)[1], n, atol=1e-4)
        np.testing.assert_allclose(np.einsum("nk,nk->n", n, t), 0, atol=1e-12)
        step = 1e-5
        p = face.at(s * face.size)[0]
        d_u = (face.at(s * face.size + (step, 0))[0] - p) / step
        d_v = (face.at(s * face.size + (0, step))[0] - p) / step
        area += np.linalg.norm(np.cross(d_u, d_v), axis=1).mean() * np.prod(face.size)
    assert area == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("material", solid.MATERIALS)
def test_materials_have_colors_and_something_to_see(material):
    uv = np.random.default_rng(1).uniform(0, 2, (4000, 2))
    ground = material in ("grass", "paving", "forest_floor")
    shape = shapes.HalfSpace([0.0, 0, 1], 0.0) if ground else BOX
    p = np.column_stack([uv, 0 * uv[:, 0] if ground else 3 + uv[:, 1]])
    colors, again, other = (solid.Solid(shape, material, seed).albedo(uv, p) for seed in (3, 3, 5))
    assert colors.shape == (4000, 3)
    assert np.min(colors) > -0.05 and np.max(colors) < 1.3
    np.testing.assert_array_equal(colors, again)
    assert np.std(colors, axis=0).max() > 0.02
    if not ground:
        assert np.abs(colors - other).mean() > 0.01


def test_unknown_material_and_tilted_ground_are_refused():
    with pytest.raises(ValueError, match=r"material must be one of brick, .* got 'gold'"):
        solid.Solid(BOX, "gold")
    with pytest.raises(ValueError, match=r"HalfSpace.normal must be vertical"):
        solid.cut_faces(shapes.HalfSpace([0.1, 0, 1], 0.0), *BOUNDS)


SIZE, FOCAL, AWAY = 200, 400.0, 5.0  # [px], [px], [m]


class Even:
    """The same light everywhere."""

    haze = np.full(3, 0.5)

    def irradiance(self, p_W: np.ndarray, n_W: np.ndarray) -> np.ndarray:
        return np.ones((len(p_W), 3))


ROTATED = RigidTransform(RollPitchYaw(0.1, 0.2, 0.5), [0.0, 0, 0])


@pytest.mark.parametrize(
    ("shape", "material", "within"),
    [
        (shapes.Box(ROTATED, [0.9, 1.2, 0.7]), "brick", 0.012),
        (shapes.Box(ROTATED, [0.9, 1.2, 0.05]), "wood", 0.012),
        (shapes.Cylinder([0.0, 0, -0.8], [0.1, 0, 0.7], 0.25), "concrete", 0.012),
        (shapes.Capsule([0.0, -2, 0], [0.0, 2, 0.3], 0.02), "cable", 0.002),
        (shapes.Sphere([0.0, 0, 0], 0.8), "foliage", 0.012),
    ],
    ids=["box", "plank", "pillar", "wire", "sphere"],
)
def test_outlines_are_those_of_the_solid(shape, material, within):
    bounds = np.full(3, -9.0), np.full(3, 9.0)
    solids = [solid.Solid(shape, material)]
    spec = solid.WorldSpec("outline", *bounds, solids, *bounds, light=lambda _: Even())
    scene, union = BakedScene(solid.draw(spec, solids, Even())), shapes.ShapeUnion.of([shape])
    K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    rays_C = np.dstack([pinhole_rays(K, SIZE, SIZE), np.ones((SIZE, SIZE))]).reshape(-1, 3)
    rays_C /= np.linalg.norm(rays_C, axis=1, keepdims=True)
    drawn = covered = rim = 0
    for azimuth in np.linspace(0, 2 * np.pi, 5, endpoint=False):
        X_WC = look_along(-AWAY * np.array([np.cos(azimuth), np.sin(azimuth), 0]), azimuth, 0.0)
        rays_W, p_WQ = rays_C @ X_WC.rotation().matrix().T, X_WC.translation()
        for _ in range(40):  # steps along the rays to the surface
            distance = union.distance(p_WQ + np.zeros_like(rays_W))
            p_WQ = p_WQ + np.minimum(distance, 1.0)[:, None] * rays_W
        inside = (union.distance(p_WQ) < 1e-3).reshape(SIZE, SIZE)
        drawn += int((scene.render(K, SIZE, SIZE, X_WC).depth > 0).sum())
        covered += int(inside.sum())
        rim += int((inside[1:] ^ inside[:-1]).sum() + (inside[:, 1:] ^ inside[:, :-1]).sum())
    assert abs((drawn - covered) / rim * AWAY / FOCAL) < within
