# A metric may be None; here a comparison with None is a failure of the test.
# pyright: reportOptionalOperand=false, reportOperatorIssue=false

import importlib
import os
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform
from torch.nn.functional import conv2d, max_pool2d

from splatpilot.systems.splats.background import RenderedView
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction import metrics
from splatpilot.training.reconstruction.metrics import Lpips, squeezenet_features
from splatpilot.training.reconstruction.photometry import vignette

HEIGHT, WIDTH = 24, 32
K = np.array([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])
DEPTH = np.full((HEIGHT, WIDTH), 2.0, np.float32)
EVERYWHERE = np.ones((HEIGHT, WIDTH), bool)


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.8, (HEIGHT, WIDTH, 3))


def test_ssim():
    assert metrics.ssim(noise(), noise(), EVERYWHERE) == pytest.approx(1, abs=1e-6)
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
    # 0.1 m below 1 m, and 10 % above.
    truth = np.array([0.5, 0.5, 5.0, 5.0, 5.0, 5.0, 5.0, 0.0, np.inf])
    depth = np.array([0.41, 0.39, 4.51, 4.49, 9.0, 0.0, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(np.flatnonzero(metrics.floaters(depth, truth)), [1, 3, 6])
    assert metrics.depth_metrics(depth, truth)["floater_fraction"] == pytest.approx(3 / 7)


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
    assert found.gain == pytest.approx(1.2, rel=1e-3) and found.lpips is None
    assert found.depth_mae_m == found.floater_fraction == pytest.approx(0.25)
    assert found.depth_relative == pytest.approx(0.125) and found.hole_fraction == 0


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


@pytest.fixture(scope="module")
def weights() -> dict:
    """Random weights in the layout of the file, of a size that keeps features alive."""
    generator = torch.Generator().manual_seed(0)
    backbone = {
        f"features.{name}": torch.zeros(w.shape)
        if w.ndim == 1
        else (2 * torch.rand(w.shape, generator=generator) - 1) * (6 / w[0].numel()) ** 0.5
        for name, w in squeezenet_features().state_dict().items()
    }
    linear = {
        f"lin{i}.model.1.weight": torch.rand(1, n, 1, 1, generator=generator)
        for i, n in enumerate((64, 128, 256, 384, 384, 512, 512))
    }
    return {"squeezenet1_1": backbone, "lin": linear}


@pytest.fixture
def file(tmp_path, monkeypatch, weights) -> Path:
    """The file of weights in the folder of data."""
    file = tmp_path / "weights" / "lpips_squeeze.pt"
    file.parent.mkdir()
    torch.save(weights, file)
    monkeypatch.setenv("SPLATPILOT_DATA", str(tmp_path))
    return file


@pytest.fixture
def lpips(file, monkeypatch) -> Lpips:
    monkeypatch.setitem(sys.modules, "torchvision", None)  # which takes seconds to import
    return importlib.reload(metrics).Lpips()


def reference(weights: dict, a: torch.Tensor, b: torch.Tensor) -> float:
    """LPIPS v0.1 of two images (H, W, 3), written out layer by layer."""
    w = weights["squeezenet1_1"]

    def layer(x, name, padding=0, stride=1):
        weight, bias = w[f"features.{name}.weight"], w[f"features.{name}.bias"]
        return conv2d(x, weight, bias, padding=padding, stride=stride).clamp(min=0)

    def features(image):
        # Images in [-1, 1], shifted and scaled as LPIPS v0.1 does.
        shift = torch.tensor([-0.030, -0.088, -0.188])
        scale = torch.tensor([0.458, 0.448, 0.450])
        x = (((2 * image - 1) - shift) / scale).permute(2, 0, 1)[None]
        x = layer(x, "0", stride=2)
        found = [x]
        for i in range(2, 13):
            if i in (2, 5, 8):
                x = max_pool2d(x, 3, stride=2, ceil_mode=True)
            else:
                x = layer(x, f"{i}.squeeze")
                wide = layer(x, f"{i}.expand3x3", padding=1)
                x = torch.cat([layer(x, f"{i}.expand1x1"), wide], dim=1)
            if i in (4, 7, 9, 10, 11, 12):
                found.append(x)
        return [f / (f.norm(dim=1, keepdim=True) + 1e-10) for f in found]

    total = 0.0
    for i, (x, y) in enumerate(zip(features(a), features(b), strict=True)):
        lin = weights["lin"][f"lin{i}.model.1.weight"]
        total += float(((x - y) ** 2 * lin).sum(dim=1).mean())
    return total


def images(height: int = 40, width: int = 51) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    a = torch.rand(height, width, 3, generator=generator)
    return a, (a + 0.2 * torch.rand(height, width, 3, generator=generator)).clamp(0, 1)


def test_distance_is_that_of_the_definition(weights, lpips):
    a, b = images()
    expected = reference(weights, a, b)
    assert expected > 1e-3
    assert lpips(a, b).item() == pytest.approx(expected, rel=1e-4)
    assert lpips(a, a).item() == 0 and lpips(a.requires_grad_(), b).requires_grad
    pairs = lpips(torch.stack([a, a]), torch.stack([b, b.flip(0)]))
    assert pairs.item() == pytest.approx((lpips(a, b) + lpips(a, b.flip(0))).item() / 2, rel=1e-5)
    for shape in ((16, 40, 3), (40, 40, 4), (40, 40)):
        with pytest.raises(ValueError, match=r"images must be .* at least 17 pixels, got \("):
            lpips(torch.zeros(shape), torch.zeros(shape))


def test_pixels_without_weight_hardly_count(lpips):
    a, b = images(64, 96)
    left = torch.zeros(64, 96)
    left[:, :48] = 1.0
    differs_right = torch.cat([a[:, :64], b[:, 64:]], dim=1)
    everywhere = lpips(a, b, torch.ones(64, 96))
    assert everywhere.item() == pytest.approx(lpips(a, b).item(), rel=1e-6)
    assert lpips(a, differs_right, left) < 0.2 * lpips(a, differs_right)


def test_missing_weights(tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATPILOT_DATA", str(tmp_path))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    with pytest.raises(FileNotFoundError, match=r"no weights.*lpips_squeeze\.pt.*pip install lp"):
        Lpips()


def test_weights_of_torchvision_and_the_package(tmp_path, monkeypatch, weights):
    monkeypatch.delenv("SPLATPILOT_DATA", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    checkpoints = tmp_path / "torch" / "hub" / "checkpoints"
    checkpoints.mkdir(parents=True)
    with_classifier = weights["squeezenet1_1"] | {"classifier.1.bias": torch.zeros(1000)}
    torch.save(with_classifier, checkpoints / "squeezenet1_1-b8a52dc0.pth")
    layers = tmp_path / "packages" / "lpips" / "weights" / "v0.1"
    layers.mkdir(parents=True)
    torch.save(weights["lin"], layers / "squeeze.pth")
    (tmp_path / "packages" / "lpips" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path / "packages"))
    a, b = images()
    assert Lpips()(a, b).item() == pytest.approx(reference(weights, a, b), rel=1e-4)


@pytest.mark.parametrize("content", [b"x", None])
def test_other_files_are_refused(file, weights, content):
    if content is None:
        torch.save({"squeezenet1_1": weights["lin"], "lin": weights["lin"]}, file)
    else:
        file.write_bytes(content)
    with pytest.raises(ValueError, match=r"lpips_squeeze\.pt: no LPIPS-squeeze weights"):
        Lpips()


@pytest.mark.skipif("SPLATPILOT_DATA" not in os.environ, reason="SPLATPILOT_DATA is not set")
def test_blur_is_worse_than_brightness_of_the_same_error():
    folder = Path(os.environ["SPLATPILOT_DATA"]) / "tartanair" / "hospital" / "image_left"
    image = cv2.imread(str(folder / "000020_left.png"))[::2, ::2, ::-1] / 255
    blurred = cv2.GaussianBlur(image, (0, 0), 2)
    brighter = image + np.sqrt(((blurred - image) ** 2).mean())
    a, b, c = (torch.from_numpy(x.astype(np.float32)) for x in (image, blurred, brighter))
    lpips = Lpips()
    assert lpips(b, a) > 5 * lpips(c, a) > 0


def test_exposure_is_the_least_squares_fit():
    scene, truth = 0.5 * noise(), noise(1)
    black, gain = metrics.fit_exposure(np.zeros_like(scene), truth, -0.5, EVERYWHERE)
    assert gain == 1.0 and not black.any()
    _, best = metrics.fit_exposure(scene, truth, 0.0, EVERYWHERE)
    errors = [np.sum((g * scene - truth) ** 2) for g in (best - 0.01, best, best + 0.01)]
    assert errors[1] < min(errors[0], errors[2])
