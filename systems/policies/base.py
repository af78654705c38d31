"""Base classes of policies: what they observe, how they are configured and how they update.

Encodings of observations and network outputs take numpy arrays and torch tensors. The heading frame
H has its origin in the vehicle, z up and x above the body's x axis. Leading dimensions `...` are
batches.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    BasicVector_,  # pyright: ignore[reportAttributeAccessIssue]
    Context,
    DiscreteStateIndex,
    DiscreteValues,
    LeafSystem,
)
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.common.drake import ByValues, float_values, vector_input
from splatpilot.systems.common.validation import Config, bounded, require
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.state import (
    QuadrotorState,
    array_namespace,
    clip,
    pose_from_state,
    stack,
)


def pool_depth(depth: Any, height: int, width: int) -> Any:
    """Returns the minimum (..., height, width) [m] of each block of planar depth (..., H, W) [m].

    Obstacles thinner than a coarse pixel stay visible.
    """
    *batch, H, W = depth.shape
    blocks = depth.reshape(*batch, height, H // height, width, W // width)
    return array_namespace(depth).amin(blocks, (-3, -1))


def inverse_depth(depth: Any, min_depth: float, max_depth: float) -> Any:
    """Encodes planar depth (...,) [m] as 3 / z - 0.6, z clipped to [min_depth, max_depth]."""
    return 3.0 / depth.clip(min_depth, max_depth) - 0.6


def heading_frame(yaw: Any) -> Any:
    """Returns R_WH (..., 3, 3), the rotation about z by `yaw` (...,) [rad]."""
    xp = array_namespace(yaw)
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    zero, one = xp.zeros_like(yaw), xp.ones_like(yaw)
    entries = xp.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], -1)
    return entries.reshape(*entries.shape[:-1], 3, 3)


def target_velocity(p_WB: Any, p_WG: Any, speed: Any, slowing_time: float = 1.0) -> Any:
    """Returns the velocity (..., 3) [m/s] straight to the goal: (p_WG - p_WB) / max(distance /
    speed, slowing_time), at `speed` (...,) [m/s] until `slowing_time` [s] before it."""
    to_goal = p_WG - p_WB
    distance = array_namespace(to_goal).sqrt(clip((to_goal * to_goal).sum(-1), low=1e-6))
    return to_goal / stack([clip(distance / speed, low=slowing_time)])


def heading_observation(p_WB: Any, v_WB: Any, z_WB: Any, p_WG: Any, speed: Any, R_WH: Any) -> Any:
    """Returns (..., 9): target velocity, velocity [m/s] and the body's z axis z_WB, all (..., 3),
    in the heading frame."""
    rows = [target_velocity(p_WB, p_WG, speed), v_WB, z_WB]
    rows = array_namespace(v_WB).stack(rows, -2) @ R_WH
    return rows.reshape(*rows.shape[:-2], 9)


def limit_smoothly(output: Any, limits: Any) -> Any:
    """Limits a network's output (..., N) smoothly to +-limits (N,)."""
    return limits * array_namespace(output).tanh(output / limits)


GRID_SHAPE = 9, 16  # rows and columns of a depth grid

CHANNELS = {"depth_image_32f": (ImageDepth32F, 0), "color_image": (ImageRgba8U, slice(3))}
"""Type and channels of each image port of a camera."""


class Observation(NamedTuple):
    """The inputs of a policy at an update."""

    time: float  # [s]
    X_WB: RigidTransform
    state: QuadrotorState
    p_WG: np.ndarray  # (3,) [m], the goal
    # (H, W) [m] planar depth, (H, W, 3) uint8 RGB, or (9, 16) proximities; else empty.
    image: np.ndarray


def observation(time: Any, state: Any, p_WG: Any, image: Any = None) -> Observation:
    """Returns the observation of a state (13,), a goal (3,) [m] and, if any, an image."""
    image = np.empty(0) if image is None else image
    return Observation(time, pose_from_state(state), QuadrotorState.of(state), p_WG, image)


@dataclass
class LearnedPolicyConfig(Config):
    """The weights, speed and camera of a learned policy."""

    rate: ClassVar[float]
    """[Hz], of updates, as in training."""
    image_size: ClassVar[tuple[int, int]] = (1, 1)
    """Height and width [px] to which images are pooled."""

    # [m/s] Nominal speed; the model card of the weights names the speeds of training.
    speed: float = bounded(2.0, "[0.1, 10] m/s")
    # File of weights, as `splatpilot train` writes them; those that ship if empty.
    weights: str = ""
    # Camera of the policy; its width and height must be multiples of the network's.
    camera: OnboardCamera = field(default_factory=OnboardCamera)

    def check(self) -> None:
        height, width = self.image_size
        valid = self.camera.height % height == 0 and self.camera.width % width == 0
        condition = f"whole multiples of {width}x{height}"
        remedy = f"give the camera for example {4 * width}x{4 * height}"
        size = f"{self.camera.width}x{self.camera.height}"
        require(valid, "the size of the depth image", condition, size, remedy)


