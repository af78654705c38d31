# A metric may be None; here a comparison with None is a failure of the test.
# pyright: reportOptionalOperand=false, reportOperatorIssue=false

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.systems.splats.background import RenderedView
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction import metrics
from splatpilot.training.reconstruction.photometry import vignette
from splatpilot.training.reconstruction.splat_rendering import SceneRenderer

HEIGHT, WIDTH = 24, 32
K = np.array([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])
DEPTH = np.full((HEIGHT, WIDTH), 2.0, np.float32)
EVERYWHERE = np.ones((HEIGHT, WIDTH), bool)


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.8, (HEIGHT, WIDTH, 3))


def test_ssim():
    a, b = np.full((64, 64, 3), 0.4), np.full((64, 64, 3), 0.6)
    everywhere = np.ones((64, 64), bool)
    luminance = (2 * 0.4 * 0.6 + 1e-4) / (0.4**2 + 0.6**2 + 1e-4)
    assert metrics.ssim(a, b, everywhere) == pytest.approx(luminance, abs=0.03)
    assert metrics.ssim(a, a, everywhere) == pytest.approx(1, abs=1e-6)
    whole = metrics.ssim(noise(0), noise(1), EVERYWHERE)
    assert whole < 0.3
    for fraction in (0.2, 0.5, 0.8):
        part = np.random.default_rng(2).random((HEIGHT, WIDTH)) >= fraction
        assert metrics.ssim(noise(0), noise(1), part) == pytest.approx(whole, abs=0.03)


def test_depth_metrics_are_over_pixels_with_true_depth():
    assert metrics.psnr_db(np.full((2, 2, 3), 0.1), np.zeros((2, 2, 3))) == pytest.approx(20.0)
    truth = np.array([[2.0, 4.0, 0.0, np.inf, 149.0, 200.0]], np.float32)
    depth = np.array([[2.5, 0.0, 9.0, 9.0, 148.0, 9.0]], np.float32)
    assert metrics.depth_metrics(depth, truth) == pytest.approx(
        {
            "depth_mae_m": (0.5 + 4 + 1) / 3,
            "depth_relative": (0.25 + 1 + 1 / 149) / 3,
            "floater_fraction": 0.0,
            "hole_fraction": 1 / 3,
        }
    )
    assert set(metrics.depth_metrics(np.zeros((2, 2)), np.zeros((2, 2))).values()) == {None}


def test_floaters_are_in_front_by_the_margin():
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
    np.testing.assert_array_equal(metrics.floaters(depth, truth), expected.astype(bool))
    assert metrics.depth_metrics(depth, truth)["floater_fraction"] == pytest.approx(3 / 7)


def plane(z: float) -> GaussianScene:
    """A plane of flat Gaussians across the optical axis."""
    x, y = (g.ravel() for g in np.meshgrid(*[np.arange(-8, 8, 0.1)] * 2))
    count = len(x)
    return GaussianScene.from_colors(
        np.column_stack([x, y, np.full(count, z)]),
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.tile([0.1, 0.1, 1e-4], (count, 1)),
        np.full(count, 0.99),
        np.full((count, 3), 0.6),
    )


@pytest.mark.parametrize("representation", ["3dgs", "2dgs"])
def test_a_plane_in_front_is_all_floater(representation):
    X_WC = RigidTransform([0.3, -0.2, 1.0])
    truth = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    for z, error, fraction in ((4.0, 0.0, 0.0), (3.5, 0.5, 1.0)):
        view = SceneRenderer(plane(z), representation).render(K, WIDTH, HEIGHT, X_WC)
        assert view.alpha.min() > 0.99
        assert view.color == pytest.approx(np.full((HEIGHT, WIDTH, 3), 0.6), abs=0.01)
        found = metrics.depth_metrics(view.depth, truth)
        assert found["depth_mae_m"] == pytest.approx(error, abs=2e-3)
        assert found["floater_fraction"] == fraction


def test_exposure_is_the_least_squares_fit():
    scene, truth = 0.5 * noise(), noise(1)
    black, gain = metrics.fit_exposure(np.zeros_like(scene), truth, -0.5, EVERYWHERE)
    assert gain == 1.0 and not black.any()
    _, best = metrics.fit_exposure(scene, truth, 0.0, EVERYWHERE)
    errors = [np.sum((g * scene - truth) ** 2) for g in (best - 0.01, best, best + 0.01)]
    assert errors[1] < min(errors[0], errors[2])


def make_view(
    color: np.ndarray, image: np.ndarray, depth: np.ndarray = DEPTH, truth: np.ndarray = DEPTH
) -> tuple[RenderedView, tuple[float, float, float], CaptureFrame]:
    """The view of a scene before black, and the frame of its camera."""
    view = RenderedView(color.astype(np.float32), depth, np.ones_like(depth))
    pixels = np.round(255 * image).astype(np.uint8)
    return view, (0.0, 0.0, 0.0), CaptureFrame(pixels, truth, RigidTransform(), K)


