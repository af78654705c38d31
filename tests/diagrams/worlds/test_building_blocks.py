import numpy as np
from scipy.spatial import KDTree

from splatpilot.diagrams.worlds import building_blocks as blocks
from splatpilot.diagrams.worlds.solids.surfaces import FloorPlan
from splatpilot.systems.collision.shapes import AnalyticDistanceField

PLAN = FloorPlan.of_size(12.0, 8.0, 4.0)
LOWER, UPPER = np.array([-3.0, 2.0]), np.array([27.0, 14.0])


def _distance(solids, p_W: np.ndarray) -> np.ndarray:
    shapes = [solid.shape for solid in solids]
    return AnalyticDistanceField(shapes, PLAN.lower - 2, PLAN.upper + 2).distance(p_W)


def test_walls_and_roof_enclose_the_volume():
    p = np.random.default_rng(0).uniform(PLAN.lower, PLAN.upper, (500, 3))
    to_bounds = np.minimum((p - PLAN.lower)[:, :2].min(axis=1), (PLAN.upper - p).min(axis=1))
    solids = [*blocks.hall(PLAN, ["brick"], np.random.default_rng(1)), blocks.roof(PLAN)]
    np.testing.assert_allclose(_distance(solids, p), to_bounds, atol=1e-12)


def test_signs_hang_on_the_inner_faces_of_a_hall():
    walls = blocks.hall(PLAN, ["brick"], np.random.default_rng(1))
    signs = blocks.signs_in(walls, 3, 1, np.random.default_rng(2))
    middles = np.array([sign.shape.X_WO.translation() for sign in signs])
    assert len(signs) == 8
    np.testing.assert_allclose(middles[:3, 1], -4 + 0.01)
    np.testing.assert_allclose(middles[3:6, 1], 4 - 0.01)
    np.testing.assert_allclose(middles[6:, 0], (0.01, 12 - 0.01))
    assert ((middles > PLAN.lower) & (middles < PLAN.upper)).all()
    assert not blocks.signs_in(walls, 0, 0, np.random.default_rng(2))


def test_start_and_goal_are_at_the_ends_and_within_the_heights():
    rng = np.random.default_rng(0)
    ends = np.array([blocks.start_and_goal(PLAN, rng, (0.5, 0.7)) for _ in range(50)])  # (50, 2, 3)
    np.testing.assert_allclose(ends[..., 0], np.tile((1.5, 10.5), (50, 1)))
    assert np.abs(ends[..., 1]).max() < 4 and np.ptp(ends[..., 1]) > 2
    assert ends[..., 2].min() >= 0.5 and ends[..., 2].max() <= 0.7


def test_points_keep_the_spacing_and_fill_the_rectangle():
    p = np.random.default_rng(1).uniform(LOWER, UPPER, (5000, 2))
    for seed in range(5):
        points = blocks.poisson_disk(LOWER, UPPER, 1.3, np.random.default_rng(seed))
        tree = KDTree(points)
        assert tree.query(points, k=2)[0][:, 1].min() >= 1.3
        assert (points >= LOWER).all() and (points <= UPPER).all()
        distance, _ = tree.query(p)
        assert distance.max() < 1.5 * 1.3
        assert np.mean(distance < 1.3) > 0.99
