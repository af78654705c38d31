"""Whether Drake's OpenGL renderer works on this machine."""

import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib import import_module

_PROBE = """
from pydrake.geometry import *
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo, ImageRgba8U
core = RenderCameraCore("", CameraInfo(8, 8, 1.0), ClippingRange(0.1, 1), RigidTransform())
MakeRenderEngineVtk(RenderEngineVtkParams()).RenderColorImage(
    ColorRenderCamera(core), ImageRgba8U(8, 8)
)
"""


def load_triton() -> None:
    """Loads Triton, where it is installed, before OpenGL brings Mesa's LLVM for the whole process
    to see: Triton, which torch's optimisers load, has an LLVM of its own, and would take Mesa's
    functions for it and end the process.
    """
    with suppress(ImportError):
        import_module("triton")


@cache
def require_opengl() -> None:
    """Checks that RenderEngineVtk can render, and sees to it that torch still can be used when it
    has (see `load_triton`). A library that is missing may end the process, so another one tries.

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
    load_triton()
