"""Whether Drake's OpenGL renderer works on this machine."""

import subprocess
import sys
from functools import cache

_PROBE = """
from pydrake.geometry import *
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo, ImageRgba8U
core = RenderCameraCore("", CameraInfo(8, 8, 1.0), ClippingRange(0.1, 1), RigidTransform())
MakeRenderEngineVtk(RenderEngineVtkParams()).RenderColorImage(
    ColorRenderCamera(core), ImageRgba8U(8, 8)
)
"""


@cache
def require_opengl() -> None:
    """Checks that RenderEngineVtk can render; a library that is missing may end the process, so
    another process tries.

    Raises:
        OSError: if it cannot; the message says what to install.
    """
    probe = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, text=True)
    if probe.returncode:
        reason = (probe.stderr.strip().splitlines() or [f"exit status {probe.returncode}"])[-1]
        raise OSError(
            f"RenderEngineVtk cannot render here ({reason}); on Debian, apt install libegl1 "
            "libegl-mesa0 libgl1-mesa-dri libglib2.0-0 libx11-6 libsm6"
        )
