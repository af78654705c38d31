"""Reading and writing Gaussians in the PLY layout of the original 3D Gaussian splatting code.

One element `vertex` with the float properties x y z (nx ny nz, unused and optional) f_dc_0..2
f_rest_0..3(K-1)-1 (channel-major: all of red, then green, then blue) opacity (logit) scale_0..2
(natural logarithm) rot_0..3 (wxyz). Most tools that make or show Gaussian splats speak it.
"""

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from splatpilot.systems.files import written_atomically
from splatpilot.systems.ply_files import read_ply_file
from splatpilot.systems.splats.compressed_ply import is_compressed, unpack
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.splats.sound_gaussians import sound_gaussians

_NORMALS = ["nx", "ny", "nz"]
_MEANS = ["x", "y", "z"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_OPACITY = ["opacity"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]

# The largest float32 below 1 is 1 - 2^-24. An opacity of exactly 1 has no finite logit; it is
# written as that of 1 - 2^-26, which comes back as 1.
_OPAQUE = 1 - 2.0**-26
# Of surfels, beside the smaller of their extents.
_THICKNESS = 0.01
# Below this logit the opacity is no longer a normal float32; it is invisible anyway.
_INVISIBLE_LOGIT = -87.0


def read_ply(path: str | Path, recenter: bool = False) -> GaussianScene:
    """Reads the Gaussians in a PLY file: binary of either byte order, or ASCII.

    With `recenter` those that are far from 0 get an origin near them, see `sound_gaussians`.

    Surfels, whose files have two scales (2DGS), get a third of `_THICKNESS` times the smaller one;
    what PlayCanvas has compressed is unpacked. A few damaged Gaussians are left out, see
    `sound_gaussians`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is no PLY, is truncated, holds no Gaussians (a mesh or a plain point
            cloud), has a number of spherical-harmonic coefficients that belongs to no degree, or
            holds values that are no Gaussians.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; a PLY file with Gaussians is needed")
    ply = read_ply_file(path)
    if "vertex" not in ply:
        raise ValueError(f"{path}: no element 'vertex'; a PLY file with Gaussians is needed")
    if is_compressed(ply):
        return unpack(path, ply, recenter)
    vertex = ply["vertex"]
    names = {p.name for p in vertex.properties}
    if missing := [n for n in (*_MEANS, *_DC, *_OPACITY, *_SCALES[:2], *_QUATS) if n not in names]:
        what = "a mesh" if "face" in ply else "a point cloud"
        raise ValueError(
            f"{path}: {what}, no Gaussians: the vertices lack {', '.join(missing)}; export the "
            "scene in the layout of 3D Gaussian splatting"
        )
    if vertex.count == 0:
        raise ValueError(f"{path}: holds no Gaussians; export the scene again")
    rest = [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in names))]
    if len(rest) not in (0, 9, 24, 45) or not names.issuperset(rest):
        raise ValueError(
            f"{path}: {len(rest)} properties f_rest_*: 0, 9, 24 or 45, numbered from 0, are needed "
            "(spherical harmonics of degree 0 to 3)"
        )

    def columns(properties: list[str]) -> np.ndarray:
        try:
            return np.stack([np.asarray(vertex[name], dtype=np.float64) for name in properties], 1)
        except (ValueError, TypeError):
            raise ValueError(
                f"{path}: {', '.join(properties)} are not all plain numbers; export the scene in "
                "the layout of 3D Gaussian splatting"
            ) from None

    sh = columns(_DC)[:, None, :]
    if rest:
        # (N, 3 (K - 1)) channel-major -> (N, K - 1, 3)
        higher = columns(rest).reshape(vertex.count, 3, -1).transpose(0, 2, 1)
        sh = np.concatenate([sh, higher], axis=1)
    logits = np.maximum(columns(_OPACITY)[:, 0], _INVISIBLE_LOGIT)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is damaged
        scales = np.exp(columns([name for name in _SCALES if name in names]))
        if scales.shape[1] == 2:
            scales = np.column_stack([scales, _THICKNESS * scales.min(axis=1)])
        return sound_gaussians(
            path,
            means=columns(_MEANS),
            quats=columns(_QUATS),
            scales=scales,
            opacities=1 / (1 + np.exp(-logits)),
            sh=sh,
            recenter=recenter,
        )


def write_ply(scene: GaussianScene, path: str | Path) -> None:
    """Writes `scene` as binary little-endian PLY, atomically: a failure leaves no half file.

    Opacities of exactly 1, whose logit is infinite, are written as the logit of 1 - 2^-26, which
    reads back as 1.

    Raises:
        OSError: if the file cannot be written; the message names it.
    """
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
    with written_atomically(path) as partial:
        PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(partial))
