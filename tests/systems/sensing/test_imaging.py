import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import ImageRgba8U

from splatpilot.systems.sensing.imaging import (
    AutoExposure,
    Compression,
    Imaging,
    Stereo,
    TimeOfFlightErrors,
    correlated_noise,
    matched_depth,
    stereo_depth,
    time_of_flight_depth,
)
from splatpilot.systems.sensing.noise import color_of_light, light_of_color
from splatpilot.systems.sensing.onboard_camera import OnboardCamera, focal_length
from splatpilot.systems.splats.lens import Distortion, pixel_slopes

CAMERA = OnboardCamera(width=32, height=18)
PERIOD = 0.02  # [s]


def picture(color: float | np.ndarray) -> ImageRgba8U:
    image = ImageRgba8U(CAMERA.width, CAMERA.height)
    image.mutable_data[..., :3], image.mutable_data[..., 3] = np.round(color), 255
    return image


@pytest.mark.parametrize("response", [0.1, 0.4])
def test_exposure_follows_light_with_its_time_constant(response):
    exposure = AutoExposure(Imaging(exposure_response=response), CAMERA, PERIOD)
    simulator, gains = Simulator(exposure), []
    context = simulator.get_mutable_context()
    # The light is halved twice at 1 s.
    for light, time in ((0.36, 0.0), (0.09, response), (0.09, 3 * response)):
        color = color_of_light(np.array(light))
        exposure.get_input_port().FixValue(context, Value(picture(color)))
        simulator.AdvanceTo(1.0 - 1e-6 + time)
        gains.append(context.get_discrete_state_vector().GetAtIndex(0))
    assert gains[0] == pytest.approx(-1.0, abs=0.03)
    left = [(gains[0] + 2.0 - gain) / 2.0 for gain in gains[1:]]
    assert left == pytest.approx([math.exp(-1.0), math.exp(-3.0)], abs=0.02)


def changed(system, color: float | np.ndarray) -> np.ndarray:
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, Value(picture(color)))
    return np.array(system.get_output_port().Eval(context).data)


LENS = Distortion("fisheye", max_angle=80.0)
FISHEYE = replace(CAMERA, fov_x=150.0, distortion=LENS)


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE])
def test_vignetting_follows_the_cosine_of_the_angle(camera):
    seen = changed(AutoExposure(Imaging(vignetting=4.0), camera, PERIOD), 200.0)[..., 0]
    K = camera.camera_info().intrinsic_matrix()
    slopes = pixel_slopes(camera.distortion, K, *seen.shape[::-1])
    expected = light_of_color(200.0) * np.nan_to_num((1.0 + (slopes**2).sum(-1)) ** -2)
    np.testing.assert_allclose(light_of_color(seen.astype(float)), expected, atol=4e-3)


def test_stereo_and_other_focal_lengths_are_of_cameras_without_distortion():
    with pytest.raises(ValueError, match=r"imaging.stereo must be of a camera without distortion"):
        Imaging(stereo=Stereo()).depth_sensor(False, FISHEYE)
    with pytest.raises(ValueError, match=r"imaging.focal_scale must be of a camera without dist"):
        Imaging(focal_scale=0.8).camera(FISHEYE)


def test_compression_costs_detail_by_its_quality():
    noise = np.random.default_rng(0).uniform(0, 255, (18, 32, 1)) * np.ones(3)
    systems = [Compression(Imaging(jpeg_quality=q), CAMERA, 15.0, 0) for q in (95, 20)]
    errors = [np.abs(changed(system, noise)[..., :3] - noise).mean() for system in systems]
    assert errors[0] < 3.0 < errors[1]


@pytest.mark.parametrize(("scale", "fov_x"), [(1.0, 90.0), (1.5, 67.38), (0.75, 106.26)])
def test_the_focal_length_changes_the_field_of_view(scale, fov_x):
    camera = Imaging(focal_scale=scale).camera(OnboardCamera(fov_x=90.0, fov_y=60.0))
    assert camera.fov_x == pytest.approx(fov_x, abs=0.01)
    assert camera.focal_y == pytest.approx(scale * focal_length(camera.height, 60.0))


def test_depth_grids_come_from_time_of_flight_and_images_from_stereo():
    both = Imaging(stereo=Stereo(), time_of_flight=TimeOfFlightErrors())
    assert both.depth_sensor(True, CAMERA) is both.time_of_flight
    assert both.depth_sensor(False, CAMERA) is both.stereo
    assert Imaging(stereo=Stereo()).depth_sensor(True, CAMERA) is None


