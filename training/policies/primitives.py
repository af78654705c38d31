"""Worlds of analytic shapes in batches: what cameras see of them and how near they are, in torch.

The shapes are those of `splatpilot.systems.collision.shapes`, so that training sees and hits
exactly what the benchmark's worlds are made of. Nothing here is differentiable: images
carry no gradient, and the gradient of a distance is the normal that is returned with it.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.collision.shapes import Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from splatpilot.training.policies.ray_casting import (
    MISS,
    PinholeGrid,
    cast_boxes,
    cast_cylinders,
    cast_planes,
    cast_spheres,
)

_FAR = 1e4
"""[m], where the shapes lie that fill a batch up to equal numbers."""

_HELD = 0.5
"""[m], ends of capsules further than this from the volume are left out: they end out of sight."""


class Primitives:
    """The shapes of W worlds.

    Args:
      worlds: the shapes of each, of any kinds.
      lower_W, upper_W: (W, 3) [m], the volumes flown in.
      device: where the tensors live.
    """

    def __init__(
        self,
        worlds: Sequence[Sequence[Shape]],
        lower_W: np.ndarray,
        upper_W: np.ndarray,
        device: torch.device | str = "cpu",
    ) -> None:
        spheres, cylinders, boxes, planes = [], [], [], []
        for shapes, lower, upper in zip(worlds, lower_W, upper_W, strict=True):
            rows = _rows(shapes, lower - _HELD, upper + _HELD)
            for stack, kind in zip((spheres, cylinders, boxes, planes), rows, strict=True):
                stack.append(kind)
        tiny, upright = 1e-3, (1, 0, 0, 0, 1, 0, 0, 0, 1)
        # (W, 4, M): centre, radius
        self.spheres = _pad(spheres, (_FAR, 0, 0, tiny), device)
        # (W, 8, M): centre, axis, half length, radius
        self.cylinders = _pad(cylinders, (_FAR, 0, 0, 0, 0, 1, tiny, tiny), device)
        # (W, 15, M): centre, rotation row by row, half sizes
        self.boxes = _pad(boxes, (_FAR, 0, 0, *upright, tiny, tiny, tiny), device)
        # (W, 4, M): normal, offset; never empty, so that there always is a nearest shape
        self.planes = _pad(planes, (0, 0, 1, -_FAR), device, least=1)
        # (W, 4): whether a world has any of a kind
        self._has = torch.tensor(
            [
                [len(rows) > 0 for rows in world]
                for world in zip(spheres, cylinders, boxes, planes, strict=True)
            ],
            device=device,
        )

    def tensors(self) -> list[Tensor]:
        """All there is, kind by kind."""
        return [self.spheres, self.cylinders, self.boxes, self.planes]

    def select(self, world: Tensor) -> "Primitives":
        """The shapes of the worlds numbered `world` (N,)."""
        chosen = object.__new__(Primitives)
        chosen.spheres, chosen.cylinders, chosen.boxes, chosen.planes = (
            kind.index_select(0, world) for kind in self.tensors()
        )
        chosen._has = self._has[world]
        return chosen

    def without_obstacles(self) -> "Primitives":
        """As many worlds with nothing but their planes, the ground."""
        empty = object.__new__(Primitives)
        empty.spheres, empty.cylinders, empty.boxes = (
            kind[:, :, :0] for kind in self.tensors()[:3]
        )
        empty.planes = self.planes
        empty._has = self._has & torch.tensor([False, False, False, True], device=self._has.device)
        return empty

    @torch.no_grad()
    def near(self, p_WQ: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N, M) [m] to every shape and its gradient (N, 3, M) at p_WQ (N, 3).

        M counts the shapes of all kinds in the order spheres, cylinders, boxes, planes. Row n is
        about world n.
        """
        parts = [
            _sphere_distances(p_WQ, self.spheres),
            _cylinder_distances(p_WQ, self.cylinders),
            _box_distances(p_WQ, self.boxes),
            _plane_distances(p_WQ, self.planes),
        ]
        return torch.cat([d for d, _ in parts], 1), torch.cat([n for _, n in parts], 2)

    @torch.no_grad()
    def depth(
        self,
        p_WC: Tensor,
        R_WC: Tensor,
        grid: PinholeGrid,
        distances: Tensor,
        nearest: int = 24,
    ) -> Tensor:
        """Planar depth (N, R) [m], infinite where nothing is: the nearest surface in each pixel.

        A pixel sees what any part of it sees; see `ray_casting`.

        Args:
          p_WC, R_WC: (N, 3), (N, 3, 3), the cameras; row n is in world n.
          grid: the rays.
          distances: (N, M) [m] from about the cameras, as `near` returns them.
          nearest: of each kind, that many shapes are looked at: the nearest before the camera.
        """
        rays = R_WC @ grid.directions_C.mT  # (N, 3, R)
        depth = torch.full(rays[:, 0].shape, torch.inf, device=rays.device)
        begin = 0
        casts = cast_spheres, cast_cylinders, cast_boxes, cast_planes
        for cast, kind, has in zip(casts, self.tensors(), self._has.unbind(1), strict=True):
            near = distances[:, begin : begin + kind.shape[2]]
            begin += kind.shape[2]
            rows = has.nonzero()[:, 0]  # few kinds of worlds have all kinds of shapes
            if len(rows):
                p, R = p_WC[rows], R_WC[rows]
                kind = _in_front(kind[rows], near[rows], p, R[:, :, 2], nearest)
                seen = cast(p, R, rays[rows], kind, grid.half_pixel)
                depth[rows] = torch.minimum(depth[rows], seen)
        return torch.where(depth < MISS, depth, torch.inf)


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


def _pad(
    worlds: list[np.ndarray], filler: Sequence[float], device: torch.device | str, least: int = 0
) -> Tensor:
    """(W, size, M), short worlds filled up; M is the size of the fullest, or `least`."""
    most = max(least, *(len(rows) for rows in worlds))
    stacked = np.tile(np.array(filler, np.float32), (len(worlds), most, 1))
    for target, rows in zip(stacked, worlds, strict=True):
        target[: len(rows)] = rows
    return torch.tensor(stacked, device=device).mT.contiguous()


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
