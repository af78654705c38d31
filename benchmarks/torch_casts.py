"""Rays of small depth cameras cast at batches of shapes, in torch: what native casting is timed by.

A pixel sees what any part of it sees, as in the least of a finer image: shapes are hit by rays that
pass within half a pixel, at the depth where the widened shape begins plus what it was widened by.
"""

import torch
from torch import Tensor

_GRAZE, MISS = 1e-4, 1e6
"""[m], a shorter way through a shape counts as a miss, whose depth is at least this."""

_PARALLEL = 1e-9
"""Added to cosines that are divided by: 1 / 0 - 1 / 0 is not a number."""


def _footprint(away: Tensor, forward: Tensor, half_pixel: float) -> Tensor:
    """Half the width of a pixel (N, M) [m] across the way to points `away` (N, 3, M)."""
    planar = (away * forward[:, :, None]).sum(1).clamp(min=0.0)
    return half_pixel * planar.square() / away.square().sum(1).sqrt().clamp(min=1e-3)


def cast_spheres(p: Tensor, R: Tensor, rays: Tensor, spheres: Tensor, half_pixel: float) -> Tensor:
    """Depth (N, R) [m] along rays to spheres, at least `MISS` where none is hit.

    As all casts it works on arrays (N, M, R), a ray's step from one number to the next: that is
    fastest on CPUs.

    Args:
        p, R: (N, 3) [m] and (N, 3, 3), the cameras.
        rays: (N, 3, R), in W and of depth 1.
        spheres: (N, 4, M): centre and radius [m].
        half_pixel: half the width of a pixel at depth 1.
    """
    m = p[:, :, None] - spheres[:, :3]  # (N, 3, M)
    extra = _footprint(-m, R[:, :, 2], half_pixel)
    c = m.square().sum(1) - (spheres[:, 3] + extra).square()  # (N, M)
    a = rays.square().sum(1, keepdim=True)  # (N, 1, R)
    b = torch.bmm(m.mT, rays)  # (N, M, R)
    root = torch.addcmul(b.square(), a, c[:, :, None], value=-1.0).clamp_(min=0.0).sqrt_()
    leave = (root - b).clamp_(min=0.0)
    enter = root.add_(b).neg_().clamp_(min=0.0)
    return _nearest(enter, leave, enter / a, extra)


def cast_cylinders(
    p: Tensor, R: Tensor, rays: Tensor, cylinders: Tensor, half_pixel: float
) -> Tensor:
    """Depth (N, R) [m] to cylinders (N, 8, M): centre [m], axis, half length and radius [m]; see
    `cast_spheres`."""
    axis, half, radius = cylinders[:, 3:6], cylinders[:, 6], cylinders[:, 7]
    m = p[:, :, None] - cylinders[:, :3]
    along = (m * axis).sum(1)  # (N, M)
    across = m - along[:, None] * axis
    nearest = across + (along - torch.minimum(torch.maximum(along, -half), half))[:, None] * axis
    extra = _footprint(-nearest, R[:, :, 2], half_pixel)
    # Between the flat ends...
    slope = torch.bmm(axis.mT, rays)  # (N, M, R)
    a = torch.addcmul(rays.square().sum(1, keepdim=True), slope, slope, value=-1.0)
    slope.add_(_PARALLEL).reciprocal_()
    middle = along[:, :, None] * slope
    width = slope.abs_().mul_((half + extra)[:, :, None])
    # ... and inside the endless cylinder.
    b = torch.bmm(across.mT, rays)
    c = across.square().sum(1) - (radius + extra).square()
    root = torch.addcmul(b.square(), a, c[:, :, None], value=-1.0).clamp_(min=0.0).sqrt_()
    a.reciprocal_()
    leave = torch.minimum((root - b).mul_(a), width - middle)
    enter = torch.maximum(root.add_(b).neg_().mul_(a), width.add_(middle).neg_()).clamp_(min=0.0)
    return _nearest(enter, leave, enter, extra)


def cast_boxes(p: Tensor, R: Tensor, rays: Tensor, boxes: Tensor, half_pixel: float) -> Tensor:
    """Depth (N, R) [m] to boxes (N, 15, M): centre [m], rotation (world by own axes) row by row and
    half sizes [m]; see `cast_spheres`."""
    N, _, M = boxes.shape
    rotation = boxes[:, 3:12].reshape(N, 3, 3, M)
    m = p[:, :, None] - boxes[:, :3]
    local = (m[:, :, None] * rotation).sum(1)  # (N, 3, M)
    beyond = local - torch.minimum(torch.maximum(local, -boxes[:, 12:15]), boxes[:, 12:15])
    nearest = (rotation * beyond[:, None]).sum(2)
    extra = _footprint(-nearest, R[:, :, 2], half_pixel)
    enter = torch.zeros(N, M, rays.shape[2], device=p.device)
    leave = torch.full_like(enter, torch.inf)
    for axis in range(3):
        slope = torch.bmm(rotation[:, :, axis].mT, rays).add_(_PARALLEL).reciprocal_()
        middle = local[:, axis, :, None] * slope
        width = slope.abs_().mul_((boxes[:, 12 + axis] + extra)[:, :, None])
        torch.minimum(leave, width - middle, out=leave)
        torch.maximum(enter, width.add_(middle).neg_(), out=enter)
    return _nearest(enter, leave, enter, extra)


def cast_planes(p: Tensor, R: Tensor, rays: Tensor, planes: Tensor, half_pixel: float) -> Tensor:
    """Depth (N, R) [m] to half spaces (N, 4, M): outward normal and offset [m]; infinite where
    none is hit; see `cast_spheres`."""
    normal = planes[:, :3]
    height = (p[:, :, None] * normal).sum(1) - planes[:, 3]  # (N, M)
    tilt = torch.bmm(normal.mT, R[:, :, :2]).abs().sum(2)  # a pixel's corner looks further down
    fall = half_pixel * tilt[:, :, None] - torch.bmm(normal.mT, rays)
    return torch.where(fall > 1e-6, height.clamp(min=0.0)[:, :, None] / fall, torch.inf).amin(1)


def _nearest(enter: Tensor, leave: Tensor, depth: Tensor, extra: Tensor) -> Tensor:
    """The least depth (N, R), of rays that enter a shape before they leave it; large otherwise."""
    missed = (enter - leave).add_(_GRAZE).clamp_(min=0.0)
    return missed.mul_(MISS / _GRAZE).add_(depth).add_(extra[:, :, None]).amin(1)
