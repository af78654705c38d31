import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.analysis.fidelity.study import ViewSupport
from splatpilot.training.reconstruction.metrics import SceneRenderer


@pytest.fixture
def support(place) -> ViewSupport:
    """Of a camera at 1 m from the left end of the room, looking along it."""
    capture = place.capture
    renderer = SceneRenderer(place.gaussians, "3dgs")
    X_WC = RigidTransform(capture.X_WCs[0].rotation(), [1.0, 1.5, 1.2])
    return ViewSupport(renderer, capture.K, capture.width, capture.height, [X_WC])


def test_own_view_is_seen(place, support):
    X_WC = RigidTransform(place.capture.X_WCs[0].rotation(), [1.0, 1.5, 1.2])
    assert support.of(X_WC) > 0.98
    assert support.distance([1.0, 1.5, 1.2]) == 0
    assert support.distance([1.0, 1.9, 1.5]) == pytest.approx(0.5)


def test_less_is_seen_the_farther_a_camera_goes(place, support):
    R_WC = place.capture.X_WCs[0].rotation()
    shares = [support.of(RigidTransform(R_WC, [x, 1.5, 1.2])) for x in (1.0, 0.8, 0.5, 0.2)]
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] < 0.8


def test_the_other_way_nothing_was_seen(place, support):
    R_WC = RotationMatrix.MakeZRotation(np.pi) @ place.capture.X_WCs[0].rotation()
    assert support.of(RigidTransform(R_WC, [1.0, 1.5, 1.2])) == 0


def test_what_stands_behind_something_is_not_seen(place):
    from splatpilot.systems.splats.scene import GaussianScene

    y, z = (g.ravel() for g in np.meshgrid(np.arange(0, 3, 0.08), np.arange(0, 2.5, 0.08)))
    wall = GaussianScene.from_colors(
        np.column_stack([np.full(len(y), 3.0), y, z]),
        np.tile([1.0, 0, 0, 0], (len(y), 1)),
        np.full((len(y), 3), 0.06),
        np.full(len(y), 0.99),
        np.full((len(y), 3), 0.5),
    )
    capture = place.capture
    R_WC = capture.X_WCs[0].rotation()
    poses = [RigidTransform(R_WC, [x, 1.5, 1.2]) for x in (1.0, 3.5)]
    args = (capture.K, capture.width, capture.height, poses[:1])
    open_room = ViewSupport(SceneRenderer(place.gaussians, "3dgs"), *args)
    walled = ViewSupport(SceneRenderer(place.gaussians.merged_with(wall), "3dgs"), *args)
    assert open_room.of(poses[1]) > 0.3
    assert walled.of(poses[1]) < 0.02


def test_seen_from_afar_is_not_seen(place):
    capture = place.capture
    renderer = SceneRenderer(place.gaussians, "3dgs")
    R_WC = capture.X_WCs[0].rotation()
    far = ViewSupport(
        renderer, capture.K, capture.width, capture.height, [RigidTransform(R_WC, [0.5, 1.5, 1.2])]
    )
    # The end wall, at 6 m, was seen from 5.5 m; now it is seen from 3.2 and from 2.4 m.
    assert far.of(RigidTransform(R_WC, [2.8, 1.5, 1.2])) > 0.35
    assert far.of(RigidTransform(R_WC, [3.6, 1.5, 1.2])) < 0.1
