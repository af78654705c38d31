"""The student's architecture, and what its network's output means."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS
from splatpilot.systems.policies.mobilenet import CHANNELS, mobilenet_shapes
from splatpilot.systems.policies.student_observation import STATE_SIZE
from splatpilot.systems.policies.unobstructed_way import (
    BASIS,
    HORIZON,
    MARGIN,
    unobstructed_way,
)

HYPOTHESES = 3
OBSERVATIONS = "rgb", "depth"
WAYPOINT_SCALE = 2.0  # [m] from the unobstructed way that 1 at the network's output means
AT_HAND = 1.0  # [m] from the goal, within which deviations fade
STOPPED = 0.77
"""[-] Part of the goals out of reach at which rounding stopped the way with which weights of
`way_version` 1 learned."""


@dataclass(frozen=True)
class StudentSpec:
    """The architecture: MobileNetV2 for the image, layers for the state, a head for all hypotheses,
    whose waypoints are deviations from the unobstructed way."""

    weights_type: ClassVar[type] = np.float16
    """That files of weights have: 2.4 million take 4 MB, and waypoints change by less than a
    millimetre."""

    observation: str = "depth"
    """One of `OBSERVATIONS`."""
    width: int = 160
    height: int = 120
    """Of the images [px]."""
    fov_x: float = 90.0
    """Of the camera [deg]."""
    cell_features: int = 64
    """To which the encoder's channels are reduced in each of its cells, which are then kept apart:
    where something is decides where to fly."""
    state_features: int = 64
    head_features: int = 256
    """Of the layer between what was seen and told and the linear one that the hypotheses are of: a
    sum of both alone cannot say what is in the way of where to go. None where 0."""
    nominal_speed: float = 2.0
    """[m/s] of the expert."""
    way_version: int = 1
    """2 in what is trained. Files that do not say learned with the first, when rounding decided
    whether the unobstructed way to a goal out of reach stops there, and deviations did not fade at
    the goal."""

    def __post_init__(self) -> None:
        """Raises ValueError for a field that no network can be made with."""
        if self.observation not in OBSERVATIONS:
            raise ValueError(f"observation is {self.observation!r}; it must be of {OBSERVATIONS}")
        for name in ("width", "height", "cell_features", "state_features"):
            value = getattr(self, name)
            if not isinstance(value, int) or not 1 <= value <= 4096:
                raise ValueError(f"{name} is {value!r}; it must be 1 to 4096")
        if not isinstance(self.head_features, int) or not 0 <= self.head_features <= 4096:
            raise ValueError(f"head_features is {self.head_features!r}; it must be 0 to 4096")
        if self.way_version not in (1, 2):
            raise ValueError(f"way_version is {self.way_version!r}; it must be 1 or 2")
        for name, least, most in (("fov_x", 1.0, 179.0), ("nominal_speed", 0.1, 20.0)):
            value = getattr(self, name)
            if not isinstance(value, int | float) or not least <= value <= most:
                raise ValueError(f"{name} is {value!r}; it must be {least:g} to {most:g}")

    @property
    def pixels(self) -> str:
        """The name of what it sees, of a sample of a corpus: `color` or `depth`."""
        return {"rgb": "color", "depth": "depth"}[self.observation]

    def way(self, v_B: Any, goal_B: Any, up_B: Any, speed: float, basis: Any = BASIS) -> Any:
        """What waypoints deviate from (..., 10, 3) [m], see `unobstructed_way`.

        Of `way_version` 1 the mean of the ways that stop at a goal out of reach and that fly on, as
        often as rounding had chosen each in training: told nothing of its choice, the network
        learned what is left from their mean.
        """
        if self.way_version > 1:
            return unobstructed_way(v_B, goal_B, up_B, speed, basis)
        stopping, going = (
            unobstructed_way(v_B, part * goal_B, up_B, speed, basis, margin=0.0)
            for part in (1.0 - MARGIN, 1.0 + MARGIN)
        )
        return STOPPED * stopping + (1.0 - STOPPED) * going

    def deviations(self, output: Any, goal_B: Any) -> Any:
        """From the way, (..., M, T, 3) [m], in arrays and tensors.

        The way creeps up to a goal at hand: from rest 0.4 m before it, it leads 2 cm ahead in the
        controller's lookahead. A network that is off by as much hovers there for good, so within
        `AT_HAND` of the goal they fade with the square of the distance.

        Args:
            output: (..., M, T, 3), the network's.
            goal_B: (..., 3) [m], the vector to the goal.
        """
        left = ((goal_B * goal_B).sum(-1) / AT_HAND**2).clip(max=1.0)
        return WAYPOINT_SCALE * left[..., None, None, None] * output

    @property
    def reach(self) -> float:
        """[m] from the goal, within which its distance is told: where the expert arrives."""
        return HORIZON * self.nominal_speed

    def image_features(self) -> int:
        """Numbers that the image becomes."""
        return self.cell_features * -(-self.height // 32) * -(-self.width // 32)

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """The name and shape of every array of weights."""
        shapes = mobilenet_shapes()
        joined = self.image_features() + self.state_features
        layers = [
            ("cell_layer", CHANNELS, self.cell_features),
            ("state_layer", STATE_SIZE, self.state_features),
            ("state_layer_2", self.state_features, self.state_features),
            ("head", self.head_features or joined, HYPOTHESES * (3 * NUM_WAYPOINTS + 1)),
        ]
        if self.head_features:
            layers.append(("hidden_layer", joined, self.head_features))
        for name, inputs, outputs in layers:
            shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (outputs, inputs), (outputs,)
        return shapes
