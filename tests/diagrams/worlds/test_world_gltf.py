import json

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from room import pinhole_rays

from splatpilot.diagrams.worlds import mesh_renderer
from splatpilot.diagrams.worlds.solids.solid import Solid, WorldSpec, build
from splatpilot.diagrams.worlds.solids.textures import Daylight, Sunlight
from splatpilot.diagrams.worlds.world_gltf import write_gltf
from splatpilot.systems.collision.shapes import Box, Capsule, Cylinder, HalfSpace, Sphere
from splatpilot.training.captures.coverage import look_along

WIDTH, HEIGHT, FOCAL = 160, 120, 80.0


@pytest.fixture(scope="module")
def spec() -> WorldSpec:
    """One solid of each shape on the ground of a volume of 8 x 6 x 4 m."""
    tilted = RigidTransform(RollPitchYaw(0.3, 0.2, 0.5), [5.0, -1.5, 1.2])
    hour = Daylight.sample(np.random.default_rng(3))
    return WorldSpec(
        name="sampler",
        lower_W=np.array([0.0, -2.5, 0]),
        upper_W=np.array([7.0, 2.5, 4]),
        solids=[
            Solid(HalfSpace([0.0, 0, 1], 0.0), "grass"),
            Solid(Sphere([5.0, 0.4, 2.4], 0.6), "stone", 1),
            Solid(Capsule([6.0, 1.8, 0.5], [6.0, 2.2, 3.5], 0.3), "oak", 2),
            Solid(Cylinder([4.0, 1.2, 0.0], [4.0, 1.2, 1.5], 0.3), "metal", 3),
            Solid(Box(tilted, [0.8, 1.0, 1.4]), "brick", 4),
        ],
        p_WS=np.array([1.0, 0, 1.5]),
        p_WG=np.array([6.0, 0, 1.5]),
        light=lambda esdf: Sunlight(hour, esdf),
    )


def test_mesh_lies_on_the_surfaces_and_looks_like_the_gaussians(
    opengl, spec, tmp_path, monkeypatch
):
    path = tmp_path / "world.gltf"
    write_gltf(spec, path)
    X_WC = look_along(np.array([1.0, 0, 1.8]), 0.0, -0.2)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    # All light is baked in; lamps add only gloss.
    monkeypatch.setattr(mesh_renderer, "_LAMPS", [((0, 0, -1), 0.0)])
    renderer = mesh_renderer.MeshRenderer(path, "y", (0, 0, 0))
    color, depth = renderer.render(X_WC, K, WIDTH, HEIGHT, (0.2, 50.0))
    rays = np.dstack([pinhole_rays(K, WIDTH, HEIGHT), np.ones((HEIGHT, WIDTH))])
    seen = np.isfinite(depth)
    p_WQ = X_WC.multiply((rays[seen] * depth[seen, None]).T).T
    distance = spec.distance_field.distance(p_WQ)
    inside = np.isfinite(distance)
    assert inside.sum() > 0.25 * depth.size
    assert np.abs(distance[inside]).max() < 0.004

    world = build(spec)
    view = world.baked.render(K, WIDTH, HEIGHT, X_WC, background=world.background)
    solid = seen & (view.alpha > 0.99)
    assert solid.sum() > 0.4 * depth.size
    difference = (view.color - color / 255.0)[solid]
    assert np.abs(difference).mean() < 0.06
    assert np.abs(difference.mean(axis=0)).max() < 0.02
    near = solid & (depth < 6)
    # Expected depth of flat Gaussians seen at a slant reads near, here by up to 0.06 m.
    assert np.median(np.abs(view.depth - depth)[near]) < 0.08


def test_file_is_whole_and_the_same_twice(spec, tmp_path):
    one, two = tmp_path / "one.gltf", tmp_path / "two.gltf"
    write_gltf(spec, one, texel=0.1)
    write_gltf(spec, two, texel=0.1)
    assert one.read_bytes() == two.read_bytes()
    document = json.loads(one.read_text())
    uris = [part["uri"] for kind in ("buffers", "images") for part in document[kind]]
    assert uris and all(uri.startswith("data:") for uri in uris)
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    position = document["accessors"][attributes["POSITION"]]
    np.testing.assert_allclose(position["min"], [-28, 0, -30.5], atol=1e-6)
    assert position["max"][1] == pytest.approx(3.8, abs=0.02)