def test_metrics_of_a_view():
    color = noise().astype(np.float32)
    exposed = 1.2 * color * vignette(-0.2, WIDTH, HEIGHT)[..., None]
    near = DEPTH.copy()
    near[:6] = 1.0  # a quarter
    found = metrics.measure_view(*make_view(color, exposed, near), vignetting=-0.2)
    assert found.psnr_db > 50 and found.ssim > 0.999
    assert found.gain == pytest.approx(1.2, rel=1e-3)
    assert found.lpips is None
    assert found.depth_mae_m == pytest.approx(0.25)
    assert found.depth_relative == pytest.approx(0.125)
    assert found.floater_fraction == pytest.approx(0.25)
    assert found.hole_fraction == 0


def test_a_translucent_surface_is_a_hole():
    gray = (0.5, 0.5, 0.5)
    truth = DEPTH.copy()
    truth[:12] = np.inf
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[12:, :16] = 0.4
    alpha[12:, 16:] = 1.0
    color = alpha[..., None] * np.float32([gray])
    seen = RenderedView(color, np.where(alpha > 0.5, truth, 0), alpha)
    frame = make_view(color, np.full((HEIGHT, WIDTH, 3), 0.5), truth=truth)[-1]
    found = metrics.measure_view(seen, gray, frame)
    assert found.hole_fraction == pytest.approx(0.5)
    assert found.depth_mae_m == pytest.approx(1.0)
    assert found.floater_fraction == 0
    assert found.psnr_db > 50
    assert found.psnr_on_black_db < 20
    solid = np.float32(alpha > 0)
    opaque = RenderedView(solid[..., None] * np.float32([gray]), truth, solid)
    assert metrics.measure_view(opaque, gray, frame).psnr_on_black_db > 50


def test_invalid_and_unseen_pixels_are_not_measured():
    valid, seen = (np.ones((HEIGHT, WIDTH), bool) for _ in "ab")
    valid[18:], seen[:6] = False, False
    used = valid & seen
    color = noise()
    image = np.where(used[..., None], color, (1, 0, 1))
    view, black, frame = make_view(color, image, np.where(used, DEPTH, 0))
    frame = replace(frame, valid=valid)
    found = metrics.measure_view(view, black, frame, seen=seen)
    assert found.psnr_db > 50 and found.psnr_on_black_db > 50
    assert (found.depth_mae_m, found.hole_fraction) == (0, 0)
    assert found.unseen_fraction == pytest.approx(0.5)
    assert found.gain == pytest.approx(1, abs=1e-3)
    everything = metrics.measure_view(view, black, frame)
    assert everything.hole_fraction == pytest.approx(1 / 3)
    assert everything.unseen_fraction == pytest.approx(0.25)
    assert everything.ssim + 0.1 < found.ssim < 0.9  # windows reach over what is left out


def test_an_unseen_view_has_no_metrics():
    def never(*_args) -> None:
        raise AssertionError("measured")

    view = make_view(noise(0), noise(1))
    blind = metrics.measure_view(*view, seen=~EVERYWHERE, lpips=never)
    seeing = metrics.measure_view(*view)
    assert {blind.psnr_db, blind.psnr_on_black_db, blind.ssim, blind.lpips} == {None}
    assert {blind.depth_mae_m, blind.floater_fraction, blind.hole_fraction} == {None}
    assert (blind.unseen_fraction, blind.gain) == (1.0, 1.0)
    for name in ("psnr_db", "ssim", "depth_mae_m"):
        assert metrics.mean_metric([blind, seeing], name) == (getattr(seeing, name), 1)
    assert metrics.mean_metric([blind], "psnr_db") == (None, 0)


def test_strict_metrics_fit_nothing_to_the_image():
    def difference(a, b, weights):
        assert a.shape == (HEIGHT, WIDTH, 3) and (weights == 1).all()
        return (a - b).abs().max()

    # A gray scene of half the brightness that the camera is known to have, with one black quarter
    # that nothing covers: the error is 0 elsewhere, and the image itself there.
    color = np.full((HEIGHT, WIDTH, 3), 0.25)
    color[:12, :16] = 0
    shade = vignette(-0.3, WIDTH, HEIGHT)[..., None]
    view = make_view(color, np.full((HEIGHT, WIDTH, 3), 0.5) * shade)
    strict = metrics.measure_view(*view, -0.3, lpips=difference, gain=2.0)
    error = np.mean(np.square(0.5 * shade[:12, :16])) / 4
    assert strict.psnr_db == pytest.approx(-10 * np.log10(error), abs=0.02)
    assert strict.lpips == pytest.approx(0.5 * shade[:12, :16].max(), abs=0.01)
    assert (strict.gain, strict.unseen_fraction) == (2.0, 0.0)
    other = metrics.measure_view(*view, -0.3, gain=1.0)
    error += 3 / 4 * np.mean(np.square(0.25 * np.broadcast_to(shade, color.shape)[color > 0]))
    assert other.psnr_db == pytest.approx(-10 * np.log10(error), abs=0.02)
    seen = color[..., 0] > 0
    fitted = metrics.measure_view(*view, -0.3, seen)
    assert fitted.gain == pytest.approx(2.0, rel=0.01) and fitted.psnr_db > 50
