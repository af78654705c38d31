"""What is optimised: the parameters of Gaussians, and Adam's memory of each."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.training.reconstruction.adam import adam_step
from splatpilot.training.reconstruction.scale_limits import ScaleLimits
from splatpilot.training.reconstruction.splat_shapes import splat_shapes

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
