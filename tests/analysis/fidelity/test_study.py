import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.analysis.reconstruction import fidelity as study
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.reconstruction.splat_rendering import SceneRenderer


def make_study(psnr, relative) -> study.FidelityStudy:
    samples = [
        study.Sample(0, x, x / 2, psnr(x), 2 * relative(x), relative(x), 0.0)
        for x in np.linspace(0, 1, 11)
    ]
    return study.FidelityStudy(
        "room", "rendered", 30.0, samples, max_depth_error=0.05, max_psnr_drop=6.0
    )


def test_reach_is_the_offset_of_the_first_limit():
    by_depth = make_study(lambda x: 30 - 5 * x, lambda x: 0.125 * x)
    assert by_depth.reach == pytest.approx(0.4)
    assert by_depth.unseen_limit == pytest.approx(0.2)
    assert by_depth.agreement() == (1.0, 0.0)
    by_color = make_study(lambda x: 30 - 20 * x, lambda x: 0.01 * x)
    assert by_color.reach == pytest.approx(0.3)


def test_reach_is_the_crossing_of_the_fit():
    x = np.repeat(np.linspace(0, 1, 11), 9)
    y = 0.3 * x
    y[0] = 300.0  # one wrong view
    assert study.reach(x, y, 0.15) == pytest.approx(0.5)
    rng = np.random.default_rng(0)
    many = rng.uniform(0, 2, 4000)
    assert study.reach(many, 0.3 * many + rng.normal(0, 0.05, 4000), 0.15) == pytest.approx(
        0.5, abs=0.08
    )
    assert study.reach([0.0, 0.4, 0.8], [0, 0.1, 0.2], 1.0) == 0.8
    assert study.reach([0.1, 0.4, 0.8], [2, 2, 2], 1.0) == 0


def test_bands():
    found = study.band(np.repeat([0.5, 0.0], 11), np.r_[np.arange(11), np.full(11, 7)])
    np.testing.assert_allclose(found.at, [0, 0.5])
    np.testing.assert_allclose([found.low, found.middle, found.high], [[7, 1], [7, 5], [7, 9]])
    many = study.band(np.arange(40), 2.0 * np.arange(40))
    np.testing.assert_array_equal(many.counts, [5] * 8)
    np.testing.assert_allclose(many.middle, 2 * many.at)
    assert len(study.band(np.arange(4000), np.arange(4000)).at) == 16


def test_held_out_stretches():
    assert study.choose_held_out(16, [1, 3], 2) == [2, 5, 6, 7, 10]
    assert study.choose_held_out(5, [1], 2) == [2]
    with pytest.raises(ValueError, match="4 frames are too few to hold out 1 between 2"):
        study.choose_held_out(4, [1], 2)


def test_displaced_poses():
    R_WC = RotationMatrix.MakeZRotation(0.3)
    path = [RigidTransform(R_WC, [1.0 * i, 2.0 * i, 0.5 * i]) for i in range(4)]
    left = np.array([-2, 1, 0]) / np.sqrt(5)
    expected = (0.4 * left, -0.4 * left, [0, 0, 0.4], [0, 0, -0.4])
    for X_WC, step in zip(study.displace_pose(path, 1, 0.4), expected, strict=True):
        np.testing.assert_allclose(X_WC.translation(), path[1].translation() + step, atol=1e-12)
        np.testing.assert_array_equal(X_WC.rotation().matrix(), R_WC.matrix())
    climb = [RigidTransform(R_WC, [0.0, 0.0, 1.0 * i]) for i in range(3)]
    for path in (climb[:1], climb):
        left = study.displace_pose(path, 0, 0.5)[0].translation()
        np.testing.assert_allclose(left, -0.5 * R_WC.matrix()[:, 0], atol=1e-12)


@pytest.fixture
def look(room):
    """Returns a pose that looks along the room from x [m]."""
    return lambda x: RigidTransform(room.capture.X_WCs[0].rotation(), [x, 1.5, 1.2])


@pytest.fixture
def support(room):
    """Returns the support by one fitted camera in the room, perhaps with more Gaussians."""

    def make(X_WC: RigidTransform, more: GaussianScene | None = None) -> study.ViewSupport:
        capture, scene = room.capture, room.gaussians
        renderer = SceneRenderer(scene if more is None else scene.merged_with(more), "3dgs")
        return study.ViewSupport(renderer, (capture.K, capture.width, capture.height), [X_WC])

    return make


def test_support_falls_with_the_distance_from_the_camera(support, look):
    found = support(look(1.0))
    fractions = [found.fraction(look(x)) for x in (1.0, 0.8, 0.5, 0.2)]
    assert fractions[0] > 0.98 and fractions[-1] < 0.8
    assert fractions == sorted(fractions, reverse=True)
    assert found.distance([1.0, 1.9, 1.5]) == pytest.approx(0.5)
    behind = RotationMatrix.MakeZRotation(np.pi) @ look(1.0).rotation()
    assert found.fraction(RigidTransform(behind, [1.0, 1.5, 1.2])) == 0


def test_occluded_surfaces_are_unseen(support, look):
    y, z = (g.ravel() for g in np.meshgrid(np.arange(0, 3, 0.08), np.arange(0, 2.5, 0.08)))
    wall = GaussianScene.from_colors(
        np.column_stack([np.full(len(y), 3.0), y, z]),
        np.tile([1.0, 0, 0, 0], (len(y), 1)),
        np.full((len(y), 3), 0.06),
        np.full(len(y), 0.99),
        np.full((len(y), 3), 0.5),
    )
    assert support(look(1.0)).fraction(look(3.5)) > 0.3
    assert support(look(1.0), wall).fraction(look(3.5)) < 0.02


def test_surfaces_seen_from_over_twice_the_distance_are_unseen(support, look):
    # The end wall, at 6 m, was seen from 5.5 m; now it is seen from 3.2 and from 2.4 m.
    far = support(look(0.5))
    assert far.fraction(look(2.8)) > 0.35
    assert far.fraction(look(3.6)) < 0.1