DEPTH_CAMERA = OnboardCamera(width=64, height=36)
SHAPE = DEPTH_CAMERA.height, DEPTH_CAMERA.width
EXACT = {"noise": 0.0, "step": 0.0}
QUIET = TimeOfFlightErrors(noise=0.0, ambient_spread=0.0, multipath=0.0, mixed_pixels=0.0)


def stereo(depth, normal=None, **fields):
    normal = np.zeros(SHAPE) if normal is None else normal
    return stereo_depth(depth, Stereo(**fields), DEPTH_CAMERA, normal)


def tof(depth, normal=0.0, reflectivity=0.0, mixing=0.0, **fields):
    draws = (np.full(SHAPE, float(x)) for x in (normal, reflectivity))
    sensor = TimeOfFlightErrors(**vars(QUIET) | fields)
    return time_of_flight_depth(
        depth, sensor, DEPTH_CAMERA, *draws, np.full((2, *SHAPE), float(mixing))
    )


def test_stereo_noise_grows_with_the_square_of_depth():
    noise = np.random.default_rng(0).standard_normal((30, *SHAPE))
    for z in (0.2, 2.0, 20.0):
        depths = [stereo(np.full(SHAPE, z), n, step=0.0, window=0.0) for n in noise]
        seen = np.array(depths)[:, :, 12:]  # right of the border without matches
        expected = z**2 * 0.08 / (424.0 * 0.05)
        assert seen.std() == pytest.approx(expected, rel=0.05)


def test_stereo_disparities_are_rounded():
    depth = np.tile(np.linspace(4.0, 4.5, 36)[:, None], 64)
    steps = 424.0 * 0.05 / stereo(depth, **EXACT | {"step": 0.25})[:, 12:] / 0.25
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert len(np.unique(np.round(steps))) == 3


def test_stereo_errors_are_correlated_within_the_window():
    white = np.random.default_rng(1).standard_normal((400, 400))
    noise = correlated_noise(white, 3.0)
    assert noise.std() == pytest.approx(1.0, rel=0.05)
    # The autocorrelation of a Gaussian filter is a Gaussian with the variance doubled.
    for shift in (1, 3, 6):
        correlation = np.mean(noise * np.roll(noise, shift, axis=1)) / noise.var()
        assert correlation == pytest.approx(np.exp(-(shift**2) / 36.0), abs=0.05)


def test_stereo_has_no_matches_at_the_left_border_and_too_near():
    measured = np.isfinite(stereo(np.full(SHAPE, 0.5), **EXACT))
    columns = (np.arange(64) + 0.5) * 848 / 64
    np.testing.assert_array_equal(measured, np.tile(columns >= 424 * 0.05 / 0.5, (36, 1)))
    assert not np.isfinite(stereo(np.full(SHAPE, 0.16), **EXACT)).any()


def test_a_near_surface_hides_the_one_left_of_it():
    depth = np.full(SHAPE, 8.0)
    depth[:, 30:40] = 0.5
    hidden = ~np.isfinite(stereo(depth, **EXACT))
    shadow = 424 * 0.05 * (1 / 0.5 - 1 / 8.0) * 64 / 848  # [px]
    assert hidden[:, 10:].sum(axis=1) == pytest.approx(shadow, abs=1.0)
    assert hidden[:, 30 - int(shadow) : 30].all() and not hidden[:, 30:].any()


def test_unmeasured_pixels_stay_so():
    depth = np.full(SHAPE, 3.0)
    depth[0, 40:], depth[1, 40:] = 0.0, np.inf
    for seen in (stereo(depth), tof(depth, normal=1.0, noise=0.01)):
        np.testing.assert_array_equal(seen[:2, 40:], depth[:2, 40:])


def test_surfaces_that_are_too_near_are_not_far():
    depth = np.full(SHAPE, 0.12)
    depth[:, 30:34] = 0.0
    seen = tof(depth, mixing=0.5, mixed_pixels=1.0)
    assert seen.max() <= 0.121 and (seen[:, 30:34] == 0.0).all()
    depth = np.full(SHAPE, 8.0)
    depth[:, 30:40] = 0.0
    hidden = ~np.isfinite(stereo(depth, max_disparity=500.0, **EXACT))
    assert hidden[:, 20:30].all()


