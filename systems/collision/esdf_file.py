"""The file format `esdf.npz`: a compressed numpy archive with a version number."""

from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.systems.array_files import read_archive
from splatpilot.systems.files import written_atomically

FORMAT_VERSION = 1

# Name, number of dimensions and kinds of dtype of every entry.
_ENTRIES = {
    "version": (0, "iu"),
    "distances": (3, "f"),
    "states": (3, "u"),
    "lower_W": (1, "f"),
    "voxel_size": (0, "f"),
    "occupied_outside": (0, "b"),
}


def write_esdf_arrays(
    path: str | Path,
    *,
    distances: np.ndarray,
    states: np.ndarray,
    lower_W: np.ndarray,
    voxel_size: float,
    occupied_outside: bool,
) -> None:
    """Write the arrays of an `Esdf`; a temporary file beside `path` is renamed at the end.

    Raises:
        OSError: if the folder is missing or not writable.
    """
    with written_atomically(Path(path)) as partial, partial.open("wb") as file:
        np.savez_compressed(
            file,
            version=np.int64(FORMAT_VERSION),
            distances=distances,
            states=states,
            lower_W=lower_W,
            voxel_size=np.float64(voxel_size),
            occupied_outside=np.bool_(occupied_outside),
        )


def read_esdf_arrays(path: str | Path) -> dict[str, Any]:
    """The constructor arguments of an `Esdf` from a file that `write_esdf_arrays` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no numpy archive, is damaged, lacks an entry, holds one of another type
            or was written by a newer version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such distance field file (esdf.npz).")
    archive = read_archive(path)
    arrays = {name: archive[name] for name in _ENTRIES if name in archive}
    missing = [name for name in _ENTRIES if name not in arrays]
    if missing:
        raise ValueError(
            f"{path}: not a distance field; the entries {missing} are missing. Write one with "
            "Esdf.save."
        )
    for name, (ndim, kinds) in _ENTRIES.items():
        array = arrays[name]
        if array.ndim != ndim or array.dtype.kind not in kinds:
            raise ValueError(
                f"{path}: the entry {name!r} is {array.dtype} of shape {array.shape}; needed is an "
                f"array of {ndim} dimensions and a dtype of kind {' or '.join(kinds)}."
            )
    version = int(arrays.pop("version"))
    if version != FORMAT_VERSION:
        raise ValueError(
            f"{path}: distance field format {version}; this program reads format "
            f"{FORMAT_VERSION}. Build the field anew."
        )
    return {
        **arrays,
        "voxel_size": float(arrays["voxel_size"]),
        "occupied_outside": bool(arrays["occupied_outside"]),
    }
