import hashlib
import subprocess
import sys

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.ndimage import label
from scipy.spatial.distance import pdist

from splatpilot.diagrams.worlds.building_blocks import CLEARING, INSET, PASSAGE
from splatpilot.diagrams.worlds.forest.layout import ForestConfig, lay_out
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.shapes import (
    AnalyticDistanceField,
    Capsule,
    ShapeUnion,
    Sphere,
)
from splatpilot.systems.splats.background import mean_color
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

SMALL = ForestConfig(length=9.0, width=7.0, height=4.0, voxel_size=0.25)
KINDS = {
    "poles_sparse": ForestConfig(spacing=5.0, radius_min=0.10, radius_max=0.25),
    "forest_mid": ForestConfig(),
    "forest_dense": ForestConfig(spacing=2.1, radius_min=0.20, radius_max=0.35),
}


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(ForestConfig(), seed=0)


def _inside(world: World) -> np.ndarray:
    """Centers (N, 3) of the Gaussians in the flyable volume."""
    p = world.gaussians.means.astype(float)
    lower, upper = world.distance_field.lower_W, world.distance_field.upper_W
    return p[((p >= lower) & (p <= upper)).all(axis=1)]


def _shapes(world: World) -> tuple:
    """What can be hit."""
    assert isinstance(world.distance_field, AnalyticDistanceField)
    return world.distance_field.shapes


def _layout(config: ForestConfig, seed: int):
    """Layout, field, start and goal of a forest, without what is seen of it."""
    p_WS = np.array([INSET, 0, config.flight_height])
    p_WG = np.array([config.length - INSET, 0, config.flight_height])
    rng = np.random.default_rng(seed)
    layout = lay_out(config, rng, [p_WS[:2], p_WG[:2]], CLEARING)
    shapes = [solid.shape for solid in layout.solids()[0]]
    field = AnalyticDistanceField(shapes, layout.lower, layout.upper)
    return layout, field, p_WS, p_WG


def _digest(world: World) -> str:
    digest = hashlib.sha256()
    scene = world.gaussians
    for array in (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh):
        digest.update(array.tobytes())
    digest.update(world.distance_field.distance(_inside(world)[::50]).tobytes())
    digest.update(np.array([*mean_color(world.background), *world.p_WS, *world.p_WG]).tobytes())
    return digest.hexdigest()


def test_the_same_seed_gives_identical_worlds_in_another_process():
    code = (
        f"import sys; sys.path.insert(0, {str(__file__.rsplit('/', 1)[0])!r})\n"
        "from test_forest import SMALL, _digest, make_world\n"
        "print(_digest(make_world(SMALL, seed=5)))"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert other.stdout.strip() == _digest(make_world(SMALL, seed=5))


@pytest.mark.parametrize("kind", KINDS)
def test_trunks_are_as_far_apart_and_as_thick_as_configured(kind):
    config = KINDS[kind]
    for seed in range(2):
        trees = _layout(config, seed)[0].trees
        assert pdist(trees.base).min() >= config.spacing
        assert config.radius_min <= trees.radius.min() < config.radius_min + 0.03
        assert config.radius_max - 0.03 < trees.radius.max() <= config.radius_max
        tilt = np.rad2deg(np.arctan(np.linalg.norm(trees.lean, axis=1)))
        assert tilt.max() <= config.lean_max


@pytest.mark.parametrize("kind", KINDS)
def test_a_vehicle_can_fly_from_start_to_goal(kind):
    config = KINDS[kind]
    spacing = 0.1
    for seed in range(2):
        _, field, p_WS, p_WG = _layout(config, seed)
        assert field.distance(np.stack([p_WS, p_WG])).min() >= CLEARING
        r = VEHICLE_RADIUS
        x = np.arange(r, config.length - r, spacing)
        y = np.arange(r - config.width / 2, config.width / 2 - r, spacing)
        p = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((len(x), len(y)), 1.8)], axis=-1)
        # 4-connected cells whose centers leave half a cell to spare are connected in truth.
        part = np.asarray(label(field.distance(p) > r + spacing / 2)[0])  # pyright: ignore[reportIndexIssue]
        cells = [(np.abs(x - q[0]).argmin(), np.abs(y - q[1]).argmin()) for q in (p_WS, p_WG)]
        assert part[cells[0]] == part[cells[1]] > 0


@pytest.mark.parametrize("kind", KINDS)
def test_gaps_between_trunks_let_the_vehicle_through_at_every_height(kind):
    config = KINDS[kind]
    assert config.narrowest >= PASSAGE
    trees = _layout(config, seed=1)[0].trees
    radii = trees.radius[:, None] + trees.radius - np.diag(np.full(len(trees), np.inf))
    for z in np.linspace(0, config.height, 7):
        axes = trees.at(z)
        gap = np.linalg.norm(axes[:, None] - axes, axis=-1) - radii
        assert gap.min() >= config.narrowest


def test_everything_drawn_in_the_volume_is_solid(world):
    distance = np.abs(world.distance_field.distance(_inside(world)))
    assert distance.max() < 0.07
    assert np.quantile(distance, 0.95) < 0.04


