# A measure may be None; here a comparison with None is a failure of the test.
# pyright: reportOptionalOperand=false, reportOperatorIssue=false

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.systems.splats.background import RenderedView
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.metrics import (
    SceneRenderer,
    depth_mae_m,
    depth_relative,
    fit_exposure,
    floater_fraction,
    floaters,
    hole_fraction,
    mean_metric,
    measure_view,
    psnr_db,
    ssim,
)
from splatpilot.training.reconstruction.photometry import vignette

HEIGHT, WIDTH = 24, 32
K = np.array([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.8, (HEIGHT, WIDTH, 3))


@pytest.mark.parametrize(("difference", "expected"), [(0.1, 20.0), (0.01, 40.0), (1.0, 0.0)])
def test_psnr_of_a_known_difference(difference, expected):
    truth = np.zeros((HEIGHT, WIDTH, 3))
    assert psnr_db(truth + difference, truth) == pytest.approx(expected)
    assert psnr_db(truth, truth) == np.inf


def test_ssim_of_flat_images():
    a, b = np.full((64, 64, 3), 0.4), np.full((64, 64, 3), 0.6)
    luminance = (2 * 0.4 * 0.6 + 1e-4) / (0.4**2 + 0.6**2 + 1e-4)
    assert ssim(a, b) == pytest.approx(luminance, abs=0.03)
    assert ssim(a, a) == pytest.approx(1, abs=1e-6)
    assert ssim(noise(0), noise(1)) < 0.3


def test_depth_error_counts_pixels_with_true_depth():
    truth = np.array([[2.0, 4.0, 0.0, np.inf, 149.0, 200.0]], np.float32)
    depth = np.array([[2.5, 0.0, 9.0, 9.0, 148.0, 9.0]], np.float32)
    assert depth_mae_m(depth, truth) == pytest.approx((0.5 + 4 + 1) / 3)
    assert depth_relative(depth, truth) == pytest.approx((0.25 + 1 + 1 / 149) / 3)
    nothing = np.zeros((2, 2))
    assert depth_mae_m(nothing, nothing) is None
    assert depth_relative(nothing, nothing) is None
    assert floater_fraction(nothing, nothing) is None
    assert hole_fraction(nothing, nothing) is None


def test_floaters_stand_in_front_by_the_margin_and_cover():
    cases = [  # true depth, rendered depth, floater
        (0.5, 0.41, False),
        (0.5, 0.39, True),  # 0.1 m below 1 m
        (5.0, 4.51, False),
        (5.0, 4.49, True),  # 10 % above 1 m
        (5.0, 9.0, False),
        (5.0, 0.0, False),
        (5.0, 1.0, True),
        (0.0, 1.0, False),
        (np.inf, 1.0, False),
    ]
    truth, depth, expected = map(np.array, zip(*cases, strict=True))
    np.testing.assert_array_equal(floaters(depth, truth), expected.astype(bool))
    assert floater_fraction(depth, truth) == pytest.approx(3 / 7)


def test_holes_are_where_nothing_is_seen_of_something():
    truth = np.array([[2.0, 4.0, 3.0, 9.0, 0.0, np.inf]])
    depth = np.array([[2.0, 0.0, 1.0, 9.0, 0.0, 0.0]])
    assert hole_fraction(depth, truth) == pytest.approx(1 / 4)


def plane(distance: float, opacity: float = 0.99, size: float = 8.0) -> GaussianScene:
    """A plane of flat Gaussians across the optical axis of the camera at the origin."""
    x, y = (g.ravel() for g in np.meshgrid(*[np.arange(-size, size, 0.1)] * 2))
    count = len(x)
    return GaussianScene.from_colors(
        np.column_stack([x, y, np.full(count, distance)]),
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.tile([0.1, 0.1, 1e-4], (count, 1)),
        np.full(count, opacity),
        np.full((count, 3), 0.6),
    )


@pytest.mark.parametrize("representation", ["3dgs", "2dgs"])
def test_a_plane_in_front_is_all_floater(representation):
    camera = (K, WIDTH, HEIGHT, RigidTransform())
    truth = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    for distance, error, fraction in ((3.0, 0.0, 0.0), (2.5, 0.5, 1.0)):
        view = SceneRenderer(plane(distance), representation).render(*camera)
        assert view.alpha.min() > 0.99
        assert view.color == pytest.approx(np.full((HEIGHT, WIDTH, 3), 0.6), abs=0.01)
        assert depth_mae_m(view.depth, truth) == pytest.approx(error, abs=2e-3)
        assert floater_fraction(view.depth, truth) == fraction


@pytest.mark.parametrize("representation", ["3dgs", "2dgs"])
def test_both_representations_stand_where_the_camera_is_told(representation):
    X_WC = RigidTransform([0.3, -0.2, 1.0])
    view = SceneRenderer(plane(3.0), representation).render(K, WIDTH, HEIGHT, X_WC)
    np.testing.assert_allclose(view.depth, 2.0, atol=2e-3)


def test_exposure_is_fitted():
    scene = 0.5 * noise()
    truth = 1.4 * scene * vignette(-0.5, WIDTH, HEIGHT)[..., None]
    image, gain = fit_exposure(scene, truth, -0.5)
    assert gain == pytest.approx(1.4)
    np.testing.assert_allclose(image, truth, atol=1e-12)
    black, gain = fit_exposure(np.zeros_like(scene), truth, -0.5)
    assert gain == 1.0 and not black.any()
    other = noise(1)
    _, best = fit_exposure(scene, other, 0.0)
    errors = [np.sum((g * scene - other) ** 2) for g in (best - 0.01, best, best + 0.01)]
    assert errors[1] < min(errors[0], errors[2])


def test_measures_of_a_view():
    color = noise().astype(np.float32)
    exposed = 1.2 * color * vignette(-0.2, WIDTH, HEIGHT)[..., None]
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    image = np.round(255 * exposed).astype(np.uint8)
    near = depth.copy()
    near[:6] = 1.0  # a quarter
    view = RenderedView(color, near, np.ones_like(depth))
    frame = CaptureFrame(image, depth, RigidTransform(), K)
    found = measure_view(view, (0.0, 0.0, 0.0), frame, vignetting=-0.2)
    assert found.psnr_db > 50 and found.ssim > 0.999
    assert found.gain == pytest.approx(1.2, rel=1e-3)
    assert found.lpips is None
    assert found.depth_mae_m == pytest.approx(0.25)
    assert found.depth_relative == pytest.approx(0.125)
    assert found.floater_fraction == pytest.approx(0.25)
    assert found.hole_fraction == 0


def test_a_translucent_surface_is_a_hole():
    gray = (0.5, 0.5, 0.5)
    image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth[:12] = np.inf
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[12:, :16] = 0.4
    alpha[12:, 16:] = 1.0
    color = alpha[..., None] * np.float32([gray])
    seen = RenderedView(color, np.where(alpha > 0.5, depth, 0), alpha)
    frame = CaptureFrame(image, depth, RigidTransform(), K)
    found = measure_view(seen, gray, frame)
    assert found.hole_fraction == pytest.approx(0.5)
    assert found.depth_mae_m == pytest.approx(1.0)
    assert found.floater_fraction == 0
    assert found.psnr_db > 50
    assert found.psnr_on_black_db < 20
    solid = np.float32(alpha > 0)
    opaque = RenderedView(solid[..., None] * np.float32([gray]), depth, solid)
    assert measure_view(opaque, gray, frame).psnr_on_black_db > 50


def test_masked_pixels_are_not_measured():
    color = noise().astype(np.float32)
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[8:] = False
    image = np.round(255 * color).astype(np.uint8)
    image[~valid] = 255, 0, 0
    measured = np.where(valid, depth, 0)
    view = RenderedView(color, depth, np.ones_like(depth))
    frame = CaptureFrame(image, measured, RigidTransform(), K, valid)
    found = measure_view(view, (0.0, 0.0, 0.0), frame)
    assert found.psnr_db > 50 and found.gain == pytest.approx(1, abs=1e-3)
    assert found.unseen_fraction == pytest.approx(1 - valid.mean())
    seen = np.zeros_like(valid)
    seen[4:12] = True
    half = measure_view(view, (0.0, 0.0, 0.0), frame, seen=seen)
    assert half.psnr_db > 50
    assert half.unseen_fraction == pytest.approx(1 - (seen & valid).mean())


def test_what_no_camera_saw_is_left_out():
    color = noise().astype(np.float32)
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    frame = CaptureFrame(np.round(255 * color).astype(np.uint8), depth, RigidTransform(), K)
    seen = np.ones((HEIGHT, WIDTH), bool)
    seen[:6] = False
    wrong = RenderedView(
        *(
            np.where(seen.reshape(x.shape[:2] + (1,) * (x.ndim - 2)), x, 0)
            for x in (color, depth, np.ones_like(depth))
        )
    )
    found = measure_view(wrong, (0.0, 0.0, 0.0), frame, seen=seen)
    assert found.psnr_db > 50 and found.psnr_on_black_db > 50
    assert (found.depth_mae_m, found.hole_fraction) == (0, 0)
    assert found.unseen_fraction == pytest.approx(0.25)
    assert found.gain == pytest.approx(1, abs=1e-3)
    everything = measure_view(wrong, (0.0, 0.0, 0.0), frame)
    assert everything.hole_fraction == pytest.approx(0.25)
    assert everything.unseen_fraction == 0
    assert 0.8 < everything.ssim + 0.1 < found.ssim  # windows reach over what is left out


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_pixels_that_are_left_out_make_no_structure_right(share):
    a, b = noise(0), noise(1)
    seen = np.random.default_rng(2).random((HEIGHT, WIDTH)) >= share
    assert ssim(a, b, seen) == pytest.approx(ssim(a, b), abs=0.03)


def make_view(color: np.ndarray, image: np.ndarray) -> tuple[RenderedView, CaptureFrame]:
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    view = RenderedView(color.astype(np.float32), depth, np.ones_like(depth))
    return view, CaptureFrame(np.round(255 * image).astype(np.uint8), depth, RigidTransform(), K)


def test_a_view_of_which_nothing_was_seen_has_no_measures():
    view, frame = make_view(noise(0), noise(1))
    nothing = np.zeros((HEIGHT, WIDTH), bool)
    blind = measure_view(view, (0.0, 0.0, 0.0), frame, seen=nothing, lpips=never)
    seeing = measure_view(view, (0.0, 0.0, 0.0), frame)
    assert {blind.psnr_db, blind.psnr_on_black_db, blind.ssim, blind.lpips} == {None}
    assert {blind.depth_mae_m, blind.floater_fraction, blind.hole_fraction} == {None}
    assert (blind.unseen_fraction, blind.gain) == (1.0, 1.0)
    for name in ("psnr_db", "ssim", "depth_mae_m"):
        assert mean_metric([blind, seeing], name) == (getattr(seeing, name), 1)
    assert mean_metric([blind], "psnr_db") == (None, 0)


def never(*_args) -> None:
    raise AssertionError("measured")


def test_without_a_gain_brightness_counts():
    view, frame = make_view(np.full((HEIGHT, WIDTH, 3), 0.4), np.full((HEIGHT, WIDTH, 3), 0.5))
    strict = measure_view(view, (0.0, 0.0, 0.0), frame, fit_gain=False)
    fitted = measure_view(view, (0.0, 0.0, 0.0), frame)
    assert strict.gain == 1.0
    assert strict.psnr_db == pytest.approx(20.0, abs=0.2)
    assert fitted.psnr_db > 50 and fitted.gain == pytest.approx(1.25, rel=0.01)


def test_lpips_is_of_the_exposed_image():
    color = noise().astype(np.float32)
    image = np.round(255 * 1.2 * color).astype(np.uint8)
    depth = np.ones((HEIGHT, WIDTH), np.float32)
    view = RenderedView(color, depth, np.ones((HEIGHT, WIDTH)))
    frame = CaptureFrame(image, depth, RigidTransform(), K)

    def difference(a, b, weights):
        assert a.shape == (HEIGHT, WIDTH, 3) and (weights == 1).all()
        return (a - b).abs().max()

    found = measure_view(view, (0.0, 0.0, 0.0), frame, lpips=difference)
    assert found.lpips == pytest.approx(0, abs=0.01)
