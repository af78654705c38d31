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
from splatpilot.systems.splats.gaussian_scene import GaussianScene

_NORMALS = ["nx", "ny", "nz"]
_MEANS = ["x", "y", "z"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_OPACITY = ["opacity"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]

# The largest float32 below 1 is 1 - 2^-24. An opacity of exactly 1 has no finite logit; it is
# written as that of 1 - 2^-26, which comes back as 1.
_OPAQUE = 1 - 2.0**-26
# Below this logit the opacity is no longer a normal float32; it is invisible anyway.
_INVISIBLE_LOGIT = -87.0


def read_ply(path: str | Path) -> GaussianScene:
    """Reads the Gaussians in a PLY file: binary of either byte order, or ASCII.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is no PLY, is truncated, holds no Gaussians (a mesh or a plain point
            cloud), has a number of spherical-harmonic coefficients that belongs to no degree, or
            holds values that are no Gaussians (see `GaussianScene`).
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; a PLY file with Gaussians is needed")
    ply = read_ply_file(path)
    if "vertex" not in ply:
        raise ValueError(f"{path}: no element 'vertex'; a PLY file with Gaussians is needed")
    vertex = ply["vertex"]
    names = {p.name for p in vertex.properties}
    required = _MEANS + _DC + _OPACITY + _SCALES + _QUATS
    if missing := [name for name in required if name not in names]:
        raise ValueError(
            f"{path}: the vertices lack {', '.join(missing)}: a mesh or point cloud, no Gaussians; "
            "export the scene in the layout of 3D Gaussian splatting"
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
    with np.errstate(over="ignore"):  # what overflows is infinite, and GaussianScene says so
        try:
            return GaussianScene(
                means=columns(_MEANS).astype(np.float32),
                quats=columns(_QUATS).astype(np.float32),
                scales=np.exp(columns(_SCALES)).astype(np.float32),
                opacities=(1 / (1 + np.exp(-logits))).astype(np.float32),
                sh=sh.astype(np.float32),
            )
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


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
