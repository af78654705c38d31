"""USD with Gaussians: prims of the schema ParticleField3DGaussianSplat, by the extra `usd`."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import readable, require_readable_size
from splatpilot.systems.splats.packed_splats import Arrays, joined, moved
from splatpilot.systems.splats.scene import GaussianScene, color_to_sh

_SCHEMA = "ParticleField3DGaussianSplat"
_HARMONICS, _DEGREE = "radiance:sphericalHarmonicsCoefficients", "radiance:sphericalHarmonicsDegree"


def unpack_usd(path: Path) -> tuple[Arrays, float, bool]:
    """Returns the Gaussians of all prims of the stage in its axes and units, the length of a unit
    [m], and whether y is up."""
    Usd, UsdGeom = (import_extra(f"pxr.{name}", "usd") for name in ("Usd", "UsdGeom"))
    require_readable_size(path, path.stat().st_size)
    with readable(path, "USD file"):
        stage = Usd.Stage.Open(str(path))
        found = [prim for prim in stage.Traverse() if prim.GetTypeName() == _SCHEMA]
    if not found:
        raise ValueError(f"{path}: a USD file without {_SCHEMA}; export the Gaussians as that")
    first = Usd.TimeCode.EarliestTime()
    transforms = UsdGeom.XformCache(first)
    with readable(path, f"USD file of {_SCHEMA}"):
        parts = []
        for prim in found:
            X = np.array(transforms.GetLocalToWorldTransform(prim)).T  # USD's vectors are rows
            parts.append(moved(_unpack_prim(prim, first), X))
        meters = float(UsdGeom.GetStageMetersPerUnit(stage))
        return joined(parts), meters, UsdGeom.GetStageUpAxis(stage) == "Y"


def _unpack_prim(prim: Any, time: Any) -> Arrays:
    def attribute(name: str) -> NDArray[np.float64] | None:
        for each in (name, f"{name}h"):  # in half precision
            value = prim.GetAttribute(each).Get(time)
            if value is not None and len(value):
                return np.array(value, dtype=np.float64)
        return None

    means = attribute("positions")
    if means is None:
        raise ValueError(f"{prim.GetPath()} must have positions, got none")
    count = len(means)
    quats, scales, opacities = map(attribute, ("orientations", "scales", "opacities"))
    sh, colors = attribute(_HARMONICS), attribute("primvars:displayColor")
    if sh is None:
        colors = np.full((1, 3), 0.5) if colors is None else colors
        sh = color_to_sh(np.broadcast_to(colors, (count, 3)))
    return {
        "means": means,
        # Imaginary parts come first in memory.
        "quats": np.eye(4)[[0]].repeat(count, 0) if quats is None else np.roll(quats, 1, axis=1),
        "scales": np.ones((count, 3)) if scales is None else scales,
        "opacities": np.ones(count) if opacities is None else opacities,
        "sh": sh.reshape(count, -1, 3),
    }


def write_usd(scene: GaussianScene, path: Path) -> None:
    """Writes a scene with z up, in meters, atomically."""
    Usd, UsdGeom, Vt = (import_extra(f"pxr.{name}", "usd") for name in ("Usd", "UsdGeom", "Vt"))
    values = {
        "positions": ("Point3fArray", Vt.Vec3fArray, scene.means),
        "orientations": ("QuatfArray", Vt.QuatfArray, np.roll(scene.quats, -1, axis=1)),
        "scales": ("Float3Array", Vt.Vec3fArray, scene.scales),
        "opacities": ("FloatArray", Vt.FloatArray, scene.opacities),
        _HARMONICS: ("Float3Array", Vt.Vec3fArray, scene.sh.reshape(-1, 3)),
    }
    Sdf, Gf = (import_extra(f"pxr.{name}", "usd") for name in ("Sdf", "Gf"))
    with written_atomically(path) as partial:
        stage = Usd.Stage.CreateNew(str(partial))
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdGeom.SetStageUpAxis(stage, "Z")
        prim = stage.DefinePrim("/Gaussians", _SCHEMA)
        stage.SetDefaultPrim(prim)
        for name, (kind, array, content) in values.items():
            of_kind = getattr(Sdf.ValueTypeNames, kind)
            prim.CreateAttribute(name, of_kind, custom=False).Set(
                array.FromNumpy(np.ascontiguousarray(content, np.float32))
            )
        degree = prim.CreateAttribute(_DEGREE, Sdf.ValueTypeNames.Int, custom=False)
        degree.Set(scene.sh_degree)
        if any(scene.origin):
            UsdGeom.Xformable(prim).AddTranslateOp().Set(Gf.Vec3d(*scene.origin))
        stage.Save()