class Policy(LeafSystem):
    """Base class of policies: updates its discrete state by `decide`, from time 0 at the rate of
    its configuration.

    A subclass declares its outputs and memory with `declare_state`; output ports hold the initial
    values before the first update. The input ports are ``state`` (13), ``goal`` (3), p_WG [m] in
    the world, and the image:

    - ``depth_image_32f``: planar depth [m] of the camera ``config.camera``;
    - ``color_image``: RGBA of that camera;
    - ``depth_grid`` (144): proximities in 16x9 cells, see
      :class:`~splatpilot.systems.sensing.time_of_flight.TimeOfFlightGrid`.

    Converted to AutoDiffXd, a policy decides by the values of its inputs, and its decisions have
    zero derivatives; or exact ones, if it is `differentiable`.

    Args:
        config: has `rate` [Hz] and `validate()`; with an image of a camera, `camera`.
        image: name of the image port; empty if the policy has none.
    """

    differentiable: ClassVar[bool] = False
    """If `decide` also takes AutoDiffXd."""

    def __init__(self, config: Any, image: str = "") -> None:
        super().__init__(converter=_PolicyByValues.converter())
        config.validate()
        self.config, self.image = copy.deepcopy(config), image
        self.state_outputs: dict[str, DiscreteStateIndex] = {}
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        if image in CHANNELS:
            size = config.camera.width, config.camera.height
            value = Value(cast(Any, CHANNELS[image][0])(*size))
            self._image_port = self.DeclareAbstractInputPort(image, value)
        elif image:
            self._image_port = self.DeclareVectorInputPort(image, int(np.prod(GRID_SHAPE)))
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def declare_state(self, initial: ArrayLike, output: str = "") -> None:
        """Declares a group of the discrete state, with an output port if it has a name."""
        group = self.DeclareDiscreteState(np.asarray(initial, dtype=float))
        if output:
            self.DeclareStateOutputPort(output, group)
            self.state_outputs[output] = group

    def decide(self, observed: Observation, *state: np.ndarray) -> Sequence[np.ndarray]:
        """Returns the next values of the groups of `declare_state`, from the present ones."""
        raise NotImplementedError

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        x = np.asarray(self._state_port.Eval(context))
        p_WG = np.asarray(self._goal_port.Eval(context))
        image = self._read_image(context)
        observed = observation(context.get_time(), x, p_WG, image)
        old = context.get_discrete_state()
        groups = [np.array(old.value(i)) for i in range(old.num_groups())]
        for i, value in enumerate(self.decide(observed, *groups)):
            discrete_state.set_value(i, value)

    def _read_image(self, context: Context) -> np.ndarray:
        if not self.image:
            return np.empty(0)
        image = self._image_port.Eval(context)
        if self.image in CHANNELS:
            return np.asarray(cast(Any, image).data)[..., CHANNELS[self.image][1]]
        return np.reshape(cast(Any, image), GRID_SHAPE)


class _PolicyByValues(ByValues):
    """A policy for AutoDiffXd, see `Policy`."""

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy)
        start = policy.CreateDefaultContext().get_discrete_state()
        for group in range(start.num_groups()):
            self.DeclareDiscreteState(BasicVector_[AutoDiffXd](start.value(group)))
        for name, group in policy.state_outputs.items():
            self.DeclareStateOutputPort(name, group)
        update: Any = policy.GetUniquePeriodicDiscreteUpdateAttribute()
        self.DeclarePeriodicDiscreteUpdateEvent(
            update.period_sec(), update.offset_sec(), self._update
        )

    def _update(self, context, discrete_state):
        old = context.get_discrete_state()
        groups = [old.value(group) for group in range(old.num_groups())]
        if self._system.differentiable:
            state, goal = (vector_input(self, name, context) for name in ("state", "goal"))
            new = self._system.decide(observation(context.get_time(), state, goal), *groups)
        else:
            inner = self.context_of_values(context)
            for group, value in enumerate(groups):
                inner.SetDiscreteState(group, float_values(value))
            values = self._system.EvalUniquePeriodicDiscreteUpdate(inner)
            new = [values.value(group) for group in range(len(groups))]
        for group, value in enumerate(new):
            discrete_state.set_value(group, value)
