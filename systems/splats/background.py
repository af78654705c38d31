"""What lies infinitely far behind all Gaussians: one colour, or one in each direction."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import require_readable_size
from splatpilot.systems.splats.baked_scene import RenderedView
from splatpilot.systems.splats.lens import Distortion, pixel_slopes

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from pydrake.math import RigidTransform

FAR = 150.0
"""[m], depth from which on a pixel shows the infinitely far; some renderers give it a number."""

# Where less than this of the light comes from behind, it is not looked up.
_FAINT = 1e-3


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """Colours of the infinitely far by direction in W, equirectangular.

    Row 0 looks up and the last row down; column 0 begins at azimuth -180 deg, and azimuth grows
    with the columns, from x (0) to y (90 deg). Between the centres of texels colours are
    interpolated.
    """

    texels: "NDArray[np.float32]"  # (h, w, 3), red, green, blue in 0 to 1

    @classmethod
    def load(cls, file: Path) -> "EnvironmentMap":
        """Reads an image.

        Raises:
            FileNotFoundError, ValueError: if there is no file, or it is no image.
        """
        if not file.is_file():
            raise FileNotFoundError(f"{file}: there is no such file; reconstruct the scene again")
        require_readable_size(file, file.stat().st_size)
        content = file.read_bytes()
        try:
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        except cv2.error:  # more pixels than OpenCV decodes
            image = None
        if image is None:
            raise ValueError(f"{file}: cannot be read as an image; reconstruct the scene again")
        return cls((image[..., ::-1] / 255).astype(np.float32))

    def save(self, file: Path) -> None:
        """Writes the texels as `png` has them.

        Raises:
            OSError: if it cannot be written.
        """
        with written_atomically(file) as partial:
            partial.write_bytes(self.png())

    def png(self) -> bytes:
        """The texels as an image of 8 bits."""
        levels = np.clip(255 * self.texels + 0.5, 0, 255).astype(np.uint8)
        return cv2.imencode(".png", levels[..., ::-1])[1].tobytes()

    def color(self, v_W: "ArrayLike") -> "NDArray[np.float32]":
        """Returns the colours (n, 3) seen in the directions v_W (n, 3), of any length but zero."""
        height, width = self.texels.shape[:2]
        row, column = texel_of(v_W, height, width)
        row, column = np.clip(row - 0.5, 0, height - 1), column - 0.5
        top, left = np.floor(row).astype(int), np.floor(column).astype(int)
        down, right = (row - top)[:, None], (column - left)[:, None]
        bottom = np.minimum(top + 1, height - 1)
        left, beside = left % width, (left + 1) % width
        upper = (1 - right) * self.texels[top, left] + right * self.texels[top, beside]
        lower = (1 - right) * self.texels[bottom, left] + right * self.texels[bottom, beside]
        return ((1 - down) * upper + down * lower).astype(np.float32)


type Background = tuple[float, float, float] | EnvironmentMap

BLACK = (0.0, 0.0, 0.0)


def texel_of(
    v_W: "ArrayLike", height: int, width: int
) -> "tuple[NDArray[np.float64], NDArray[np.float64]]":
    """Returns row and column (n,) of directions v_W (n, 3) in an equirectangular map, in texels
    from its upper left corner; see `EnvironmentMap`."""
    x, y, z = np.moveaxis(np.asarray(v_W, dtype=np.float64), -1, 0)
    row = np.arctan2(np.hypot(x, y), z) / np.pi * height
    return row, (np.arctan2(y, x) / (2 * np.pi) + 0.5) * width


def pixel_rays(
    K: "NDArray", rows: "NDArray", columns: "NDArray", X_WC: "RigidTransform"
) -> "NDArray[np.float64]":
    """Returns the directions v_W (n, 3) in which a camera's pixels (row, column) look."""
    u, v = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
    return np.column_stack([u, v, np.ones_like(u)]) @ X_WC.rotation().matrix().T


def put_behind(
    view: RenderedView,
    background: Background,
    K: "NDArray",
    X_WC: "RigidTransform",
    distortion: Distortion | None = None,
) -> RenderedView:
    """Returns a view that was rendered on black with `background` behind it; K (3, 3) [px]. What a
    lens does not show stays black."""
    color = view.color.copy()
    rows, columns = np.nonzero(view.alpha < 1 - _FAINT)
    if distortion is not None:
        height, width = view.alpha.shape
        slopes = pixel_slopes(distortion, K, width, height)
        shown = np.isfinite(slopes[rows, columns, 0])
        rows, columns = rows[shown], columns[shown]
        v_C = np.column_stack([slopes[rows, columns], np.ones(len(rows))])
        v_W = v_C @ X_WC.rotation().matrix().T
    else:
        v_W = pixel_rays(K, rows, columns, X_WC)
    if isinstance(background, EnvironmentMap):
        behind = background.color(v_W)
    else:
        behind = np.asarray(background, dtype=np.float32)
    color[rows, columns] += (1 - view.alpha[rows, columns])[:, None] * behind
    return view._replace(color=color)


def mean_color(background: Background) -> tuple[float, float, float]:
    """Returns the one colour that is nearest to a background, each direction counting alike."""
    if not isinstance(background, EnvironmentMap):
        return background
    height = len(background.texels)
    area = np.sin((np.arange(height) + 0.5) * np.pi / height)
    red, green, blue = np.average(background.texels.mean(axis=1), axis=0, weights=area).tolist()
    return red, green, blue
