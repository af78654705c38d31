import subprocess
import sys

import pytest
from hypothesis import settings

# The same examples in every run, and no failure because the machine was busy.
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")

PROBE = """
from pydrake.geometry import *
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo, ImageRgba8U
core = RenderCameraCore("", CameraInfo(8, 8, 1.0), ClippingRange(0.1, 1), RigidTransform())
MakeRenderEngineVtk(RenderEngineVtkParams()).RenderColorImage(
    ColorRenderCamera(core), ImageRgba8U(8, 8)
)
"""


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skips what needs RenderEngineVtk where that cannot render. A library that is missing may end
    the process, so another process tries.
    """
    probe = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True)
    if probe.returncode:
        reason = (probe.stderr.strip().splitlines() or [f"exit status {probe.returncode}"])[-1]
        pytest.skip(
            f"RenderEngineVtk cannot render here ({reason}); on Debian install libegl1 "
            "libegl-mesa0 libgl1-mesa-dri libglib2.0-0 libx11-6 libsm6"
        )
