"""Optimized parameters of Gaussians, their learning rates and the limits of their scales."""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.optim.adam import adam

from splatpilot import _native
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.views import ReconstructionViews

# As published: epsilon is small, for gradients of single Gaussians are tiny.
_ADAM: dict[str, Any] = {"fused": True, "amsgrad": False, "maximize": False, "weight_decay": 0.0}
_ADAM |= {"beta1": 0.9, "beta2": 0.999, "eps": 1e-15}
_OPACITIES = (1e-4, 1 - 1e-4)  # 0 and 1 have infinite logits
_INVISIBLE = 1 / 255  # opacity that adds to no pixel
_FLAT = 1e-6  # [m], standard deviation of a surfel along its normal

_MIN_VARIANCE = 0.2  # [px^2], in the closest camera
_MAX_DEVIATION = 0.05  # relative to the depth in the closest camera
_HIDDEN = 1.1  # ratio of a point's depth to that of its pixel, above which it is hidden

# As published for Gaussians that start anywhere; the rate of the means falls to a fraction.
_RATES = {
    "quats": 1e-3,
    "log_scales": 5e-3,
    "logit_opacities": 5e-2,
    "sh_0": 2.5e-3,
    "sh_rest": 1.25e-4,
}
_FINAL_MEANS = 0.01
# Factors for Gaussians that start on surfaces, and the fraction to which all but the means' fall.
_ON_SURFACE = {"quats": 6.0, "log_scales": 6.0, "sh_0": 3.0, "sh_rest": 3.0}
_FINAL_ON_SURFACE = 0.1


def learning_rates(config: ReconstructConfig, length: float, progress: float) -> dict[str, float]:
    """Returns the learning rate of each parameter of `SplatParameters`, given the fraction of all
    steps; `length` [m] scales that of the means. All others are faster at first for Gaussians that
    start from depth, which are on surfaces already."""
    rates = {"means": config.means_rate * length * _FINAL_MEANS**progress} | _RATES
    if config.initialization != "depth":
        return rates
    cosine = (1 + math.cos(math.pi * progress)) / 2
    decay = _FINAL_ON_SURFACE + (1 - _FINAL_ON_SURFACE) * cosine
    return {
        name: rate * _ON_SURFACE.get(name, 1.0) * (1.0 if name == "means" else decay)
        for name, rate in rates.items()
    }


