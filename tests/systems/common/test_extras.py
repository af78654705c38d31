import subprocess
import sys

import pytest

from splatpilot.systems.common.extras import import_extra, missing_extra, require_opengl

CAMERA = """
from pydrake.geometry import *
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo, ImageRgba8U
core = RenderCameraCore("", CameraInfo(8, 8, 1.0), ClippingRange(0.1, 1), RigidTransform())
camera = ColorRenderCamera(core)
"""
MESHES = """
from splatpilot.systems.common.extras import require_opengl
require_opengl()
engine = MakeRenderEngineVtk(RenderEngineVtkParams())
"""
SPLATS = """
import numpy as np
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.render_engine import SplatRenderEngine
rows = [np.ones(shape, np.float32) for shape in ((1, 3), (1, 4), (1, 3), (1,), (1, 1, 3))]
engine = SplatRenderEngine(BakedScene(GaussianScene(*rows)))
"""
TRAINING = """
engine.RenderColorImage(camera, ImageRgba8U(8, 8))
import torch
weights = torch.nn.Parameter(torch.zeros(2))
weights.sum().backward()
torch.optim.Adam([weights]).step()
"""


def test_missing_package_says_which_extra_brings_it():
    assert import_extra("json", "train").loads("1") == 1
    message = r"^absent_package is not installed; pip install 'splatpilot\[photos\]'$"
    with pytest.raises(ModuleNotFoundError, match=message) as caught:
        import_extra("absent_package.part", "photos")
    assert caught.value.name == "absent_package"


@pytest.mark.parametrize(
    ("package", "extra"),
    [
        ("torch", "train"),
        ("torchvision", "train"),
        ("pycolmap", "photos"),
        ("gsplat", "cuda"),
        ("distributed", "cluster"),
        ("tensorboard", "tensorboard"),
    ],
)
def test_missing_extra_names_the_one_that_brings_a_package(package, extra):
    error = ModuleNotFoundError(name=package)
    expected = f"reconstruct needs {package}; pip install 'splatpilot[{extra}]'"
    assert missing_extra(error, "reconstruct") == expected


@pytest.mark.parametrize("package", ["numpy", "absent_package", None])
def test_no_extra_brings_what_flying_needs(package):
    assert missing_extra(ModuleNotFoundError(name=package), "reconstruct") is None


def test_missing_driver_is_an_error_that_says_what_to_install(opengl, monkeypatch):
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")
    monkeypatch.setenv("DISPLAY", "")
    require_opengl.cache_clear()
    try:
        with pytest.raises(OSError, match="apt install libegl1"):
            require_opengl()
    finally:
        require_opengl.cache_clear()


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("engine", [MESHES, SPLATS])
def test_torch_trains_after_a_picture(engine):
    program = CAMERA + engine + TRAINING
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
