import subprocess
import sys
from types import SimpleNamespace

import pytest

from splatpilot.systems.common import extras
from splatpilot.systems.common.extras import import_extra, missing_extra, require_opengl

PICTURE = """
import numpy as np
from pydrake.geometry import *
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo, ImageRgba8U
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.render_engine import SplatRenderEngine
core = RenderCameraCore("", CameraInfo(8, 8, 1.0), ClippingRange(0.1, 1), RigidTransform())
rows = [np.ones(shape, np.float32) for shape in ((1, 3), (1, 4), (1, 3), (1,), (1, 1, 3))]
engine = SplatRenderEngine(BakedScene(GaussianScene(*rows)))
engine.RenderColorImage(ColorRenderCamera(core), ImageRgba8U(8, 8))
import triton._C.libtriton  # Optimizers of torch load it.
"""


def test_missing_package_says_which_extra_brings_it():
    assert import_extra("json", "train").loads("1") == 1
    message = r"^absent_package is not installed; pip install 'splatpilot\[photos\]'$"
    with pytest.raises(ModuleNotFoundError, match=message) as caught:
        import_extra("absent_package.part", "photos")
    assert caught.value.name == "absent_package"


@pytest.mark.parametrize(
    ("package", "extra"),
    [("torchvision", "train"), ("gsplat", "cuda"), ("numpy", ""), ("absent", ""), (None, "")],
)
def test_missing_extra_names_the_one_that_brings_a_package(package, extra):
    expected = f"reconstruct needs {package}; pip install 'splatpilot[{extra}]'"
    error = ModuleNotFoundError(name=package)
    assert missing_extra(error, "reconstruct") == (expected if extra else None)


def test_missing_driver_is_an_error_that_says_what_to_install(opengl, monkeypatch):
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")
    monkeypatch.setenv("DISPLAY", "")
    with pytest.raises(OSError, match="apt install libegl1"):
        require_opengl.__wrapped__()


def test_triton_is_loaded_before_opengl_renders(monkeypatch):
    loaded = []
    monkeypatch.setattr(extras, "load_triton", lambda: loaded.append("triton"))
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=0))
    require_opengl.__wrapped__()
    assert loaded == ["triton"]


@pytest.mark.usefixtures("opengl")
def test_triton_loads_after_a_picture():
    pytest.importorskip("triton")
    done = subprocess.run([sys.executable, "-c", PICTURE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
