from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from splatpilot.diagrams.worlds.solids.solid import Solid, WorldSpec, draw
from splatpilot.systems.collision.shapes import Box, Capsule, Cylinder, Shape, ShapeUnion, Sphere
from splatpilot.systems.splats.baked_scene import BakedScene

SIZE, FOCAL, AWAY = 200, 400.0, 5.0  # [px], [px], [m]


@dataclass
class _Even:
    """The same light everywhere."""

    haze = np.full(3, 0.5)

    def irradiance(self, p_W: NDArray, n_W: NDArray) -> NDArray:
        return np.ones((len(p_W), 3))


TURNED = RigidTransform(RollPitchYaw(0.1, 0.2, 0.5), [0.0, 0, 0])
SHAPES = {
    "box": (Box(TURNED, [0.9, 1.2, 0.7]), "brick"),
    "plank": (Box(TURNED, [0.9, 1.2, 0.05]), "wood"),
    "pillar": (Cylinder([0.0, 0, -0.8], [0.1, 0, 0.7], 0.25), "concrete"),
    "wire": (Capsule([0.0, -2, 0], [0.0, 2, 0.3], 0.02), "cable"),
    "sphere": (Sphere([0.0, 0, 0], 0.8), "foliage"),
}


@pytest.mark.parametrize("kind", SHAPES)
def test_outlines_are_those_of_the_solid(kind):
    shape, material = SHAPES[kind]
    bounds = np.full(3, -9.0), np.full(3, 9.0)
    spec = WorldSpec(kind, *bounds, [Solid(shape, material)], *bounds, light=lambda _: _Even())
    scene = BakedScene(draw(spec, spec.solids, _Even()))
    drawn = solid = rim = 0
    for azimuth in np.linspace(0, 2 * np.pi, 5, endpoint=False):
        X_WC = RigidTransform(
            RotationMatrix.MakeZRotation(azimuth)
            @ RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])),
            -AWAY * np.array([np.cos(azimuth), np.sin(azimuth), 0]),
        )
        inside = _is_seen(shape, X_WC)
        K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
        drawn += int((scene.render(K, SIZE, SIZE, X_WC).depth > 0).sum())
        solid += int(inside.sum())
        rim += int((inside[1:] ^ inside[:-1]).sum() + (inside[:, 1:] ^ inside[:, :-1]).sum())
    overhang = (drawn - solid) / rim * AWAY / FOCAL
    assert abs(overhang) < (0.002 if kind == "wire" else 0.012)


def _is_seen(shape: Shape, X_WC: RigidTransform) -> NDArray[np.bool_]:
    """Which pixels (SIZE, SIZE) show the shape, by stepping along their rays."""
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    rays_C = np.stack([u - SIZE / 2, v - SIZE / 2, np.full_like(u, FOCAL)], axis=-1) / FOCAL
    rays_W = rays_C.reshape(-1, 3) @ X_WC.rotation().matrix().T
    rays_W /= np.linalg.norm(rays_W, axis=1, keepdims=True)
    p_WQ = np.tile(X_WC.translation(), (len(rays_W), 1))
    for _ in range(40):
        distance = ShapeUnion.of([shape]).distance(p_WQ)
        p_WQ += np.minimum(distance, 1.0)[:, None] * rays_W
    near = ShapeUnion.of([shape]).distance(p_WQ) < 1e-3
    return near.reshape(SIZE, SIZE)
