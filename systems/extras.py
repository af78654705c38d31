"""Packages that only parts of splatpilot need, and the extras of `pip install` that bring them."""

import re
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
