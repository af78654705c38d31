"""The `Geometry` of analytic shapes in torch: what native casting is timed by.

All shapes of all worlds lie in arrays of equal lengths, of which those of the vehicles' worlds are
gathered; of each kind the nearest before the camera are cast at.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch_casts import MISS, cast_boxes, cast_cylinders, cast_planes, cast_spheres

from splatpilot.systems.collision.shapes import Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from splatpilot.training.policies.ray_casting import PixelRays

_FAR = 1e4
"""[m], where the shapes lie that fill a batch up to equal numbers."""

_HELD = 0.5
"""[m], ends of capsules further than this from the volume are left out: they end out of sight."""

_LOOKED_AT = 24
"""Shapes of each kind that a camera looks at, the nearest ones."""


class TorchGeometry:
    """See `splatpilot.training.policies.ray_casting.Geometry`.

    Args:
      worlds: the shapes of each, of any kinds.
      lower_W, upper_W: (W, 3) [m], the volumes flown in.
    """

    def __init__(
        self, worlds: Sequence[Sequence[Shape]], lower_W: np.ndarray, upper_W: np.ndarray
    ) -> None:
        kinds: list[list[np.ndarray]] = [[], [], [], []]
        for shapes, lower, upper in zip(worlds, lower_W, upper_W, strict=True):
            rows = _rows(shapes, lower - _HELD, upper + _HELD)
            for stack, kind in zip(kinds, rows, strict=True):
                stack.append(kind)
        tiny, upright = 1e-3, (1, 0, 0, 0, 1, 0, 0, 0, 1)
        spheres, cylinders, boxes, planes = kinds
        self._all = [
            _pad(spheres, (_FAR, 0, 0, tiny)),  # centre, radius
            _pad(cylinders, (_FAR, 0, 0, 0, 0, 1, tiny, tiny)),  # centre, axis, half length, radius
            # centre, rotation row by row, half sizes
            _pad(boxes, (_FAR, 0, 0, *upright, tiny, tiny, tiny)),
            # normal, offset; never empty, so that there always is a nearest shape
            _pad(planes, (0, 0, 1, -_FAR), least=1),
        ]
        self._has = torch.tensor([[len(rows) > 0 for rows in w] for w in zip(*kinds, strict=True)])
        self._world: Tensor | None = None

    @torch.no_grad()
    def nearest(self, p_WQ: Tensor, world: Tensor, count: int) -> tuple[Tensor, Tensor]:
        self._select(world)
        self._distances, normals = self._near(p_WQ)
        nearest = self._distances.topk(min(count, normals.shape[2]), dim=1, largest=False)
        chosen = nearest.indices[:, None].expand(-1, 3, -1)
        return nearest.values, normals.gather(2, chosen).mT

    @torch.no_grad()
    def depth(self, p_WC: Tensor, R_WC: Tensor, rays: PixelRays, world: Tensor) -> Tensor:
        self._select(world)
        if self._distances is None:
            self._distances, _ = self._near(p_WC)
        directions = R_WC @ torch.from_numpy(rays.directions_C).mT  # (N, 3, R)
        depth = torch.full(directions[:, 0].shape, torch.inf)
        begin = 0
        casts = cast_spheres, cast_cylinders, cast_boxes, cast_planes
        for cast, kind, has in zip(casts, self._chosen, self._chosen_has.unbind(1), strict=True):
            near = self._distances[:, begin : begin + kind.shape[2]]
            begin += kind.shape[2]
            rows = has.nonzero()[:, 0]  # few kinds of worlds have all kinds of shapes
            if len(rows):
                p, R = p_WC[rows], R_WC[rows]
                kind = _in_front(kind[rows], near[rows], p, R[:, :, 2], _LOOKED_AT)
                seen = cast(p, R, directions[rows], kind, rays.half_pixel)
                depth[rows] = torch.minimum(depth[rows], seen)
        return torch.where(depth < MISS, depth, torch.inf)

    def _select(self, world: Tensor) -> None:
        """The shapes of these worlds from now on; distances of the last ones count no more."""
        if world is not self._world:
            self._world, self._distances = world, None
            self._chosen = [kind.index_select(0, world) for kind in self._all]
            self._chosen_has = self._has[world]

    def _near(self, p_WQ: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (N, M) [m] to all shapes and their gradients (N, 3, M)."""
        parts = [
            _sphere_distances(p_WQ, self._chosen[0]),
            _cylinder_distances(p_WQ, self._chosen[1]),
            _box_distances(p_WQ, self._chosen[2]),
            _plane_distances(p_WQ, self._chosen[3]),
        ]
        return torch.cat([d for d, _ in parts], 1), torch.cat([n for _, n in parts], 2)


