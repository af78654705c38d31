"""Exact views of a mesh: by Drake's OpenGL renderer and, where textures cut holes, by rays."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    GeometryId,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    RenderLabel,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U

from splatpilot.systems.opengl import require_opengl
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.captures.drawn_mesh import drawn_mesh
from splatpilot.training.captures.gltf_files import SUFFIXES

NEAREST, FARTHEST = 0.05, 150.0
"""[m], range of the depth images; nearer is 0, farther is inf."""

# Lamps at infinity: one overhead, four from the sides so that no wall is dark or like its
# neighbour, one from below for undersides.
_LAMPS = (
    ((0.15, 0.25, -1.0), 1.6),
    ((1.0, 0.15, -0.5), 1.1),
    ((-1.0, -0.15, -0.5), 1.3),
    ((0.15, 1.0, -0.5), 0.9),
    ((-0.15, -1.0, -0.5), 1.5),
    ((0.2, 0.3, 1.0), 0.8),
)


class MeshRenderer:
    """Renders a mesh that stands in the world.

    Args:
        mesh: .gltf, .glb, or .obj with its materials.
        up: the axis of the file's coordinates that points up, "y" (as glTF says) or "z".
        background: colour where there is no mesh; red, green, blue in 0 to 1.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is of another kind.
        OSError: if there is no OpenGL that works without a display.
    """

    def __init__(self, mesh: Path, up: str, background: tuple[float, float, float]):
        check_mesh(mesh, up)
        require_opengl()
        lights = [
            LightParameter(
                type="directional", frame="world", direction=np.array(way), intensity=intensity
            )
            for way, intensity in _LAMPS
        ]
        self._engine = MakeRenderEngineVtk(
            RenderEngineVtkParams(
                lights=lights, default_clear_color=np.array(background), force_to_pbr=True
            )
        )
        properties = PerceptionProperties()
        properties.AddProperty("label", "id", RenderLabel(1))
        # The engine turns glTF's y up to z by itself.
        X_WM = RigidTransform(RotationMatrix.MakeXRotation(0.0 if up == "y" else -np.pi / 2))
        with drawn_mesh(mesh, up) as drawn:
            self._cut_outs = drawn.cut_outs
            if drawn.solid is not None:
                try:
                    self._engine.RegisterVisual(
                        GeometryId.get_new_id(), Mesh(str(drawn.solid)), properties, X_WM, False
                    )
                except RuntimeError as error:
                    raise ValueError(
                        f"{mesh}: Drake cannot render it: {error}; export it again"
                    ) from None

    def frame(
        self, X_WC: RigidTransform, K: NDArray[np.float64], width: int, height: int
    ) -> CaptureFrame:
        """Returns the view of a camera at X_WC with intrinsics K (3, 3) [px], with exact depth."""
        # OpenGL's image plane: there the principal point of a symmetric view is width / 2, which is
        # what K says whose pixel centres lie at + 0.5.
        info = CameraInfo(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        core = RenderCameraCore("", info, ClippingRange(NEAREST, FARTHEST), RigidTransform())
        color, depth = ImageRgba8U(width, height), ImageDepth32F(width, height)
        self._engine.UpdateViewpoint(X_WC)
        self._engine.RenderColorImage(ColorRenderCamera(core), color)
        self._engine.RenderDepthImage(DepthRenderCamera(core, DepthRange(NEAREST, FARTHEST)), depth)
        frame = CaptureFrame(
            np.array(color.data)[..., :3], np.array(depth.data)[..., 0], X_WC, np.array(K)
        )
        return frame if self._cut_outs is None else self._cut_outs.draw(frame, NEAREST, _LAMPS)


def check_mesh(mesh: Path, up: str) -> None:
    """Raises what `MeshRenderer` says about its arguments before it reads the file."""
    if not mesh.is_file():
        raise FileNotFoundError(f"No such file: {mesh}")
    if mesh.suffix not in SUFFIXES:
        raise ValueError(f"{mesh}: a mesh must be one of {', '.join(SUFFIXES)}; export it as .glb")
    if up not in ("y", "z"):
        raise ValueError(f"up is {up!r}; 'y' (as glTF says) or 'z' is needed")
