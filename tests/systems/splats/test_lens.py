import math

import cv2
import numpy as np
import pytest
from baked_scenes import plane, plane_depth, random_scene
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.sensors import CameraInfo

from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.sensing.time_of_flight import equivalent_sensor
from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.lens import Distortion, pixel_slopes
from splatpilot.systems.splats.splat_camera import SplatCamera

WIDTH, HEIGHT = 160, 120
FISHEYE = Distortion("fisheye", [0.04, -0.012, 0.005, -0.001])
BARREL = Distortion("opencv", [-0.28, 0.09, -0.012, 0.03, 0.01, 0.002], [0.003, -0.002])
FEW = Distortion("opencv", [-0.2, 0.05])
K = np.array([[110.0, 0, 78.0], [0, 105.0, 61.0], [0, 0, 1]])
# A fisheye whose image circle lies in the image.
K_CIRCLE = np.array([[45.0, 0, 78.0], [0, 45.0, 61.0], [0, 0, 1]])


def opencv_pixels(lens: Distortion, p_C: np.ndarray) -> np.ndarray:
    none = np.zeros(3)
    if lens.model == "fisheye":
        return cv2.fisheye.projectPoints(p_C[None], none, none, K, np.array(lens.radial))[0][0]
    k = [*lens.radial, *[0.0] * (6 - len(lens.radial))]
    p = lens.tangential or [0.0, 0.0]
    coefficients = np.array([*k[:2], *p, *k[2:]])
    return cv2.projectPoints(p_C, none, none, K, coefficients)[0][:, 0]


@pytest.mark.parametrize("lens", [FISHEYE, BARREL, FEW])
def test_points_are_where_opencv_has_them(lens):
    slopes = np.random.default_rng(0).uniform(-0.8, 0.8, (500, 2))
    points = lens.project(slopes)
    expected = opencv_pixels(lens, np.hstack([slopes, np.ones((500, 1))]))
    np.testing.assert_allclose(points * [110, 105] + [78, 61], expected, atol=1e-9)
    np.testing.assert_allclose(lens.slopes(points), slopes, atol=1e-9)


def test_rays_of_a_lens_that_folds_are_exact_or_none():
    u, v = np.meshgrid(np.linspace(-0.8, 0.8, 65), np.linspace(-0.6, 0.6, 49))
    points = np.stack([u, v], axis=-1)
    folding = Distortion(radial=[-0.3], tangential=[0.005, 0.005])
    slopes = folding.slopes(points)
    known = np.isfinite(slopes[..., 0])
    assert 0.5 < known.mean() < 1.0
    np.testing.assert_allclose(folding.project(slopes)[known], points[known], atol=1e-9)
    assert np.isnan(folding.slopes(points[:1, :1] + 5.0)).all()


def test_pixels_beyond_the_lens_look_nowhere():
    slopes = pixel_slopes(FISHEYE, K_CIRCLE, WIDTH, HEIGHT)
    shown = np.isfinite(slopes[..., 0])
    assert shown[60, 77] and not shown[0, 0] and 0.3 < shown.mean() < 0.8
    assert np.hypot(*slopes[shown].T).max() < math.tan(math.radians(85.0))
    folding = Distortion("opencv", [-0.3])
    assert folding.limit == pytest.approx(math.sqrt(1 / 0.9))  # (r - 0.3 r^3)' = 0
    assert np.isnan(folding.project(np.array([1.1, 0.0]))).all()


@pytest.mark.parametrize("lens", [None, FISHEYE, BARREL])
def test_depth_of_a_plane_is_that_of_the_rays(lens):
    R_CP = RollPitchYaw(0.3, -0.4, 0.0).ToRotationMatrix()
    X_CP = RigidTransform(R_CP, 2.0 * R_CP.matrix()[:, 2])
    camera = K * [[0.5], [0.5], [1.0]], WIDTH // 2, HEIGHT // 2
    depth = BakedScene(plane(X_CP, 6.0, step=0.08)).render_depth(
        *camera, RigidTransform(), distortion=lens
    )
    slopes = pixel_slopes(lens, *camera)
    expected = plane_depth(X_CP, slopes)
    x, y = expected * slopes[..., 0], expected * slopes[..., 1]
    inside = (expected > 0) & (np.maximum(np.abs(x), np.abs(y)) < 3.8)
    assert inside.mean() > 0.5
    error = np.abs(depth / expected - 1)[inside]
    assert np.median(error) < 1e-3
    assert np.quantile(error, 0.99) < 0.01


def test_only_what_the_lens_shows_is_drawn():
    scene = random_scene(2000, seed=1, sh_degree=0)
    camera = SplatCamera(
        scene.transformed_by(RigidTransform([0, 0, 4.0])),
        CameraInfo(WIDTH, HEIGHT, 45.0, 45.0, 78.0, 61.0),
        background=EnvironmentMap(np.ones((4, 8, 3), np.float32)),
        distortion=FISHEYE,
    )
    view = camera.render(RigidTransform())
    shown = np.isfinite(pixel_slopes(FISHEYE, K_CIRCLE, WIDTH, HEIGHT)[..., 0])
    assert (view.color[~shown] == 0).all() and (view.alpha[~shown] == 0).all()
    assert (view.depth[~shown] == 0).all()
    # The map is white, and pixels without Gaussians show it.
    clear = shown & (view.alpha == 0)
    assert clear.any() and (view.color[clear] == 1).all()


def test_onboard_cameras_have_lenses():
    camera = OnboardCamera(width=WIDTH, height=HEIGHT, fov_x=150.0, distortion=FISHEYE)
    camera.validate()
    info = camera.camera_info()
    slopes = pixel_slopes(FISHEYE, info.intrinsic_matrix(), WIDTH, HEIGHT)
    half_pixel = abs(slopes[60, 1, 0] - slopes[60, 0, 0])
    assert slopes[60, 0, 0] == pytest.approx(-math.tan(math.radians(75.0)), abs=half_pixel)
    with pytest.raises(ValueError, match=r"fov_x must be below 170\.0 deg, .* got 170"):
        OnboardCamera(fov_x=170.0, distortion=FISHEYE).validate()
    with pytest.raises(ValueError, match="distortion must be left out"):
        equivalent_sensor(camera)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"radial": [0.1] * 7}, "radial must be at most 6 numbers"),
        ({"model": "fisheye", "tangential": [0.1, 0.1]}, "tangential must be 0 numbers of fisheye"),
        ({"max_angle": 90.0}, r"max_angle must be in \(0, 85\] deg, got 90"),
    ],
)
def test_bad_lenses_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Distortion(**changes).validate()
