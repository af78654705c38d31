"""Packages that only parts of splatpilot need, and the extras of `pip install` that bring them."""

import re
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib import import_module
from types import ModuleType


def import_extra(module: str, extra: str) -> ModuleType:
    """Imports a module that the extra brings.

    Raises:
        ModuleNotFoundError: a package is not installed; the message says which extra brings it.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{error.name} is not installed; pip install 'splatpilot[{extra}]'", name=error.name
        ) from None


def missing_extra(error: ModuleNotFoundError, needed_by: str) -> str | None:
    """
    What to install for something that an import has failed for.

    Returns:
        A sentence with the extra that brings the missing package, as `pyproject.toml` has it; None
        if no extra does.
    """
    for extra, packages in packages_of_extras().items():
        if error.name in packages:
            return f"{needed_by} needs {error.name}; pip install 'splatpilot[{extra}]'"
    return None


def packages_of_extras() -> dict[str, list[str]]:
    """The packages that each extra for users brings, as `pyproject.toml` has them."""
    from importlib.metadata import requires  # Slow to load, and seldom needed.

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
