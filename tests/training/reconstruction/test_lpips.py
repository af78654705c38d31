import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.nn.functional import conv2d, max_pool2d

from splatpilot.training.reconstruction.lpips import Lpips, squeezenet_features


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
def lpips(file) -> Lpips:
    return Lpips()


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
    message = r"no weights.*lpips_squeeze\.pt.*pip install lpips"
    with pytest.raises(FileNotFoundError, match=message):
        Lpips()
    monkeypatch.delenv("SPLATPILOT_DATA")
    with pytest.raises(FileNotFoundError, match=message):
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


@pytest.mark.parametrize("shape", [(16, 40, 3), (40, 40, 4), (40, 40)])
def test_bad_images(lpips, shape):
    with pytest.raises(ValueError, match=r"images must be .* at least 17 pixels, got \("):
        lpips(torch.zeros(shape), torch.zeros(shape))


@pytest.mark.skipif("SPLATPILOT_DATA" not in os.environ, reason="SPLATPILOT_DATA is not set")
def test_blur_is_worse_than_brightness_of_the_same_error():
    folder = Path(os.environ["SPLATPILOT_DATA"]) / "tartanair" / "hospital" / "image_left"
    image = cv2.imread(str(folder / "000020_left.png"))[::2, ::2, ::-1] / 255
    blurred = cv2.GaussianBlur(image, (0, 0), 2)
    brighter = image + np.sqrt(((blurred - image) ** 2).mean())
    a, b, c = (torch.from_numpy(x.astype(np.float32)) for x in (image, blurred, brighter))
    lpips = Lpips()
    assert lpips(b, a) > 5 * lpips(c, a) > 0


def test_nothing_large_is_imported(file):
    script = (
        "import sys, torch; from splatpilot.training.reconstruction.lpips import Lpips\n"
        "Lpips()(torch.rand(20, 20, 3), torch.rand(20, 20, 3))\n"
        "sys.exit(bool({'torchvision', 'triton'} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
