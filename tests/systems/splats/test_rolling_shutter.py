"""Rolling shutters, row by row."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.baked_scene import BakedScene, MovingGaussians, PlacedGaussians
from splatpilot.systems.splats.lens import Distortion
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import SplatCamera, row_bands
from splatpilot.systems.vehicle.state import pose_between

WIDTH, HEIGHT, FOCAL = 64, 48, 40.0
INFO = CameraInfo(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)


def pole(x: float = 0.0) -> GaussianScene:
    """An upright line, 4 m ahead of a camera at the origin with optical axes."""
    y = np.arange(-6.0, 6.0, 0.02)
    return GaussianScene.from_colors(
        means=np.column_stack([np.full(y.size, x), y, np.full(y.size, 4.0)]),
        quats=np.tile([1.0, 0, 0, 0], (y.size, 1)),
        scales=np.full((y.size, 3), 0.08),
        opacities=np.full(y.size, 0.99),
        colors=np.tile([1.0, 1.0, 1.0], (y.size, 1)),
    )


def columns(color: np.ndarray) -> np.ndarray:
    """Where each row [px] sees the pole."""
    weights = color.mean(axis=2)
    return (weights * (np.arange(WIDTH) + 0.5)).sum(axis=1) / weights.sum(axis=1)


def yawed(angle: float) -> RigidTransform:
    """A camera that has turned right [rad]."""
    return RigidTransform(RotationMatrix.MakeYRotation(angle))


def test_a_pole_leans_as_the_camera_turns():
    """Turned from -0.1 to 0.1 rad while its rows are read, a camera sees an upright pole at the
    column f tan(-angle) of each row's own angle."""
    view = SplatCamera(pole(), INFO, readout=0.02).render(yawed(0.1), 0.0, yawed(-0.1))
    angle = np.interp(np.arange(HEIGHT) + 0.5, [0, HEIGHT], [-0.1, 0.1])
    expected = WIDTH / 2 - FOCAL * np.tan(angle)
    assert np.abs(columns(view.color) - expected).max() < 0.3
    assert np.ptp(columns(SplatCamera(pole(), INFO).render(yawed(0.1)).color)) < 0.1


def test_each_row_is_that_of_its_pose():
    """Fast enough that every row is a band, rows are what a camera there sees. They are not so to
    the last bit: Gaussians are held to the field of view of what is rendered."""
    camera = SplatCamera(pole(), INFO, readout=0.02)
    X_0 = RigidTransform(RotationMatrix.MakeXRotation(0.3), [0.1, 0.0, -0.2])
    X_1 = RigidTransform(RotationMatrix.MakeYRotation(0.6), [0.3, 0.1, 0.4])
    assert len(row_bands(X_0, X_1, FOCAL, HEIGHT)) == HEIGHT
    view = camera.render(X_1, 0.0, X_0)
    for row in range(0, HEIGHT, 7):
        own = camera.render(pose_between(X_0, X_1, (row + 0.5) / HEIGHT))
        np.testing.assert_allclose(view.color[row], own.color[row], atol=2e-2)
        seen = own.depth[row] > 0
        assert seen.any() and (view.depth[row] > 0)[seen].mean() > 0.9
        both = seen & (view.depth[row] > 0)
        np.testing.assert_allclose(view.depth[row][both], own.depth[row][both], rtol=5e-3)


def test_bands():
    """What does not move is one band; a band moves by half a pixel at most, and every row is in
    one."""
    X = RigidTransform()
    assert row_bands(X, X, FOCAL, HEIGHT) == [(0, HEIGHT)]
    bands = row_bands(X, RigidTransform([0.1, 0, 0]), FOCAL, HEIGHT)
    assert len(bands) == 8  # 0.1 m at 1 m are 4 px
    assert [row for band in bands for row in range(*band)] == list(range(HEIGHT))
    assert len(row_bands(X, yawed(1.0), FOCAL, HEIGHT)) == HEIGHT


def ports(camera: SplatCamera, X_0: RigidTransform, X_1: RigidTransform, names: list[str]):
    context = camera.CreateDefaultContext()
    camera.GetInputPort("start_pose").FixValue(context, X_0)
    camera.GetInputPort("body_pose").FixValue(context, X_1)
    images = [np.array(camera.GetOutputPort(name).Eval(context).data) for name in names]
    camera.GetInputPort("start_pose").FixValue(context, X_1)
    return images, np.array(camera.GetOutputPort(names[-1]).Eval(context).data)


@pytest.mark.parametrize("distortion", [None, Distortion("fisheye", [-0.02, 0.01, 0, 0])])
def test_ports(distortion):
    """Colour and depth come from the same rows, depth alone has the bits of depth beside colour,
    and images follow the pose at which the first row is read."""
    sky = EnvironmentMap(np.tile([[0.2, 0.4, 0.9]], (8, 16, 1)).astype(np.float32))
    camera = SplatCamera(
        pole(), INFO, readout=0.02, distortion=distortion, background=sky, max_depth=30.0
    )
    names = ["color_image", "depth_image_32f"]
    (color, depth), still = ports(camera, yawed(-0.1), yawed(0.1), names)
    (alone,), _ = ports(camera, yawed(-0.1), yawed(0.1), names[1:])
    np.testing.assert_array_equal(depth, alone)
    assert np.any(still != depth)
    where = np.isfinite(depth[..., 0])
    assert where.any(axis=1).all()
    assert color[..., :3][where].min() > 100 and (color[0, 0, :3] == [51, 102, 230]).all()


def test_what_moves_is_where_it_was_when_its_row_was_read():
    """A pole that moves at 2 m/s leans, though the camera is at rest: each band shows it at its own
    time."""
    scene, line = pole(50.0), pole()

    def placed(time: float) -> PlacedGaussians:
        means = (line.means + np.array([2.0 * time, 0, 0])).astype(np.float32)
        return PlacedGaussians(means, *(getattr(line, n) for n in PlacedGaussians._fields[1:]))

    class Moving(MovingGaussians):
        def __init__(self) -> None:
            pass

        def at(self, time: float) -> PlacedGaussians:
            return placed(time)

    camera = SplatCamera(BakedScene(scene), INFO, readout=0.2, moving=Moving())
    seen = columns(camera.render(RigidTransform(), 0.5, RigidTransform()).color)
    times = np.interp(np.arange(HEIGHT) + 0.5, [0, HEIGHT], [0.3, 0.5])
    assert np.abs(seen - (WIDTH / 2 + FOCAL * 2.0 * times / 4.0)).max() < 0.4


def test_readout_must_be_a_time():
    with pytest.raises(ValueError, match=r"readout is -0\.01 s; it must be at least 0"):
        SplatCamera(pole(), INFO, readout=-0.01)