def _rows(shapes: Sequence[Shape], lower: np.ndarray, upper: np.ndarray) -> list[np.ndarray]:
    """Spheres (M, 4), cylinders (M, 8), boxes (M, 15) and planes (M, 4) of one world."""
    spheres, cylinders, boxes, planes = [], [], [], []
    for shape in shapes:
        match shape:
            case Sphere():
                center, radius = shape.parameters()
                spheres.append([*center, radius])
            case Capsule():
                end, axis, length, radius = shape.parameters()
                cylinders.append([*(end + 0.5 * length * axis), *axis, 0.5 * length, radius])
                for ball in (end, end + length * axis):
                    if ((ball + radius > lower) & (ball - radius < upper)).all():
                        spheres.append([*ball, radius])
            case Cylinder():
                center, axis, half, radius = shape.parameters()
                cylinders.append([*center, *axis, half, radius])
            case Box():
                center, rotation, half = shape.parameters()
                boxes.append([*center, *rotation.ravel(), *half])
            case HalfSpace():
                normal, offset = shape.parameters()
                planes.append([*normal, offset])
    return [
        np.reshape(np.array(rows, dtype=np.float32), (len(rows), size))
        for rows, size in ((spheres, 4), (cylinders, 8), (boxes, 15), (planes, 4))
    ]


def _pad(worlds: list[np.ndarray], filler: Sequence[float], least: int = 0) -> Tensor:
    """(W, size, M), short worlds filled up; M is the size of the fullest, or `least`."""
    most = max(least, *(len(rows) for rows in worlds))
    stacked = np.tile(np.array(filler, np.float32), (len(worlds), most, 1))
    for target, rows in zip(stacked, worlds, strict=True):
        target[: len(rows)] = rows
    return torch.tensor(stacked).mT.contiguous()


def _sphere_distances(p: Tensor, spheres: Tensor) -> tuple[Tensor, Tensor]:
    away = p[:, :, None] - spheres[:, :3]  # (N, 3, M)
    length = away.square().sum(1).sqrt_()
    return length - spheres[:, 3], away / length.clamp(min=1e-6)[:, None]


def _cylinder_distances(p: Tensor, cylinders: Tensor) -> tuple[Tensor, Tensor]:
    from_center = p[:, :, None] - cylinders[:, :3]
    axis = cylinders[:, 3:6]
    along = (from_center * axis).sum(1)  # (N, M)
    radial = from_center - along[:, None] * axis
    across = radial.square().sum(1).sqrt_()
    beyond_end, beyond_side = along.abs() - cylinders[:, 6], across - cylinders[:, 7]
    end, side = beyond_end.clamp(min=0.0), beyond_side.clamp(min=0.0)
    inner = torch.maximum(beyond_end, beyond_side)
    distance = torch.hypot(end, side) + inner.clamp(max=0.0)
    inside = inner <= 0.0
    end = torch.where(inside, (beyond_end >= beyond_side).float(), end)
    side = torch.where(inside, (beyond_end < beyond_side).float(), side)
    scale = torch.hypot(end, side).clamp(min=1e-6)
    side = side / (scale * across.clamp(min=1e-6))
    end = torch.copysign(end, along) / scale
    return distance, side[:, None] * radial + end[:, None] * axis


def _box_distances(p: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    N, _, M = boxes.shape
    rotation = boxes[:, 3:12].reshape(N, 3, 3, M)  # world by own axes
    local = ((p[:, :, None] - boxes[:, :3])[:, :, None] * rotation).sum(1)  # (N, 3, M)
    beyond = local.abs() - boxes[:, 12:15]
    deepest = beyond.amax(1)
    outside = beyond.clamp(min=0.0)
    distance = outside.square().sum(1).sqrt_() + deepest.clamp(max=0.0)
    way = torch.where((deepest > 0.0)[:, None], outside, (beyond == deepest[:, None]).float())
    way = way / way.square().sum(1, keepdim=True).sqrt_().clamp(min=1e-6)
    return distance, (rotation * torch.copysign(way, local)[:, None]).sum(2)


def _plane_distances(p: Tensor, planes: Tensor) -> tuple[Tensor, Tensor]:
    normal = planes[:, :3]
    return (p[:, :, None] * normal).sum(1) - planes[:, 3], normal


def _in_front(kind: Tensor, near: Tensor, p: Tensor, forward: Tensor, count: int) -> Tensor:
    """Of shapes (N, P, M) the `count` nearest ones that are not wholly behind the cameras."""
    if kind.shape[2] <= count:
        return kind
    ahead = ((kind[:, :3] - p[:, :, None]) * forward[:, :, None]).sum(1)  # of the centres
    if kind.shape[1] == 4:
        reach = kind[:, 3]
    elif kind.shape[1] == 8:
        reach = (kind[:, 3:6] * forward[:, :, None]).sum(1).abs() * kind[:, 6] + kind[:, 7]
    else:
        reach = kind[:, 12:15].square().sum(1).sqrt()
    score = torch.where(ahead + reach > 0.0, near, torch.inf)
    chosen = score.topk(count, dim=1, largest=False, sorted=False).indices
    return kind.gather(2, chosen[:, None].expand(-1, kind.shape[1], -1))
