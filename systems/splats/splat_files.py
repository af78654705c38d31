"""Files of Gaussians: PLY, SPZ, SOG, `.splat`, glTF and USD."""

import logging
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import (
    LFS_ERROR,
    LFS_POINTER,
    read_ply_file,
    readable,
    require_file,
    require_readable_size,
)
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.gltf_usd import unpack_gltf, unpack_usd, write_gltf, write_usd
from splatpilot.systems.splats.packed_splats import (
    GZIP,
    MAGIC,
    MIN_OPACITY,
    PACKED,
    SOG_META,
    Arrays,
    pack_spz,
    property_names,
    unpack_ply,
    unpack_sog,
    unpack_spz,
)
from splatpilot.systems.splats.scene import ARRAYS, GaussianScene, choose_origin, color_to_sh

_log = logging.getLogger(__name__)

_MAX_INVALID = 0.2  # fraction of invalid Gaussians that are dropped instead of refusing the file
_EXPORT = "export the scene in the layout of 3D Gaussian splatting"


def _drop_invalid(
    path: Path, arrays: Arrays, antialiased: bool = False, recenter: bool = True
) -> GaussianScene:
    """Makes a scene of the valid Gaussians of a file; logs dropped ones and a new origin."""
    means = arrays["means"]
    require(len(means) > 0, f"{path}: the number of Gaussians", ">= 1", 0, "export the scene again")
    origin = (0.0, 0.0, 0.0)
    if recenter and len(finite := means[np.isfinite(means).all(axis=1)]):
        x, y, z = choose_origin(np.asarray(finite, dtype=np.float64)).tolist()
        if origin != (x, y, z):
            origin, arrays = (x, y, z), arrays | {"means": means - np.array([x, y, z])}
            listed = ", ".join(f"{each:.10g}" for each in origin)
            _log.warning("%s: positions are relative to %s, close to the Gaussians", path, listed)
    with np.errstate(over="ignore", invalid="ignore"):
        arrays = {name: np.asarray(array, np.float32) for name, array in arrays.items()}
        rotates = np.linalg.norm(arrays["quats"].astype(float), axis=1) > 1e-6
    visible = (arrays["opacities"] > 0) & (arrays["opacities"] <= 1)
    valid = rotates & visible & (arrays["scales"] > 0).all(axis=1)
    for array in arrays.values():
        valid &= np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    count = int((~valid).sum())
    if count > _MAX_INVALID * len(valid):
        try:
            return GaussianScene(*arrays.values())  # names the first invalid one
        except ValueError as error:
            invalid = f"{count} of {len(valid)} Gaussians are invalid"
            raise ValueError(f"{path}: {invalid}; {error}") from None
    if count:
        _log.warning("%s: %d of %d Gaussians are invalid and dropped", path, count, len(valid))
        arrays = {name: array[valid] for name, array in arrays.items()}
    return GaussianScene(*arrays.values(), origin=origin, antialiased=antialiased)


# The PLY layout of the original 3D Gaussian splatting code: f_rest is channel-major, opacity a
# logit, scales are natural logarithms and rotations wxyz.