def test_a_concave_corner_recedes_by_its_sag_and_a_plane_and_an_edge_do_not():
    x, y = np.moveaxis(DEPTH_CAMERA.ray_slopes()[..., :2], 2, 0)
    plane = 3.0 / (1.0 + 0.4 * x + 0.3 * y)
    np.testing.assert_allclose(tof(plane, multipath=1.0), plane, rtol=1e-12)
    corner = 2.0 / (1.0 + np.abs(x))  # two walls at 45 degrees to the axis
    seen = tof(corner, multipath=0.5, multipath_angle=5.0)
    offset = round(32.0 * np.tan(np.radians(5.0))) / 32.0
    middle = np.abs(x) < 0.02
    sag = corner * (1.0 + np.maximum(np.abs(x), offset)) / (1.0 + np.abs(x)) - corner
    np.testing.assert_allclose((seen - corner)[middle], 0.5 * sag[middle], rtol=1e-9)
    away = np.abs(x) > offset + 0.05
    np.testing.assert_allclose(seen[away], corner[away], rtol=1e-9)
    convex = 2.0 / (1.0 - 0.5 * np.abs(x))
    np.testing.assert_allclose(tof(convex, multipath=0.5), convex, rtol=1e-12)
    step = np.where(x > 0.0, 1.0, 4.0)
    np.testing.assert_array_equal(tof(step, multipath=0.5), step)


def test_edges_have_mixed_pixels():
    step = np.tile(np.where(np.arange(64) < 32, 1.0, 4.0), (36, 1))
    seen = tof(step, mixing=0.25, mixed_pixels=0.5)
    np.testing.assert_allclose(seen[:, 31:33], 1.75)
    np.testing.assert_array_equal(np.delete(seen, [31, 32], 1), np.delete(step, [31, 32], 1))


def test_ambient_light_hides_far_surfaces():
    depth = np.full(SHAPE, 4.0)
    assert np.isfinite(tof(depth, ambient_range=4.1)).all()
    assert (tof(depth, ambient_range=3.9) == np.inf).all()
    assert (tof(depth, reflectivity=1.0, ambient_range=4.1, ambient_spread=0.1) == np.inf).all()
    np.testing.assert_allclose(tof(depth, normal=2.0, noise=0.01), 4.08)


def test_matching_measures_only_textured_planes_to_a_fifth_of_a_pixel():
    # A wall at 4 m, and a board at 1.5 m in front of its middle.
    camera, width = OnboardCamera(width=848, height=480), 848
    sensor = Stereo(width=width, matching=True)
    texture = np.random.default_rng(0).uniform(0, 255, (480, 2 * width)).astype(np.float32)
    texture = cv2.GaussianBlur(texture, (0, 0), 1.2)
    texture = cv2.normalize(texture, None, 0.0, 255.0, cv2.NORM_MINMAX)  # pyright: ignore
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(480, dtype=np.float32))
    board = (x > 300) & (x < 550)
    depth = np.where(board, 1.5, 4.0)

    def seen(near: np.ndarray, shifts: tuple[float, float]) -> np.ndarray:
        images = [
            cv2.remap(texture, x + np.float32(shift + start), y, cv2.INTER_CUBIC)
            for shift, start in zip(shifts, (0.0, 600.0), strict=True)
        ]
        return np.where(near, images[1], images[0]).clip(0, 255).astype(np.uint8)

    far, near = (424.0 * 0.05 / z for z in (4.0, 1.5))
    moved = (x + near > 300) & (x + near < 550)
    found = matched_depth(seen(board, (0, 0)), seen(moved, (far, near)), sensor, camera)
    disparity, exact = 424.0 * 0.05 / found, 424.0 * 0.05 / depth
    matched = np.isfinite(found)
    errors = np.abs(disparity - exact)[matched]
    assert matched.mean() > 0.9
    assert np.median(errors) < 0.2
    assert np.mean(errors > 1.0) < 0.03  # at the outline of the board
    # OpenCV matches multiples of 16 disparities.
    nearer = Stereo(width=width, matching=True, max_disparity=10.0)
    found = matched_depth(seen(board, (0, 0)), seen(moved, (far, near)), nearer, camera)
    assert np.isfinite(found)[~board].mean() > 0.8
    assert (found >= 424.0 * 0.05 / 10.0).all()
    gray = np.full((480, 848), 128, np.uint8)
    assert not np.isfinite(matched_depth(gray, gray, sensor, camera)).any()
