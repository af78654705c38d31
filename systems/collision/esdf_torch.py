"""The distance field for torch: the query of `Esdf`, differentiable."""

from typing import NamedTuple

import numpy as np
import torch

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import (
    Esdf,
    corner_offsets,
    grid_strides,
    trilinear,
    trilinear_with_gradient,
)


class TorchFieldSample(NamedTuple):
    """`FieldSample` with tensors: distance (...,), gradient (..., 3), state (...,) uint8."""

    distance: torch.Tensor
    gradient: torch.Tensor
    state: torch.Tensor


class EsdfTorch:
    """An `Esdf` on a torch device, queried with tensors.

    Values, gradients and states are those of `Esdf`, computed in the dtype of the points. The
    distance is differentiable by the points: autograd returns the exact gradient of the
    interpolant, zero where the distance is NaN.

    Args:
      esdf: the field; its grid is copied to the device once.
      device: where the points of the queries live.
    """

    def __init__(self, esdf: Esdf, device: torch.device | str = "cpu") -> None:
        self.voxel_size = esdf.voxel_size
        self.occupied_outside = esdf.occupied_outside

        def on_device(array: np.ndarray) -> torch.Tensor:
            return torch.tensor(array, device=device)  # copies; the field's arrays are read-only

        self.lower_W = on_device(esdf.lower_W)[:, None]  # (3, 1) [m]
        self.upper_W = on_device(esdf.upper_W)[:, None]
        self._first_center_W = self.lower_W + 0.5 * esdf.voxel_size
        self._last_cell = on_device(np.array(esdf.shape, dtype=float) - 2.0)[:, None]
        self._strides = on_device(grid_strides(esdf.shape))[:, None]
        self._corner_offsets = on_device(corner_offsets(esdf.shape))
        self._distances = on_device(esdf.distances)
        self._states = on_device(esdf.states)

    def distance(self, p_WQ: torch.Tensor) -> torch.Tensor:
        """Signed distance at the points p_WQ (..., 3) [m]: (...,) [m], see `Esdf.distance`."""
        p, p_box = self._split(p_WQ)
        corners, fractions, _ = self._cell(p_box)
        value = self._extend(trilinear(corners, *fractions), p, p_box)
        return value.reshape(p_WQ.shape[:-1])

    def query(self, p_WQ: torch.Tensor) -> TorchFieldSample:
        """Distance, exact gradient and state at the points p_WQ (..., 3) [m], see `Esdf.query`."""
        p, p_box = self._split(p_WQ)
        corners, fractions, cell = self._cell(p_box)
        value, *slopes = trilinear_with_gradient(corners, *fractions)
        gradient = torch.stack(slopes) / self.voxel_size  # (3, N)
        nearest = ((cell + (fractions >= 0.5)).long() * self._strides).sum(0)
        beyond = p - p_box
        inside = (beyond == 0.0).all(0)
        if self.occupied_outside:
            outward = torch.nn.functional.normalize(beyond, dim=0)
            gradient = torch.where(inside | (beyond == 0.0), gradient, 0.0) - outward
        else:
            gradient = torch.where(inside, gradient, 0.0)
        state = torch.where(inside, self._states.take(nearest), int(FieldState.OUTSIDE))
        shape = p_WQ.shape[:-1]
        return TorchFieldSample(
            self._extend(value, p, p_box).reshape(shape),
            gradient.T.reshape(p_WQ.shape),
            state.to(torch.uint8).reshape(shape),
        )

    def _split(self, p_WQ: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Points (..., 3) as columns (3, N), and the same brought into the box."""
        if p_WQ.shape[-1:] != (3,):
            raise ValueError(f"EsdfTorch: points have shape {tuple(p_WQ.shape)}; needed (..., 3).")
        p = p_WQ.reshape(-1, 3).T
        return p, torch.minimum(
            torch.maximum(p, self.lower_W.to(p.dtype)), self.upper_W.to(p.dtype)
        )

    def _cell(self, p_box: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Corner values (2, 2, 2, N), fractions (3, N) and index (3, N) of the points' cells."""
        position = (p_box - self._first_center_W.to(p_box.dtype)) / self.voxel_size
        last = self._last_cell.to(p_box.dtype)
        cell = torch.fmin(torch.fmax(position.detach().floor(), torch.zeros_like(last)), last)
        base = (cell.long() * self._strides).sum(0)
        corners = self._distances.take(self._corner_offsets + base).to(p_box.dtype)
        return corners, position - cell, cell

    def _extend(self, value: torch.Tensor, p: torch.Tensor, p_box: torch.Tensor) -> torch.Tensor:
        """The values (N,) with those of points outside the box replaced by what holds there."""
        if self.occupied_outside:
            return value - torch.linalg.vector_norm(p - p_box, dim=0)
        return torch.where((p == p_box).all(0), value, torch.nan)