_NORMALS = ["nx", "ny", "nz"]
_MEANS = ["x", "y", "z"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_OPACITY = ["opacity"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]

# The largest float32 below 1 is 1 - 2^-24. An opacity of exactly 1 has no finite logit; it is
# written as that of 1 - 2^-26, which is read as 1.
_OPAQUE = 1 - 2.0**-26
_THICKNESS = 0.01  # of surfels, relative to the smaller of their scales
_FILTER = "filter_3D"  # [m], standard deviation that blurs each (Yu et al. 2024, Mip-Splatting)
# Comments by which Brush and Postshot say that Gaussians were trained antialiased.
_ANTIALIASED = "SplatRenderMode: mip"
_MIP_COMMENT = rf"{_ANTIALIASED}\b|antialiased 1\b"
_INVISIBLE_LOGIT = -87.0  # below, the opacity is not a normal float32


def read_ply(path: str | Path, recenter: bool = False) -> GaussianScene:
    """Reads the Gaussians of a PLY file: binary of either byte order, ASCII, or compressed.

    Raises FileNotFoundError, or ValueError for a file that is damaged or without Gaussians.
    """
    path = Path(path)
    ply = read_ply_file(path)
    if "vertex" not in ply:
        raise ValueError(f"{path}: no element 'vertex'; {_EXPORT}")
    names, unpack = property_names(ply["vertex"]), unpack_ply
    if PACKED[0] not in names:
        unpack, required = _unpack_plain, (*_MEANS, *_DC, *_OPACITY, *_SCALES[:2], *_QUATS)
        if missing := ", ".join(name for name in required if name not in names):
            what = "mesh" if "face" in ply else "point cloud"
            raise ValueError(f"{path}: {what} without Gaussians, missing {missing}; {_EXPORT}")
        _warn_of_activated(path, ply["vertex"])
    # Numbers that overflow are invalid.
    with np.errstate(over="ignore", invalid="ignore"), readable(path, "PLY file of Gaussians"):
        arrays = unpack(ply)
    comments = "\n".join(ply.comments)
    return _drop_invalid(path, arrays, bool(re.search(_MIP_COMMENT, comments)), recenter)


def _warn_of_activated(path: Path, vertex: PlyElement) -> None:
    """Logs a warning if opacities and scales look like those themselves, not logits and logs."""
    opacity, scale = (np.asarray(vertex[name]) for name in ("opacity", "scale_0"))
    if len(scale) and opacity.min() >= 0 and opacity.max() <= 1 and scale.min() > 0:
        _log.warning(
            "%s: all opacities are in [0, 1] and all scales > 0, as if they were not logits and "
            "logarithms; Gaussians would be %.3g to %.3g m in size; %s",
            *(path, np.exp(scale.min()), np.exp(scale.max()), _EXPORT),
        )


def _unpack_plain(ply: PlyData) -> Arrays:
    vertex, names = ply["vertex"], property_names(ply["vertex"])
    rest = [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in names))]
    numbered = len(rest) in (0, 9, 24, 45) and names.issuperset(rest)
    require(numbered, "properties f_rest_*", "0, 9, 24 or 45, from 0", len(rest))

    def columns(properties: list[str]) -> np.ndarray:
        return np.stack([np.asarray(vertex[name], dtype=np.float64) for name in properties], 1)

    sh = columns(_DC)[:, None, :]
    if rest and vertex.count:
        # (N, 3 (K - 1)) channel-major -> (N, K - 1, 3)
        higher = columns(rest).reshape(vertex.count, 3, -1).transpose(0, 2, 1)
        sh = np.concatenate([sh, higher], axis=1)
    scales = np.exp(columns([name for name in _SCALES if name in names]))
    if scales.shape[1] == 2:
        scales = np.column_stack([scales, _THICKNESS * scales.min(axis=1)])
    opacities = 1 / (1 + np.exp(-np.maximum(columns(_OPACITY)[:, 0], _INVISIBLE_LOGIT)))
    if _FILTER in names:
        filtered = np.hypot(scales, columns([_FILTER]))
        opacities *= (scales / filtered).prod(axis=1)
        scales = filtered
    return {
        "means": columns(_MEANS),
        "quats": columns(_QUATS),
        "scales": scales,
        "opacities": opacities,
        "sh": sh,
    }


def write_ply(scene: GaussianScene, path: str | Path) -> None:
    """Writes a scene atomically as binary little-endian PLY."""
    path = Path(path)
    N = len(scene)
    rest = [f"f_rest_{i}" for i in range(3 * (scene.sh.shape[1] - 1))]
    opacities = np.minimum(scene.opacities.astype(np.float64), _OPAQUE)
    blocks = [
        (_MEANS, scene.means),
        (_NORMALS, np.zeros((N, 3))),
        (_DC, scene.sh[:, 0]),
        (rest, scene.sh[:, 1:].transpose(0, 2, 1).reshape(N, len(rest))),
        (_OPACITY, np.log(opacities / (1 - opacities))[:, None]),
        (_SCALES, np.log(scene.scales.astype(np.float64))),
        (_QUATS, scene.quats),
    ]
    names = [name for block, _ in blocks for name in block]
    table = np.concatenate([values for _, values in blocks], axis=1).astype("<f4", order="C")
    vertex = table.view([(name, "<f4") for name in names])[:, 0]
    comments = [_ANTIALIASED] if scene.antialiased else []
    ply = PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<", comments=comments)
    with written_atomically(path) as partial:
        ply.write(str(partial))


_X_PS = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])))  # SPZ's axes in a PLY's
# Axes of glTF, y up, in W.
_X_WG = RigidTransform(RotationMatrix(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])))
_USD = (".usd", ".usda", ".usdc", ".usdz")
_READ = "PLY, SPZ, SOG, .splat, glTF or USD"
_CONVERT = "convert it to PLY, for example with PlayCanvas's splat-transform"
# Starts, or suffixes, of other files that are mistaken for Gaussians.
_OTHERS = {
    LFS_POINTER: LFS_ERROR,
    b"PK": "an archive; unpack it first",
    b"<": "a web page or an XML file, perhaps of a link saved instead of the file",
    b"# Octomap OcTree file": "a full OctoMap; write it as .bt, by octomap's convert_octree",
}
# Positions and scales [m], color and opacity, rotation (wxyz), as in antimatter15's viewer.
_RECORD = np.dtype([("p", "<f4", 3), ("s", "<f4", 3), ("rgba", "u1", 4), ("q", "u1", 4)])


