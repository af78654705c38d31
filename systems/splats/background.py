"""Backgrounds behind all Gaussians: one color, or one for each direction."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.readers import readable, require_file, require_readable_size

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from pydrake.math import RigidTransform

FAR = 150.0
"""[m], depth from which on a pixel shows the background; some renderers give it a number."""

_MIN_LIGHT = 1e-3  # 1 - alpha below which the background is not looked up


class RenderedView(NamedTuple):
    """Images of one camera, float32."""

    color: "NDArray[np.float32]"  # (H, W, 3), over the background
    depth: "NDArray[np.float32]"  # (H, W) [m] median z, see `rasterize`; 0: no surface
    alpha: "NDArray[np.float32]"  # (H, W) in [0, 1]


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """Colors of the background by direction in W, equirectangular, bilinear between texel centers.

    Row 0 looks up; azimuth grows with the columns from -180 deg, from x (0) to y (90 deg).
    """

    texels: "NDArray[np.float32]"  # (h, w, 3), red, green, blue in [0, 1]

    @classmethod
    def load(cls, file: Path) -> "EnvironmentMap":
        """Reads an image file."""
        require_file(file)
        require_readable_size(file, file.stat().st_size)
        with readable(file, "image"):
            image = cv2.imdecode(np.fromfile(file, np.uint8), cv2.IMREAD_COLOR)
            if image is None:
                raise ValueError("unknown format")
            return cls((image[..., ::-1] / 255).astype(np.float32))

    def save(self, file: Path) -> None:
        """Writes `png` atomically."""
        with written_atomically(file) as partial:
            partial.write_bytes(self.png())

    def png(self) -> bytes:
        """Returns the texels as a PNG image of 8 bits."""
        levels = np.clip(255 * self.texels + 0.5, 0, 255).astype(np.uint8)
        return cv2.imencode(".png", levels[..., ::-1])[1].tobytes()

    def color(self, v_W: "ArrayLike") -> "NDArray[np.float32]":
        """Returns the colors (n, 3) in the directions v_W (n, 3), of any length > 0."""
        height, width = self.texels.shape[:2]
        row, column = texel_position(v_W, height, width)
        row, column = np.clip(row - 0.5, 0, height - 1), column - 0.5
        top, left = np.floor(row).astype(int), np.floor(column).astype(int)
        down, right = (row - top)[:, None], (column - left)[:, None]
        bottom = np.minimum(top + 1, height - 1)
        left, next_column = left % width, (left + 1) % width
        upper = (1 - right) * self.texels[top, left] + right * self.texels[top, next_column]
        lower = (1 - right) * self.texels[bottom, left] + right * self.texels[bottom, next_column]
        return ((1 - down) * upper + down * lower).astype(np.float32)


type Background = tuple[float, ...] | EnvironmentMap

BLACK = (0.0, 0.0, 0.0)


def texel_position(
    v_W: "ArrayLike", height: int, width: int
) -> "tuple[NDArray[np.float64], NDArray[np.float64]]":
    """Returns row and column (n,) of directions v_W (n, 3) in an `EnvironmentMap` [texels]."""
    x, y, z = np.moveaxis(np.asarray(v_W, dtype=np.float64), -1, 0)
    row = np.arctan2(np.hypot(x, y), z) / np.pi * height
    return row, (np.arctan2(y, x) / (2 * np.pi) + 0.5) * width


def pixel_rays(slopes: "NDArray", X_WC: "RigidTransform") -> "NDArray[np.float64]":
    """Returns the directions v_W (n, 3) of pixels with `slopes` (n, 2), see `pixel_slopes`."""
    return np.column_stack([slopes, np.ones(len(slopes))]) @ X_WC.rotation().matrix().T


def put_behind(
    view: RenderedView,
    background: Background,
    slopes: "NDArray[np.float64]",
    X_WC: "RigidTransform",
) -> RenderedView:
    """Adds a background to a view on black; pixels without a ray stay black. For `slopes` (H, W, 2)
    of the pixels see `pixel_slopes`."""
    color = view.color.copy()
    rows, columns = np.nonzero((view.alpha < 1 - _MIN_LIGHT) & np.isfinite(slopes[..., 0]))
    if isinstance(background, EnvironmentMap):
        behind = background.color(pixel_rays(slopes[rows, columns], X_WC))
    else:
        behind = np.asarray(background, dtype=np.float32)
    color[rows, columns] += (1 - view.alpha[rows, columns])[:, None] * behind
    return view._replace(color=color)


def mean_color(background: Background) -> tuple[float, ...]:
    """Returns the mean color of a background over the sphere."""
    if not isinstance(background, EnvironmentMap):
        return background
    height = len(background.texels)
    area = np.sin((np.arange(height) + 0.5) * np.pi / height)
    return tuple(np.average(background.texels.mean(axis=1), axis=0, weights=area).tolist())
