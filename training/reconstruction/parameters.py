"""What is optimised: the parameters of Gaussians, and Adam's memory of each."""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpilot import _native
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.views import ReconstructionViews


def splat_shapes(
    log_scales: Tensor, logit_opacities: Tensor, smallest: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns scales (N, 3) = sqrt(exp(2 log_scales) + smallest^2) [m] and opacities (N,), the
    sigmoid of their logits.

    float32 tensors on the CPU go through native code, there and back in one pass each.

    Args:
        log_scales: (N, 3).
        logit_opacities: (N,).
        smallest: (N,) [m], data.
    """
    if log_scales.device.type == "cpu" and log_scales.dtype == torch.float32:
        return _Shapes.apply(log_scales, logit_opacities, smallest)  # pyright: ignore[reportReturnType]
    scales = torch.sqrt(torch.exp(2 * log_scales) + smallest[:, None] ** 2)
    return scales, torch.sigmoid(logit_opacities)


class _Shapes(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, log_scales: Tensor, logit_opacities: Tensor, smallest: Tensor
    ) -> tuple[Tensor, Tensor]:
        scales, opacities = torch.empty_like(log_scales), torch.empty_like(logit_opacities)
        _native.splat_shapes(
            log_scales=log_scales.detach().numpy(),
            logit_opacities=logit_opacities.detach().numpy(),
            smallest=smallest.numpy(),
            scales=scales.numpy(),
            opacities=opacities.numpy(),
            simd=os.environ.get("SPLATPILOT_SIMD", ""),
        )
        ctx.save_for_backward(scales, opacities, smallest)
        return scales, opacities

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_scales: Tensor, v_opacities: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        scales, opacities, smallest = ctx.saved_tensors
        v_log_scales, v_logits = torch.empty_like(scales), torch.empty_like(opacities)
        _native.splat_shapes_backward(
            scales=scales.detach().numpy(),
            opacities=opacities.detach().numpy(),
            smallest=smallest.numpy(),
            v_scales=v_scales.contiguous().numpy(),
            v_opacities=v_opacities.contiguous().numpy(),
            v_log_scales=v_log_scales.numpy(),
            v_logit_opacities=v_logits.numpy(),
            simd=os.environ.get("SPLATPILOT_SIMD", ""),
        )
        return v_log_scales, v_logits, None


# Variance in pixels of the closest camera, as in Mip-Splatting.
_VARIANCE = 0.2
# Standard deviation as a fraction of the depth from the closest camera.
_LARGEST = 0.05
# What is farther than this many times the depth that a view shows is hidden from it.
_HIDDEN = 1.1


class ScaleLimits(NamedTuple):
    """Of N Gaussians, by the depth from the closest of the views that see their centres."""

    smallest: Tensor  # (N,) [m], added, squared, to their standard deviations; 0 where none sees it
    largest: Tensor  # (N,) [m], of their standard deviations

    @classmethod
    def none(cls, like: Tensor) -> "ScaleLimits":
        """No limits for as many Gaussians as `like` (N,) has numbers."""
        return cls(torch.zeros_like(like), torch.full_like(like, torch.inf))

    def rebuild(self, rows: Tensor, added: int) -> "ScaleLimits":
        """The limits of the Gaussians `rows`, and of `added` ones, which have none."""
        kept = ScaleLimits(*(values[rows] for values in self))
        new = ScaleLimits.none(self.smallest.new_empty(added))
        return ScaleLimits(*(torch.cat(pair) for pair in zip(kept, new, strict=True)))


@torch.no_grad()
def scale_limits(means: Tensor, views: ReconstructionViews, bounded: bool) -> ScaleLimits:
    """Returns how small and large Gaussians may be.

    The smallest is the 3D smoothing filter of Mip-Splatting (Yu et al. 2024), a variance of 0.2
    square pixels in the closest view: smaller Gaussians are seen by the blur of colours alone;
    depth, which has none, would look through between them, and so would a camera that comes closer.
    The largest is a twentieth of the depth, or, where none sees the centre, of the distance from
    the closest camera: Gaussians are drawn as if perspective were the same all over each, so that
    large ones stand as haze before cameras that come close, and nothing says what those are that no
    view sees whole; they grow through rooms, and stand as walls before cameras that come by.

    Args:
        means: (N, 3) [m].
        views: what is fitted.
        bounded: whether there is a largest. Gaussians that do not start on surfaces need to reach.
    """
    K, viewmats = views.K[0].to(means.device), views.viewmats.to(means.device)
    closest = torch.full_like(means[:, 0], torch.inf)  # [m]
    nearest = torch.full_like(means[:, 0], torch.inf)  # [m], camera, whether or not it sees it
    for k, X_CW in enumerate(viewmats):
        p_CQ = means @ X_CW[:3, :3].T + X_CW[:3, 3]
        nearest = torch.minimum(nearest, p_CQ.norm(dim=1))
        z = p_CQ[:, 2]
        u, v, _ = (p_CQ / z[:, None] @ K.T).unbind(dim=1)
        inside = (z > 0) & (u >= 0) & (u < views.width) & (v >= 0) & (v < views.height)
        number = inside.nonzero()[:, 0]
        row, column = v[number].long().cpu(), u[number].long().cpu()
        shown = views.depths[k][row, column].to(means.device)
        number = number[(shown <= 0) | (z[number] < _HIDDEN * shown)]
        closest[number] = torch.minimum(closest[number], z[number])
    seen = closest.isfinite()
    smallest = torch.where(seen, _VARIANCE**0.5 / K[0, 0] * closest, 0)
    largest = torch.full_like(closest, torch.inf)
    if bounded:
        largest = _LARGEST * torch.where(seen, closest, nearest)
    return ScaleLimits(smallest, largest)


MEAN_DECAY, SQUARE_DECAY = 0.9, 0.999
EPSILON = 1e-15
"""Of 3D Gaussian splatting: gradients of single Gaussians are tiny."""


@torch.no_grad()
def adam_step(
    parameters: Tensor, gradients: Tensor, mean: Tensor, square: Tensor, rate: float, step: int
) -> None:
    """Moves `parameters` by `rate` down their gradients, and with these the moving averages `mean`
    of them and `square` of their squares, all of one shape.

    float32 tensors on the CPU go through native code in one pass.

    Args:
        step: 1 for the first.
    """
    if gradients.device.type == "cpu" and gradients.dtype == torch.float32:
        _native.adam_step(
            parameters=parameters.detach().view(-1).numpy(),
            gradients=gradients.contiguous().view(-1).numpy(),
            means=mean.view(-1).numpy(),
            squares=square.view(-1).numpy(),
            rate=rate,
            step=step,
            mean_decay=MEAN_DECAY,
            square_decay=SQUARE_DECAY,
            epsilon=EPSILON,
            simd=os.environ.get("SPLATPILOT_SIMD", ""),
        )
        return
    mean.lerp_(gradients, 1 - MEAN_DECAY)
    square.mul_(SQUARE_DECAY).addcmul_(gradients, gradients, value=1 - SQUARE_DECAY)
    deviation = square.sqrt() / math.sqrt(1 - SQUARE_DECAY**step) + EPSILON
    parameters.addcdiv_(mean, deviation, value=-rate / (1 - MEAN_DECAY**step))


# Opacities at the ends of [0, 1] have infinite logits, which no gradient moves.
_OPACITIES = (1e-4, 1 - 1e-4)
# Gaussians fainter than this add to no pixel.
_INVISIBLE = 1 / 255
# Standard deviation of a surfel across itself [m].
_FLAT = 1e-6


class SplatParameters:
    """N Gaussians as unconstrained tensors, with an Adam of a learning rate for each kind.

    `means` (N, 3) [m]; `quats` (N, 4) wxyz of any length; `log_scales` (N, 3); `logit_opacities`
    (N,); `sh_0` (N, 1, 3) and, if the degree is not 0, `sh_rest` (N, K - 1, 3). Beside them
    `limits` of the scales, which are no parameters.
    """

    def __init__(
        self,
        tensors: Mapping[str, Tensor],
        memory: Mapping[str, Sequence[Tensor]] | None = None,
        steps: int = 0,
        limits: Sequence[Tensor] | None = None,
    ):
        self._tensors = {name: tensor.clone().requires_grad_() for name, tensor in tensors.items()}
        # Of each parameter Adam's moving averages of gradients and of their squares.
        self._memory: dict[str, tuple[Tensor, Tensor]] = {}
        for name, tensor in tensors.items():
            mean, square = memory[name] if memory else [torch.zeros_like(tensor)] * 2
            self._memory[name] = mean.clone(), square.clone()
        self._steps = steps
        none = ScaleLimits.none(tensors["logit_opacities"])
        self.limit_scales(none if limits is None else ScaleLimits(*limits))

    @classmethod
    def of_scene(cls, scene: GaussianScene, sh_degree: int, device: str) -> "SplatParameters":
        """Starts from `scene`, its spherical harmonics cut or filled up to the degree."""
        coefficients = (sh_degree + 1) ** 2
        sh = np.zeros((len(scene), coefficients, 3), dtype=np.float32)
        K = min(coefficients, scene.sh.shape[1])
        sh[:, :K] = scene.sh[:, :K]
        tensors = {
            "means": torch.from_numpy(scene.means.copy()),
            "quats": torch.from_numpy(scene.quats.copy()),
            "log_scales": torch.from_numpy(np.log(scene.scales)),
            "logit_opacities": torch.logit(torch.from_numpy(scene.opacities.clip(*_OPACITIES))),
            "sh_0": torch.from_numpy(sh[:, :1].copy()),
        }
        if sh_degree:
            tensors["sh_rest"] = torch.from_numpy(sh[:, 1:].copy())
        return cls({name: tensor.to(device) for name, tensor in tensors.items()})

    def __getitem__(self, name: str) -> Tensor:
        return self._tensors[name]

    def __len__(self) -> int:
        return len(self["means"])

    @property
    def names(self) -> list[str]:
        return list(self._tensors)

    @property
    def sh(self) -> Tensor:
        """(N, K, 3)."""
        if "sh_rest" not in self._tensors:
            return self["sh_0"]
        return torch.cat([self["sh_0"], self["sh_rest"]], dim=1)

    def shapes(self) -> tuple[Tensor, Tensor]:
        """Scales (N, 3) [m], to which the smallest are added, and opacities (N,) in (0, 1)."""
        smallest = self._limits.smallest
        return splat_shapes(self["log_scales"], self["logit_opacities"], smallest)

    @property
    def scales(self) -> Tensor:
        """(N, 3) [m], see `shapes`."""
        return self.shapes()[0]

    @property
    def opacities(self) -> Tensor:
        """(N,), see `shapes`."""
        return self.shapes()[1]

    def limit_scales(self, limits: ScaleLimits) -> None:
        """Sets the limits; what is beyond the largest comes back to it, now and after each step."""
        self._limits = limits
        self._log_largest = torch.log(limits.largest)[:, None]
        self._clamp_scales()

    def step(self, rates: Mapping[str, float]) -> None:
        """Moves all parameters along their gradients, each kind by its learning rate, and forgets
        the gradients."""
        self._steps += 1
        for name, tensor in self._tensors.items():
            if tensor.grad is not None:
                adam_step(tensor, tensor.grad, *self._memory[name], rates[name], self._steps)
                tensor.grad = None
        self._clamp_scales()

    @torch.no_grad()
    def rebuild(self, rows: Tensor, added: Mapping[str, Tensor] | None = None) -> None:
        """Keeps the Gaussians `rows` (indices), in that order, and appends those `added`, of which
        Adam remembers nothing and whose scales have no limits."""
        for name in self.names:
            old = self[name]
            extra = old[:0] if added is None else added[name]
            self._tensors[name] = torch.cat([old[rows], extra]).requires_grad_()
            mean, square = (
                torch.cat([values[rows], torch.zeros_like(extra)]) for values in self._memory[name]
            )
            self._memory[name] = mean, square
        self.limit_scales(self._limits.rebuild(rows, 0 if added is None else len(added["means"])))

    @torch.no_grad()
    def overwrite(self, name: str, values: Tensor, rows: Tensor | slice = slice(None)) -> None:
        """Sets a parameter of the Gaussians `rows`, of which Adam then remembers nothing."""
        self[name][rows] = values
        for average in self._memory[name]:
            average[rows] = 0

    def state(self) -> dict[str, Any]:
        """Returns all that makes these parameters and their Adam again, see `__init__`."""
        return {
            "tensors": {name: self[name].detach().clone() for name in self.names},
            "memory": {name: [v.clone() for v in self._memory[name]] for name in self.names},
            "steps": self._steps,
            "limits": list(self._limits),
        }

    @torch.no_grad()
    def scene(self, flat: bool) -> GaussianScene:
        """Returns those Gaussians that can be seen, `flat` ones with a third scale of next to
        nothing."""
        scales, opacities = self.shapes()
        visible = opacities >= _INVISIBLE
        if flat:
            scales[:, 2] = _FLAT
        arrays = (self["means"], self["quats"], scales, opacities, self.sh)
        return GaussianScene(*(a[visible].cpu().numpy() for a in arrays))

    @torch.no_grad()
    def _clamp_scales(self) -> None:
        # The parameters themselves: the gradient of a clamped function would end at the limit.
        self["log_scales"].clamp_(max=self._log_largest)


# The learning rate of the means falls to this fraction.
_LAST_OF_MEANS = 0.01
# Gaussians that start from depth are where they belong: their means move slower, and what they look
# like is found in a quarter of the steps by rates that are higher at first and fall to a fraction.
_ON_SURFACE = {"means": 0.25, "quats": 6.0, "log_scales": 6.0, "sh_0": 3.0, "sh_rest": 3.0}
_LAST_ON_SURFACE = 0.1


def learning_rates(config: ReconstructConfig, extent: float, part: float) -> dict[str, float]:
    """Returns the learning rate of each parameter of `SplatParameters`.

    Args:
        config: with rates as published for Gaussians that start anywhere.
        extent: [m] of the scene, by which the means' is scaled.
        part: of all steps, 0 to 1, that have been taken.
    """
    rates = {
        "means": config.means_rate * extent * _LAST_OF_MEANS**part,
        "quats": config.quats_rate,
        "log_scales": config.scales_rate,
        "logit_opacities": config.opacities_rate,
        "sh_0": config.colors_rate,
        "sh_rest": config.colors_rate / 20,
    }
    if config.initialization != "depth":
        return rates
    slower = _LAST_ON_SURFACE + (1 - _LAST_ON_SURFACE) * (1 + math.cos(math.pi * part)) / 2
    return {
        name: rate * _ON_SURFACE.get(name, 1.0) * (1.0 if name == "means" else slower)
        for name, rate in rates.items()
    }
