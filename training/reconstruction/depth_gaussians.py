"""Frames with depth turned into coloured Gaussians that lie flat on the surfaces they show."""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.splats.background import FAR
from splatpilot.training.captures.capture import CaptureFrame

# A cell is flat if its inverse depth differs from a plane by less than this fraction (rms).
_FLATNESS = 2e-3
# And if its surface's slope against the ray, sideways to forward, is less than one to this.
_STEEPEST = 10.0
# Standard deviation of a Gaussian as a fraction of the edge of its cell: small keeps texture sharp,
# and large leaves no gaps to look through.
_SPREAD = 0.4
_UNDERLAY_SPREAD = 0.6
_SPREAD_ALONE = 0.5
# How much farther from the camera than the surface the underlay stands, as a fraction of depth:
# enough that it is drawn behind; on oblique surfaces more, up to _MAX_SETBACK. Cells of it have
# at least _UNDERLAY_SIZE pixels.
_UNDERLAY_SETBACK = 0.03
_MAX_SETBACK = 0.2
_UNDERLAY_SIZE = 4
# Thickness of a Gaussian as a fraction of its other standard deviations.
_THICKNESS = 0.1
# Longest to shortest side of a cell on its surface, for surfaces seen at grazing angles.
_MAX_STRETCH = 8.0


@dataclass(frozen=True, eq=False)
class Cells:
    """Square cells of an image, each of which becomes one Gaussian.

    Inverse depth in a cell is w + w_u (u - u_c) + w_v (v - v_c) about its centre (u_c, v_c) [px].
    """

    u: NDArray[np.float64]  # (n,) [px], centre
    v: NDArray[np.float64]  # (n,) [px]
    size: NDArray[np.float64]  # (n,) [px]
    w: NDArray[np.float64]  # (n,) [1/m]
    w_u: NDArray[np.float64]  # (n,) [1/(m px)]
    w_v: NDArray[np.float64]  # (n,)
    color: NDArray[np.float64]  # (n, 3)

    def select(self, mask: NDArray[np.bool_]) -> "Cells":
        """Returns some of the cells."""
        return Cells(**{field.name: getattr(self, field.name)[mask] for field in fields(self)})

    def move_back(self, factor: NDArray[np.float64]) -> "Cells":
        """Returns the same cells on surfaces `factor` (n,) times as far away."""
        w, w_u, w_v = (slope / factor for slope in (self.w, self.w_u, self.w_v))
        return replace(self, w=w, w_u=w_u, w_v=w_v)