def test_leaves_around_the_volume_stay_out_of_it(world):
    scene, field = world.gaussians, world.distance_field
    p = scene.means.astype(float)
    beyond = np.linalg.norm(p - np.clip(p, field.lower_W, field.upper_W), axis=1)
    solid = p[:, 2] < 0.1  # ground and litter
    for shape in _shapes(world):
        if isinstance(shape, (Capsule, Sphere)):
            solid |= np.abs(ShapeUnion.of([shape]).distance(p)) < 0.15
    reach = 3 * scene.scales.max(axis=1)
    leaves = (beyond > 0) & ~solid
    assert leaves.sum() > 10_000
    assert (reach <= beyond + 0.1)[leaves].all()


def test_every_solid_is_drawn(world):
    p = world.gaussians.means.astype(float)
    field = world.distance_field
    seen = 0
    for shape in _shapes(world):
        if isinstance(shape, Capsule):
            center = (np.asarray(shape.p_WA) + np.asarray(shape.p_WB)) / 2
        elif isinstance(shape, Sphere):
            center = np.asarray(shape.p_WO)
        else:
            continue
        if ((center < field.lower_W) | (center > field.upper_W))[:2].any():
            continue
        on_it = np.abs(ShapeUnion.of([shape]).distance(p)) < 0.03
        assert on_it.sum() > 40
        seen += 1
    assert seen > 30


def test_trees_left_out_of_the_field_are_never_the_nearest():
    layout, field, *_ = _layout(SMALL, seed=3)
    trees = layout.trees
    every = [
        Capsule(p_A, p_B, r)
        for p_A, p_B, r in zip(trees.at(-1), trees.at(SMALL.height + 2), trees.radius, strict=True)
    ]
    assert len(every) > sum(isinstance(s, Capsule) for s in field.shapes) - SMALL.logs
    full = AnalyticDistanceField([*field.shapes, *every], layout.lower, layout.upper)
    p = np.random.default_rng(0).uniform(layout.lower, layout.upper, (3000, 3))
    np.testing.assert_array_equal(full.distance(p), field.distance(p))


VIEWS = [  # p_WC [m], yaw and pitch [rad]
    ((1.5, 0.0, 1.8), 0.0, 0.0),
    ((18.0, 1.5, 1.5), 0.1, -0.15),
]


@pytest.mark.parametrize("p_WC, yaw, pitch", VIEWS)
def test_rendered_depth_is_the_distance_to_solids(world, p_WC, yaw, pitch):
    width, height = 160, 120
    K = np.array([[80.0, 0, 80], [0, 80, 60], [0, 0, 1]])
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0])
    R_WC = RotationMatrix(np.column_stack([right, np.cross(forward, right), forward]))
    view = world.baked.render(
        K, width, height, RigidTransform(R_WC, p_WC), background=world.background
    )
    truth, on_ground = _march(world, K, width, height, R_WC, np.array(p_WC))
    hit = np.isfinite(truth)
    assert hit.mean() > 0.5
    assert view.alpha[hit].min() > 0.9
    error = view.depth - truth
    assert np.median(np.abs(error[hit & ~on_ground])) < 0.04
    # Patches of the ground are seen at a slant; the near half of each is drawn first.
    assert np.median(np.abs(error[hit & on_ground & (truth < 10)])) < 0.08


def _march(world, K, width, height, R_WC, p_WC):
    """Depth (H, W) [m] of analytic surfaces, inf where a ray leaves the volume first, and whether
    it is the ground's."""
    v, u = np.mgrid[:height, :width] + 0.5
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    rays = (pixels @ np.linalg.inv(K).T @ R_WC.matrix().T).reshape(-1, 3)
    speed = np.linalg.norm(rays, axis=1)
    depth, hit = np.zeros(len(rays)), np.zeros(len(rays), dtype=bool)
    going = np.arange(len(rays))
    for _ in range(100):
        distance = world.distance_field.distance(p_WC + depth[going, None] * rays[going])
        hit[going[distance < 1e-3]] = True
        on = distance >= 1e-3  # false for NaN, outside
        going = going[on]
        depth[going] += distance[on] / speed[going]
    p = p_WC + depth[:, None] * rays
    depth[~hit] = np.inf
    return depth.reshape(height, width), (p[:, 2] < 0.005).reshape(height, width)


def test_the_grid_for_planning_agrees_with_the_truth(world):
    p = np.random.default_rng(0).uniform((0.5, -7.5, 1), (35.5, 7.5, 3), (2000, 3))
    error = world.esdf.distance(p) - world.distance_field.distance(p)
    assert np.abs(error).max() < ForestConfig().voxel_size / 2
    np.testing.assert_allclose(world.esdf.lower_W, world.distance_field.lower_W)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"height": float("nan")}, r"height must be .* got nan"),
        ({"voxel_size": 1e-4}, r"voxel_size must fit the volume: .* use larger voxels"),
        ({"width": 150.0, "length": 190.0}, r"length \* width must be at most 20000 m\^2"),
        ({"lean_max": 40.0}, r"lean_max must be .* got 40.0"),
        ({"length": 4.0}, r"length must be in \[5, .* got 4.0"),
        ({"width": 2.0}, r"width must be at least 2.5.* got 2.0"),
        ({"flight_height": 5.5}, r"flight_height must be at most .* = 5 m, got 5.5"),
        ({"radius_min": 0.6}, r"radius_min must be at most radius_max = 0.45, got 0.6"),
        ({"spacing": 1.9}, r"spacing must be at least 2.02 m, got 1.9"),
    ],
)
def test_a_forest_that_cannot_be_grown_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        make_world(ForestConfig(**values), seed=0)
