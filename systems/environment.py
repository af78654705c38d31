"""The environment variables that name folders."""

import os
from pathlib import Path

DATA = "SPLATPILOT_DATA"
"""Names the folder of captures and meshes."""

SCENES = "SPLATPILOT_SCENES"
"""Names the folder of scenes."""


def data_folder() -> Path | None:
    """The folder of captures and meshes; None where nobody named one."""
    return Path(os.environ[DATA]) if DATA in os.environ else None


def scenes_folder() -> Path:
    """The folder of scenes: `scenes` where nobody named one."""
    return Path(os.environ.get(SCENES, "scenes"))


def cache_folder(*parts: str) -> Path:
    """The folder of what takes long to make again, in the user's cache."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home, "splatpilot", *parts)


def require_scene(path: str, source: str = "") -> Path:
    """
    Where a scene is: here, or in the folder of scenes.

    Args:
        path: of it.
        source: how to get it.

    Raises:
        FileNotFoundError: if it is in neither; the message says how to get it.
    """
    folder = scenes_folder()
    for place in (Path(path), folder / path):
        if place.exists():
            return place
    raise FileNotFoundError(
        f"{path}: there is no such scene, neither here nor in {folder} (the environment variable "
        f"{SCENES} names that folder); "
        + (source or "reconstruct one with `splatpilot reconstruct`").strip()
    )
