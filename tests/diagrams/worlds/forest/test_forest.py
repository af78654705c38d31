import numpy as np
import pytest
from scipy.spatial.distance import pdist

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds.building_blocks import INSET, PASSAGE
from splatpilot.diagrams.worlds.forest.layout import ForestConfig, lay_out
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Capsule, ShapeUnion, Sphere
from splatpilot.systems.common.config import load_config

SMALL = ForestConfig(length=9.0, width=7.0, height=4.0, voxel_size=0.25)
KINDS = {
    "poles_sparse": ForestConfig(spacing=5.0, radius_min=0.10, radius_max=0.25),
    "forest_mid": ForestConfig(),
    "forest_dense": ForestConfig(spacing=2.1, radius_min=0.20, radius_max=0.35),
}


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(ForestConfig(length=18.0, width=12.0), seed=0)


def _layout(config: ForestConfig, seed: int):
    """Layout, field, start and goal of a forest, without what is seen of it."""
    p_WS = np.array([INSET, 0, config.flight_height])
    p_WG = np.array([config.length - INSET, 0, config.flight_height])
    rng = np.random.default_rng(seed)
    layout = lay_out(config, rng, [p_WS[:2], p_WG[:2]])
    shapes = [solid.shape for solid in layout.solids()[0]]
    field = AnalyticDistanceField(shapes, layout.lower, layout.upper)
    return layout, field, p_WS, p_WG


@pytest.mark.parametrize("kind", KINDS)
def test_trunks_are_as_configured_and_let_the_vehicle_through_at_every_height(kind):
    config = KINDS[kind]
    assert config.narrowest >= PASSAGE
    for seed in range(2):
        trees = _layout(config, seed)[0].trees
        assert pdist(trees.base).min() >= config.spacing
        assert config.radius_min <= trees.radius.min() < config.radius_min + 0.03
        assert config.radius_max - 0.03 < trees.radius.max() <= config.radius_max
        tilt = np.rad2deg(np.arctan(np.linalg.norm(trees.lean, axis=1)))
        assert tilt.max() <= config.lean_max
        radii = trees.radius[:, None] + trees.radius - np.diag(np.full(len(trees), np.inf))
        for z in np.linspace(0, config.height, 7):
            axes = trees.at(z)
            gap = np.linalg.norm(axes[:, None] - axes, axis=-1) - radii
            assert gap.min() >= config.narrowest


def test_everything_drawn_in_the_volume_is_solid(world):
    p, field = world.gaussians.means.astype(float), world.distance_field
    distance = np.abs(field.distance(p))
    distance = distance[np.isfinite(distance)]
    assert distance.max() < 0.07 and np.quantile(distance, 0.95) < 0.04


def test_leaves_around_the_volume_stay_out_of_it(world):
    scene, field = world.gaussians, world.distance_field
    p = scene.means.astype(float)
    beyond = np.linalg.norm(p - np.clip(p, field.lower_W, field.upper_W), axis=1)
    solid = p[:, 2] < 0.1  # ground and litter
    for shape in field.shapes:
        if isinstance(shape, (Capsule, Sphere)):
            solid |= np.abs(ShapeUnion.of([shape]).distance(p)) < 0.15
    reach = 3 * scene.scales.max(axis=1)
    leaves = (beyond > 0) & ~solid
    assert leaves.sum() > 5_000
    assert (reach <= beyond + 0.1)[leaves].all()


def test_every_solid_is_drawn(world):
    p, field = world.gaussians.means.astype(float), world.distance_field
    spheres = [(s, s.p_WO) for s in field.shapes if isinstance(s, Sphere)]
    capsules = [s for s in field.shapes if isinstance(s, Capsule)]
    seen = 0
    for shape, center in [*spheres, *((s, np.add(s.p_WA, s.p_WB) / 2) for s in capsules)]:
        if ((center > field.lower_W) & (center < field.upper_W))[:2].all():
            assert (np.abs(ShapeUnion.of([shape]).distance(p)) < 0.03).sum() > 40
            seen += 1
    assert seen > 15


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


@pytest.mark.parametrize("area", [80, 50, 30, 25])
def test_forests_have_a_tree_in_each_so_many_square_meters(area):
    config = load_config(Scenario(), scenario_file(f"trees_{area}")).world
    assert isinstance(config, ForestConfig)
    counts = []
    for seed in range(4):
        layout, _, p_WS, p_WG = _layout(config, seed)
        base = layout.trees.base
        inside = (base > layout.lower[:2]) & (base < layout.upper[:2])
        counts.append(inside.all(1).sum() * area / (config.length * config.width))
        assert pdist(base).min() >= config.spacing
        assert p_WG[0] - p_WS[0] == 60.0
    # Start and goal are cleared.
    assert np.mean(counts) == pytest.approx(1.0, abs=0.08)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"density": 0.2}, r"density must be at most \d+ trunks at this spacing, got \d+"),
        ({"density": 1e-4}, r"density must be that of one trunk or more, got 0\.0001; raise it"),
        ({"voxel_size": 1e-4}, "a box of .* use larger voxels"),
        ({"width": 150.0, "length": 190.0}, r"length \* width must be at most 20000 m\^2"),
        ({"width": 2.0}, r"width must be at least 2.5.* got 2.0"),
        ({"flight_height": 5.5}, r"flight_height must be at most .* = 5 m, got 5.5"),
        ({"radius_min": 0.6}, r"radius_min must be at most radius_max = 0.45, got 0.6"),
        ({"spacing": 1.9}, r"spacing must be at least 2.02 m, got 1.9"),
    ],
)
def test_a_forest_that_cannot_be_grown_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        make_world(ForestConfig(**values), seed=0)