def read_splats(path: str | Path) -> GaussianScene:
    """Reads the Gaussians of a file, or of a folder of an unbundled SOG; for errors see `read_ply`.

    Axes are those of the file, of SPZ those of its PLY. glTF and USD, which say what is up, are
    converted to z up, and USD to meters.
    """
    path = sog_meta(Path(path)) or Path(path)
    require_file(path)
    with path.open("rb") as file:
        start = file.read(32)
    require(start, f"{path}: the size", "> 0 bytes", 0, "copy it again")
    suffix = path.suffix.lower()
    if start.startswith(b"ply"):
        return read_ply(path, recenter=True)
    if start.startswith((GZIP, MAGIC)):
        return _drop_invalid(path, *unpack_spz(path)).transformed_by(_X_PS)
    if path.name == SOG_META or suffix == ".sog":
        return _drop_invalid(path, *unpack_sog(path))
    if start.startswith(b"glTF") or suffix == ".gltf":
        return _drop_invalid(path, unpack_gltf(path)).transformed_by(_X_WG)
    if suffix in _USD:
        arrays, meters, y_up = unpack_usd(path)
        scene = _drop_invalid(path, arrays).scaled_by(meters)
        return scene.transformed_by(_X_WG) if y_up else scene
    other = next((_OTHERS[s] for s in _OTHERS if start.startswith(s)), "")
    if suffix == ".ksplat":
        other = f"a KSPLAT; {_CONVERT}"
    if other or suffix != ".splat":
        raise ValueError(f"{path}: {other or f'not {_READ}; {_CONVERT}'}")
    return _read_records(path)


def sog_meta(path: Path) -> Path | None:
    """Returns `meta.json` of a folder that is an unbundled SOG, None of others."""
    meta = path / SOG_META
    return meta if meta.is_file() and b'"means"' in meta.read_bytes() else None


def _read_records(path: Path) -> GaussianScene:
    """Reads a `.splat`: 32 bytes per Gaussian, without header and harmonics."""
    size, width = path.stat().st_size, _RECORD.itemsize
    what, condition = f"{path}: the size", f"a multiple of {width} bytes"
    require(size % width == 0, what, condition, size, "copy it again")
    require_readable_size(path, 3 * size)
    records = np.fromfile(path, _RECORD)
    color = records["rgba"] / 255
    arrays = {
        "means": records["p"],
        "quats": (records["q"].astype(float) - 128) / 128,
        "scales": records["s"],
        "opacities": np.maximum(color[:, 3], MIN_OPACITY),
        "sh": color_to_sh(color[:, :3])[:, None, :],
    }
    return _drop_invalid(path, arrays)


def _write_spz(scene: GaussianScene, path: Path) -> None:
    """Writes a scene as SPZ, near Gaussians next to each other, which shortens the file."""
    turned = scene.transformed_by(_X_PS.inverse())
    cells = np.round(turned.means - turned.means.min(axis=0), 0).astype(np.int64)
    order = np.lexsort(cells.T)
    arrays = {name: getattr(turned, name)[order].astype(float) for name in ARRAYS}
    with written_atomically(path) as partial:
        partial.write_bytes(pack_spz(arrays, scene.antialiased))


_WRITERS: dict[str, Callable[[GaussianScene, Path], None]] = {
    ".ply": write_ply,
    ".spz": _write_spz,
    **dict.fromkeys(
        (".gltf", ".glb"),
        lambda scene, path: write_gltf(scene.transformed_by(_X_WG.inverse()), path),
    ),
    **dict.fromkeys(_USD[:3], write_usd),
}
WRITTEN = tuple(_WRITERS)
"""The suffixes of the files that `write_splats` writes."""


def write_splats(scene: GaussianScene, path: str | Path) -> None:
    """Writes a scene with z up atomically, in the format of the file's suffix, see `WRITTEN`."""
    path = Path(path)
    suffix = path.suffix.lower()
    require(suffix in _WRITERS, f"{path}: the suffix", f"one of {', '.join(WRITTEN)}", suffix)
    if scene.antialiased and suffix not in (".ply", ".spz"):
        _log.warning("%s: cannot record that Gaussians were trained antialiased", path)
    _WRITERS[suffix](scene, path)