def splat_shapes(
    log_scales: Tensor, logit_opacities: Tensor, smallest: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns scales (N, 3) = sqrt(exp(2 log_scales) + smallest^2) [m], with `smallest` (N,)
    without gradient, and opacities (N,), the sigmoid of their logits. float32 tensors on the CPU
    take native code."""
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


@torch.no_grad()
def scale_limits(means: Tensor, views: ReconstructionViews, bounded: bool) -> list[Tensor]:
    """Returns the smallest and largest scales (N,) [m] of Gaussians at `means` (N, 3) [m].

    The smallest is the 3D smoothing filter of Mip-Splatting (Yu et al. 2024), 0.2 square pixels in
    the closest view: depth images and closer cameras would look through the gaps between smaller
    ones. The largest, if `bounded`, is a twentieth of the depth in the closest view or, if none
    sees the center, of the distance to the closest camera: larger ones would appear as haze.
    """
    K, viewmats = views.K[0].to(means.device), views.viewmats.to(means.device)
    depth = torch.full_like(means[:, 0], torch.inf)  # [m] in the closest view that sees the center
    distance = torch.full_like(means[:, 0], torch.inf)  # [m] to the closest camera
    for k, X_CW in enumerate(viewmats):
        p_CQ = means @ X_CW[:3, :3].T + X_CW[:3, 3]
        distance = torch.minimum(distance, p_CQ.norm(dim=1))
        z = p_CQ[:, 2]
        u, v, _ = (p_CQ / z[:, None] @ K.T).unbind(dim=1)
        inside = (z > 0) & (u >= 0) & (u < views.width) & (v >= 0) & (v < views.height)
        index = inside.nonzero()[:, 0]
        pixels = v[index].long().cpu(), u[index].long().cpu()
        shown = torch.from_numpy(views.frames[k].depth)[pixels].to(means.device)
        index = index[(shown <= 0) | (z[index] < _HIDDEN * shown)]
        depth[index] = torch.minimum(depth[index], z[index])
    seen = depth.isfinite()
    smallest = torch.where(seen, _MIN_VARIANCE**0.5 / K[0, 0] * depth, 0)
    if not bounded:
        return [smallest, torch.full_like(depth, torch.inf)]
    return [smallest, _MAX_DEVIATION * torch.where(seen, depth, distance)]


class SplatParameters:
    """N Gaussians as unconstrained tensors, with Adam and the limits of their scales.

    `means` (N, 3) [m]; `quats` (N, 4) wxyz of any length; `log_scales` (N, 3); `logit_opacities`
    (N,); `sh_0` (N, 1, 3) and, if the degree is not 0, `sh_rest` (N, K - 1, 3).

    `limits` are the smallest and largest scale (N,) [m], 0 and infinity by default. The smallest is
    added in squares.
    """

    def __init__(
        self,
        tensors: Mapping[str, Tensor],
        averages: dict[str, list[Tensor]] | None = None,
        limits: Sequence[Tensor] | None = None,
    ):
        self._tensors = {n: t.detach().clone().requires_grad_() for n, t in tensors.items()}
        # Of each tensor the averages of the gradient and its square, and the number of steps. The
        # class `torch.optim.Adam` would take seconds to import torch's compiler.
        self._averages = averages or {
            name: [torch.zeros_like(t), torch.zeros_like(t), torch.zeros((), device=t.device)]
            for name, t in tensors.items()
        }
        self.limit_scales(limits or _no_limits(tensors["logit_opacities"]))

    @classmethod
    def of_scene(cls, scene: GaussianScene, sh_degree: int, device: str) -> "SplatParameters":
        """Starts from a scene; missing coefficients of spherical harmonics are 0."""
        sh = np.zeros((len(scene), (sh_degree + 1) ** 2, 3), dtype=np.float32)
        K = min(sh.shape[1], scene.sh.shape[1])
        sh[:, :K] = scene.sh[:, :K]
        arrays = {
            "means": scene.means,
            "quats": scene.quats,
            "log_scales": np.log(scene.scales),
            "logit_opacities": scene.opacities.clip(*_OPACITIES),
            "sh_0": sh[:, :1],
        }
        if sh_degree:
            arrays["sh_rest"] = sh[:, 1:]
        tensors = {name: torch.tensor(array, device=device) for name, array in arrays.items()}
        return cls(tensors | {"logit_opacities": torch.logit(tensors["logit_opacities"])})

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
        """Returns scales (N, 3) [m] and opacities (N,) in (0, 1)."""
        logits = self["logit_opacities"]
        return splat_shapes(self["log_scales"], logits, self._limits[0])

    @property
    def scales(self) -> Tensor:
        """(N, 3) [m]."""
        return self.shapes()[0]

    @property
    def opacities(self) -> Tensor:
        """(N,)."""
        return self.shapes()[1]

    def limit_scales(self, limits: Sequence[Tensor]) -> None:
        """Clamps scales to these limits, now and after each step."""
        self._limits = limits
        self._max_log_scales = torch.log(limits[1])[:, None]
        self._clamp_scales()

    @torch.no_grad()
    def step(self, rates: Mapping[str, float]) -> None:
        """Takes a step of Adam with these learning rates, and clears the gradients."""
        for name, tensor in self._tensors.items():
            if tensor.grad is not None:
                mean, square, count = ([each] for each in self._averages[name])
                adam([tensor], [tensor.grad], mean, square, [], count, lr=rates[name], **_ADAM)
                tensor.grad = None
        self._clamp_scales()

    @torch.no_grad()
    def rebuild(self, rows: Tensor, added: Mapping[str, Tensor] | None = None) -> None:
        """Keeps the Gaussians `rows`, in that order, and appends those `added`, without limits."""
        for name, old in self._tensors.items():
            extra = old[:0] if added is None else added[name]
            self._tensors[name] = torch.cat([old[rows], extra]).requires_grad_()
            for k in range(2):
                average = self._averages[name][k][rows]
                self._averages[name][k] = torch.cat([average, torch.zeros_like(extra)])
        limits = zip(self._limits, _no_limits(self["logit_opacities"][len(rows) :]), strict=True)
        self.limit_scales([torch.cat([old[rows], new]) for old, new in limits])

    @torch.no_grad()
    def overwrite(self, name: str, values: Tensor) -> None:
        """Sets a parameter (N, ...), and its averages in Adam to 0."""
        self[name].copy_(values)
        for average in self._averages[name][:2]:
            average.zero_()

    def state(self) -> dict[str, Any]:
        """Returns the arguments of `__init__` that restore these parameters; they are shared."""
        return {
            "tensors": {name: self[name].detach() for name in self.names},
            "averages": self._averages,
            "limits": list(self._limits),
        }

    @torch.no_grad()
    def scene(self, flat: bool) -> GaussianScene:
        """Returns the visible Gaussians; if `flat`, with a third scale close to 0."""
        scales, opacities = self.shapes()
        visible = opacities >= _INVISIBLE
        if flat:
            scales[:, 2] = _FLAT
        arrays = (self["means"], self["quats"], scales, opacities, self.sh)
        return GaussianScene(*(a[visible].cpu().numpy() for a in arrays))

    @torch.no_grad()
    def _clamp_scales(self) -> None:
        # The parameters, not a function of them: its gradient would vanish at the limit.
        self["log_scales"].clamp_(max=self._max_log_scales)


def _no_limits(like: Tensor) -> list[Tensor]:
    return [torch.zeros_like(like), torch.full_like(like, torch.inf)]
