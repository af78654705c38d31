"""An own policy in the benchmark: one file, without installation.

    cd examples && splatpilot --import own_policy fly --policy own_policy:SidestepConfig
    splatpilot --import own_policy benchmark --policies own_policy:SidestepConfig,straight \\
        --scenarios P02 --seeds 5 --out out/sidestep

A policy is a LeafSystem with any of the inputs `state`, `goal` and images of a camera of its own,
and one of the outputs `hypotheses`, `acceleration`, `velocity`, `waypoint` and `command`; and a
dataclass that configures it. This one flies straight to the goal, around obstacles in its depth
image.
`examples/hedgehop` is a package of its own, with worlds and sensors too.
"""

from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F

import splatpilot as sp


@dataclass
class SidestepConfig(sp.Config):
    """Fields of `--set policy.X=` and of scenario files."""

    speed: float = sp.bounded(2.0, "(0, 20] m/s")
    rate: float = sp.bounded(15.0, "(0, 100] Hz")  # of updates
    reach: float = sp.bounded(4.0, "(0, 20] m")  # depth below which obstacles are avoided
    camera: sp.OnboardCamera = field(default_factory=sp.OnboardCamera)


class Sidestep(LeafSystem):
    """Inputs `state` (13), `goal` (3), `depth_image_32f`; output `velocity` (3) [m/s], v_WB."""

    def __init__(self, config: SidestepConfig):
        super().__init__()
        self.camera, self._config = config.camera, config
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorInputPort("goal", 3)
        self.DeclareAbstractInputPort("depth_image_32f", Value(ImageDepth32F()))
        # The velocity is state of the Context: the output keeps it until the next update.
        self.DeclareStateOutputPort("velocity", self.DeclareDiscreteState(3))
        self.DeclarePeriodicDiscreteUpdateEvent(1 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = sp.QuadrotorState.of(self.GetInputPort("state").Eval(context))
        offset = self.GetInputPort("goal").Eval(context) - state.p_WB
        depth = self.GetInputPort("depth_image_32f").Eval(context).data[..., 0]  # (H, W) [m]
        depth = depth[depth.shape[0] // 4 : 3 * depth.shape[0] // 4]  # neither sky nor ground
        near = np.clip(1 - depth / self._config.reach, 0, 1).max(axis=0)  # (W,) in [0, 1]
        left, right = np.split(near, 2)
        ahead = offset / max(np.linalg.norm(offset), 1.0)
        to_left = np.array([-ahead[1], ahead[0], 0.0])
        step = to_left * (right.mean() - left.mean()) * 4
        discrete_state.set_value(self._config.speed * (ahead * (1 - near.mean()) + step))


sp.register_policy(SidestepConfig, lambda config, world, scenario: Sidestep(config))