class BlockMeans:
    """Means over the square blocks of an image, for every power of two as their edge [px].

    Args:
        frame: the depth.
        image: (H, W, 3), the colours to use, in 0 to 1.
        wanted: (H, W), where Gaussians are wanted.
        max_size: the largest edge [px], a power of two.
    """

    def __init__(
        self,
        frame: CaptureFrame,
        image: NDArray[np.float32],
        wanted: NDArray[np.bool_],
        max_size: int,
    ):
        pad = [(0, -n % max_size) for n in frame.depth.shape]
        depth = np.pad(frame.depth, pad).astype(np.float64)
        valid = (depth > 0) & (depth < FAR)
        w = np.where(valid, 1 / np.where(valid, depth, 1), 0)
        v, u = np.indices(w.shape) + 0.5
        color = np.pad(image, [*pad, (0, 0)]).transpose(2, 0, 1).astype(np.float64)
        channels = [valid, np.pad(wanted, pad) & valid, w, w * w, w * u, w * v, *color, *color**2]
        means = np.stack(channels)  # (12, H, W), float64
        self._focal_length = frame.K[0, 0]
        self._means = {1: means}
        size = 1
        while size < max_size:
            means = means[:, ::2] + means[:, 1::2]
            means = (means[..., ::2] + means[..., 1::2]) / 4
            size *= 2
            self._means[size] = means

    def split(self, contrast: float, max_size: int, fraction: float, max_extent: float) -> Cells:
        """Covers the wanted pixels with square cells, as large as surface and texture allow.

        A quadtree: cells of `max_size` pixels are split while depth is missing somewhere in them,
        less than a `fraction` of them is wanted, their surface is not flat, they extend on it for
        more than `max_extent` times the depth, or their colours vary by a standard deviation of
        more than `contrast`; colours alone do not split a cell of 2 pixels. Single pixels remain
        along the edges of things.
        """
        parts: list[tuple[NDArray, ...]] = []
        size = max_size
        undecided = np.ones(self._means[size].shape[1:], dtype=bool)
        while size >= 1:
            valid, wanted, w, ww, wu, wv, *moments = self._means[size]
            color, square = np.array(moments[:3]), np.array(moments[3:])
            v, u = (np.indices(w.shape) + 0.5) * size
            # Least-squares plane through the inverse depths of the block.
            spread = (size**2 - 1) / 12  # variance of the pixel coordinates
            w_u, w_v = (
                ((wu - w * u) / spread, (wv - w * v) / spread) if size > 1 else (0 * w, 0 * w)
            )
            residual = ww - w**2 - spread * (w_u**2 + w_v**2)
            leaf = undecided & (valid == 1) & (wanted >= fraction)
            if size > 1:
                leaf &= residual < (_FLATNESS * w) ** 2
                # A step in depth between two columns of pixels is a plane too, but a steep one.
                tilt = self._focal_length * np.hypot(w_u, w_v) / np.maximum(w, 1e-12)
                leaf &= tilt < _STEEPEST
                tilt = np.minimum(tilt, _MAX_STRETCH)
                leaf &= size / self._focal_length * np.hypot(1, tilt) < max_extent
            if size > 2:
                leaf &= (square - color**2).max(axis=0) < contrast**2
            edge = np.full(np.count_nonzero(leaf), float(size))
            parts.append((u[leaf], v[leaf], edge, w[leaf], w_u[leaf], w_v[leaf], color[:, leaf].T))
            undecided = (undecided & ~leaf).repeat(2, axis=0).repeat(2, axis=1)
            size //= 2
        return Cells(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def frame_gaussians(
    frame: CaptureFrame,
    image: NDArray[np.float32],
    wanted: NDArray[np.bool_],
    contrast: float,
    max_size: int,
    max_extent: float,
    underlay: bool = True,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns centres p_WQ (n, 3) [m], covariances in W (n, 3, 3) [m^2] and colours (n, 3).

    Arguments as for `BlockMeans` and `BlockMeans.split`. The Gaussians of the cells are narrow, for
    narrow ones stay sharp; so that nothing shines through between them and where frames meet, wide
    ones from larger cells, whatever their texture, lie a little behind: the underlay. Without it
    the Gaussians of the cells are wider, for optimisation to sharpen.
    """
    means = BlockMeans(frame, image, wanted, 2 * max_size)
    surface = means.split(contrast, max_size, 0.75, max_extent)
    if not underlay:
        return *cell_gaussians(frame, surface, _SPREAD_ALONE), surface.color
    under = means.split(np.inf, 2 * max_size, 0.05, 2 * max_extent)
    under = under.select(under.size >= _UNDERLAY_SIZE)
    # Gaussians are drawn in order of the depths of their centres, so an underlay must be farther
    # than the surface of the neighbouring cells.
    across = under.size * np.hypot(under.w_u, under.w_v) / under.w
    under = under.move_back(1 + _UNDERLAY_SETBACK + np.minimum(0.75 * across, _MAX_SETBACK))
    p_WQ, covariances = cell_gaussians(frame, surface, _SPREAD)
    p_WU, under_covariances = cell_gaussians(frame, under, _UNDERLAY_SPREAD)
    return (
        np.concatenate([p_WQ, p_WU]),
        np.concatenate([covariances, under_covariances]),
        np.concatenate([surface.color, under.color]),
    )


def cell_gaussians(
    frame: CaptureFrame, cells: Cells, spread: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the centres p_WQ (n, 3) [m] and covariances in W (n, 3, 3) [m^2] of flat Gaussians.

    A cell's edges on the surface are t_u = s dP/du and t_v = s dP/dv, with P = r / w along the
    pixel's ray r; `spread` times them are the standard deviations, plus a little thickness across.
    """
    f_u, f_v = frame.K[0, 0], frame.K[1, 1]
    z = 1 / cells.w
    P = frame.back_project(cells.u, cells.v, z)  # (n, 3)
    # Limit the slope of surfaces that are seen edge on.
    tilt = z * np.hypot(f_u * cells.w_u, f_v * cells.w_v)
    limit = np.minimum(1, _MAX_STRETCH / np.maximum(tilt, 1e-12))
    edge = (cells.size * z)[:, None]
    t_u = edge * (np.array([1 / f_u, 0, 0]) - P * (cells.w_u * limit)[:, None])
    t_v = edge * (np.array([0, 1 / f_v, 0]) - P * (cells.w_v * limit)[:, None])
    normal = np.cross(t_u, t_v)
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    across = _THICKNESS * (cells.size * z / f_u)[:, None] * normal / np.maximum(area, 1e-300)
    axes = spread * np.stack([t_u, t_v, across], axis=-1)  # (n, 3, 3), columns
    axes = frame.X_WC.rotation().matrix() @ axes
    return frame.X_WC.multiply(P.T).T, axes @ axes.transpose(0, 2, 1)


def principal_axes(
    covariances: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns quaternions wxyz (n, 4) and standard deviations (n, 3) of covariances (n, 3, 3).

    The smallest comes last: the third axis of a flat Gaussian is its normal, as of surfels.
    """
    variances, R = np.linalg.eigh(covariances)
    variances, R = variances[:, ::-1], R[:, :, ::-1].copy()
    R[np.linalg.det(R) < 0, :, 0] *= -1
    smallest = 1e-6 * variances[:, :1]
    return _quaternions(R), np.sqrt(np.maximum(variances, smallest))


def _quaternions(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns unit quaternions wxyz (n, 4) of rotation matrices (n, 3, 3).

    The matrix 4 q q^T is linear in R; its row with the largest diagonal is a multiple of q.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(R, 0, -1)
    outer = np.array(
        [
            [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
        ]
    )  # (4, 4, n)
    row = np.argmax(np.einsum("iin->in", outer), axis=0)
    q = outer[row, :, np.arange(len(R))]
    return q / np.linalg.norm(q, axis=1, keepdims=True)
