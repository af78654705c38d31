"""Files of Gaussians, told apart by what they begin with: PLY as it is, compressed or of surfels,
SPZ, and `.splat`; whatever else is taken for one is named."""

from pathlib import Path

import numpy as np

from splatpilot.systems import git_lfs
from splatpilot.systems.read_limit import require_readable_size
from splatpilot.systems.splats.gaussian_ply import read_ply
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.splats.sound_gaussians import sound_gaussians
from splatpilot.systems.splats.spherical_harmonics import C0
from splatpilot.systems.splats.spz import MAGIC, read_spz

_GZIP = b"\x1f\x8b"
_CONVERT = "convert it to PLY, for example with PlayCanvas's splat-transform"
# What files begin with, or end their name with, that are taken for Gaussians and are none we read.
_OTHERS = {
    git_lfs.POINTER: git_lfs.REFUSAL,
    b"glTF": f"a binary glTF; {_CONVERT}, or render a mesh with `splatpilot capture render`",
    b"PK": f"an archive; if it is SOG, {_CONVERT}",
    b"<": "a page or an XML file; a link that was saved in place of the file, perhaps",
}
_BY_NAME = {".ksplat": f"a KSPLAT; {_CONVERT}", ".sog": f"a SOG; {_CONVERT}"}
# Positions and scales [m], colour and opacity, rotation (wxyz), as antimatter15's viewer has them.
_RECORD = np.dtype([("p", "<f4", 3), ("s", "<f4", 3), ("rgba", "u1", 4), ("q", "u1", 4)])


def read_splats(path: str | Path) -> GaussianScene:
    """Reads the Gaussians in a file.

    PLY: see `read_ply`; SPZ: see `read_spz`. A `.splat` is 32 bytes a Gaussian, with neither header
    nor harmonics. A few damaged Gaussians are left out, see `sound_gaussians`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is none of these, empty, damaged or too large; the message names what it
            is, where that is known.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; a file of Gaussians is needed")
    with path.open("rb") as file:
        start = file.read(32)
    if not start:
        raise ValueError(f"{path}: the file is empty; copy it again")
    if start.startswith(b"ply"):
        return read_ply(path, recenter=True)
    if start.startswith((_GZIP, MAGIC)):
        return read_spz(path)
    suffix = path.suffix.lower()
    for what in [_BY_NAME.get(suffix), *(_OTHERS[k] for k in _OTHERS if start.startswith(k))]:
        if what is not None:
            raise ValueError(f"{path}: {what}")
    if suffix == ".splat":
        return _read_records(path)
    raise ValueError(
        f"{path}: neither PLY, SPZ nor .splat; a file of Gaussians is needed: {_CONVERT}"
    )


def _read_records(path: Path) -> GaussianScene:
    size = path.stat().st_size
    if size % _RECORD.itemsize:
        raise ValueError(
            f"{path}: {size} bytes are no multiple of the {_RECORD.itemsize} that a Gaussian has; "
            "it is cut short, copy it again"
        )
    require_readable_size(path, 3 * size)
    records = np.fromfile(path, _RECORD)
    color = records["rgba"] / 255
    return sound_gaussians(
        path,
        means=records["p"],
        quats=(records["q"].astype(float) - 128) / 128,
        scales=records["s"],
        opacities=np.maximum(color[:, 3], 1e-6),
        sh=((color[:, :3] - 0.5) / C0)[:, None, :],
    )
