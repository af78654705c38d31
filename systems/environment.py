"""The folders that environment variables name, and what is looked for in them."""

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


def find_data(path: Path, what: str, hint: str = "") -> Path:
    """
    Finds a capture or a mesh: here, in the folder of data, or, by its name alone, in a folder of
    that. Prints where, if that is not here.

    Args:
        what: what it is, for the message.
        hint: what to do if it is nowhere.

    Raises:
        FileNotFoundError: if it is nowhere.
    """
    if path.exists():
        return path
    data = data_folder()
    if data is not None:
        within = sorted(data.glob(f"*/{path}")) if len(path.parts) == 1 else []
        for found in (data / path, *within):
            if found.exists():
                print(f"{path} is {found}")
                return found
    where = f"in {data}" if data is not None else f"in the folder that {DATA} names (it is not set)"
    raise FileNotFoundError(
        f"No such file or folder: {path}; expected {what}, here or {where}"
        + (f"; {hint}" if hint else "")
    )


def require_corpus(folder: Path) -> None:
    """
    Raises:
        FileNotFoundError: unless a folder holds a corpus; the message says how to make one.
    """
    if not (folder / "shards").is_dir():
        raise FileNotFoundError(
            f"{folder} holds no corpus; collect one with `splatpilot corpus make --out {folder} "
            "--worlds 18`"
        )


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
        f"No such file or folder: {path}; expected a scene, here or in {folder} (the environment "
        f"variable {SCENES} names that folder); "
        + (source or "reconstruct one with `splatpilot reconstruct`").strip()
    )
