"""Optional packages and the extras of `pip install` that bring them; the OpenGL renderer."""

import re
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib import import_module
from types import ModuleType


def import_extra(module: str, extra: str) -> ModuleType:
    """Imports a module that an extra brings; its ModuleNotFoundError names the extra."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        message = f"{error.name} is not installed; pip install 'splatpilot[{extra}]'"
        raise ModuleNotFoundError(message, name=error.name) from None


def missing_extra(error: ModuleNotFoundError, needed_by: str) -> str | None:
    """Returns a sentence with the extra that brings a missing package, None if no extra does."""
    for extra, packages in packages_of_extras().items():
        if error.name in packages:
            return f"{needed_by} needs {error.name}; pip install 'splatpilot[{extra}]'"
    return None


def packages_of_extras() -> dict[str, list[str]]:
    """Returns the packages that each extra for users brings."""
    from importlib.metadata import requires  # slow to load

    packages: dict[str, list[str]] = {}
    for requirement in requires("splatpilot") or []:
        match = re.fullmatch(r"([\w.-]+).*extra == ['\"](\w+)['\"].*", requirement)
        if match is not None and match[1] != "splatpilot" and match[2] != "dev":
            packages.setdefault(match[2], []).append(match[1])
    return packages


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
    """Loads Triton, if it is installed, before OpenGL loads Mesa's LLVM.

    Triton, which torch's optimizers load, has its own LLVM and crashes with the symbols of Mesa's.
    """
    with suppress(ImportError):
        import_module("triton")


@cache
def require_opengl() -> None:
    """Checks in another process that RenderEngineVtk can render; loads Triton before it does."""
    probe = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, text=True)
    if probe.returncode:
        reason = (probe.stderr.strip().splitlines() or [f"exit status {probe.returncode}"])[-1]
        raise OSError(
            f"RenderEngineVtk cannot render here ({reason}); on Debian, apt install libegl1 "
            "libegl-mesa0 libgl1-mesa-dri libglib2.0-0 libx11-6 libsm6"
        )
    load_triton()
