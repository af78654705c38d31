"""Whether Drake's OpenGL renderer works."""

import subprocess
import sys

import pytest

from splatpilot.systems.common.extras import require_opengl

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


def test_missing_driver_is_an_error_that_says_what_to_install(opengl, monkeypatch):
    """Without any EGL driver, the answer is an error and not the end of the process."""
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
    """Mesa's LLVM does not get into the way of the one that torch's optimisers load."""
    program = CAMERA + engine + TRAINING
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
