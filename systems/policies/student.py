"""Student: three trajectories from one image of colours or depth, imitated."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, cast

import cv2
import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.policies.base import require_speed
from splatpilot.systems.policies.checkpoint import (
    OnnxModel,
    PolicyCheckpoint,
    check_weights,
    shipped_weights,
)
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, Hypotheses, no_plan
from splatpilot.systems.policies.lattice import BASIS, HORIZON, MARGIN, unobstructed_way
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state

NEAREST, FARTHEST = 0.3, 20.0  # [m] range of depth
STATE_SIZE = 9


def encode_color(color: np.ndarray) -> np.ndarray:
    """Colours (H, W, 3) uint8 as (3, H, W): 0 to 255 as -1 to 1."""
    return color.transpose(2, 0, 1) * np.float32(1.0 / 127.5) - np.float32(1.0)


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Planar depth (H, W) [m] as a grey image (3, H, W): its logarithm, near 1 and far -1.

    Equal ratios of depths are equal contrasts, wherever they are.
    """
    z = np.log(np.clip(depth, NEAREST, FARTHEST, dtype=np.float32))
    near, far = np.log(NEAREST), np.log(FARTHEST)
    encoded = np.float32((far + near) / (far - near)) - np.float32(2.0 / (far - near)) * z
    return np.broadcast_to(encoded, (3, *depth.shape))


def state_observation(
    X_WB: RigidTransform, v_WB: np.ndarray, p_WG: np.ndarray, reach: float
) -> np.ndarray:
    """(9,), in the body frame: velocity [m/s], the vector to the goal, of length 1 beyond `reach`
    [m] and in proportion nearer, and the unit vector upwards."""
    R_WB = X_WB.rotation().matrix()
    to_goal = p_WG - X_WB.translation()
    towards = to_goal / max(float(np.linalg.norm(to_goal)), reach)
    return (np.stack([v_WB, towards, [0.0, 0.0, 1.0]]) @ R_WB).ravel()


def mirrored_vectors(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of the body frame in a mirror: left is right."""
    return vectors * np.array([1.0, -1.0, 1.0])


# MobileNetV2, the encoder of images, without torch: its layers, and its forward pass by OpenCV.
#
# After "MobileNetV2: Inverted Residuals and Linear Bottlenecks" (M. Sandler et al., CVPR 2018), of
# width 1. Layers have the names of torchvision's, in which each batch norm is a bias alone: the
# rest of it is folded into the convolution before.


BLOCKS = 19
"""Modules of the encoder, the first and the last a single convolution."""

CHANNELS = 1280
"""Of its output, which has a 32nd of the image's height and width, rounded up."""

_STAGES = (
    (1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2),
    (6, 320, 1, 1),
)  # fmt: skip
"""Expansion, channels, blocks and first stride of each stage between the first and last."""


@dataclass(frozen=True)
class Convolution:
    """A convolution with bias."""

    weight: str
    """Name of its weights (outputs, inputs / groups, kernel, kernel)."""
    bias: str
    """Name of its biases (outputs,)."""
    inputs: int
    outputs: int
    kernel: int = 1
    stride: int = 1
    groups: int = 1
    rectified: bool = True
    """Whether its output is limited to 0 to 6."""

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The name and shape of its arrays of weights."""
        shape = (self.outputs, self.inputs // self.groups, self.kernel, self.kernel)
        return {self.weight: shape, self.bias: (self.outputs,)}


def mobilenet_blocks() -> list[list[Convolution]]:
    """The convolutions of each of the `BLOCKS` modules.

    A module of several whose input and output have the same shape adds its input to its output.
    """

    def of(prefix: str, *numbers, **options) -> Convolution:
        return Convolution(f"{prefix}.0.weight", f"{prefix}.1.bias", *numbers, **options)

    blocks = [[of("features.0", 3, 32, 3, 2)]]
    inputs = 32
    for expansion, outputs, count, first_stride in _STAGES:
        for i in range(count):
            name, hidden = f"features.{len(blocks)}.conv", expansion * inputs
            stride = first_stride if i == 0 else 1
            block = [of(f"{name}.0", inputs, hidden)] if expansion > 1 else []
            n = len(block)
            block.append(of(f"{name}.{n}", hidden, hidden, 3, stride, hidden))
            weight, bias = f"{name}.{n + 1}.weight", f"{name}.{n + 2}.bias"
            block.append(Convolution(weight, bias, hidden, outputs, rectified=False))
            blocks.append(block)
            inputs = outputs
    return [*blocks, [of("features.18", inputs, CHANNELS)]]


def adds_input(block: list[Convolution]) -> bool:
    """Whether a module adds its input to its output."""
    same = block[0].inputs == block[-1].outputs and all(c.stride == 1 for c in block)
    return len(block) > 1 and same


def mobilenet_shapes() -> dict[str, tuple[int, ...]]:
    """The name and shape of every array of weights."""
    return {k: v for block in mobilenet_blocks() for c in block for k, v in c.shapes().items()}


class MobileNet:
    """The encoder with its weights, run by OpenCV: the same bits on any number of its threads.

    Args:
        height, width: of the images [px].
        weights: arrays by the names of `mobilenet_shapes`, single precision.
    """

    def __init__(self, height: int, width: int, weights: Mapping[str, np.ndarray]) -> None:
        model = OnnxModel((3, height, width))
        for block in mobilenet_blocks():
            before = model.output
            for layer in block:
                weight, bias = weights[layer.weight], weights[layer.bias]
                model.convolution(weight, bias, stride=layer.stride, groups=layer.groups)
                if layer.rectified:
                    model.clip(0.0, 6.0)
            if adds_input(block):
                model.add(before)
        features = CHANNELS, -(-height // 32), -(-width // 32)
        self._net = cv2.dnn.readNetFromONNX(model.serialize(features))

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """The features (CHANNELS, h, w) of an image (3, height, width) of numbers -1 to 1."""
        self._net.setInput(np.ascontiguousarray(image[None], np.float32))
        return self._net.forward()[0]


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


RATE = 15.0  # [Hz]


class StudentNetwork:
    """The network with its weights, in OpenCV and numpy.

    Asked for another speed than its expert's it does in proportion what it would do at that: where
    half as fast, it is told twice its velocity, and deviates half as far from the way, which is
    flown at the speed asked for.

    Args:
        spec: the architecture.
        weights: by the names of `StudentSpec.weight_shapes`.
        speed: [m/s], nominal, that it is asked for; its expert's if None.

    Raises:
        ValueError: if weights are missing, of another shape or not finite.
    """

    def __init__(
        self,
        spec: StudentSpec,
        weights: dict[str, np.ndarray],
        speed: float | None = None,
    ) -> None:
        self.spec = spec
        self._speed = spec.nominal_speed if speed is None else speed
        self._weights = check_weights(weights, spec.weight_shapes())
        self._encoder = MobileNet(spec.height, spec.width, self._weights)

    @property
    def reach(self) -> float:
        """[m] from the goal, within which its distance is told."""
        return HORIZON * self._speed

    @property
    def pace(self) -> float:
        """[-] The speed asked for, over the expert's."""
        return self._speed / self.spec.nominal_speed

    def __call__(self, image: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Waypoints (3, 10, 3) [m] in the body frame and costs (3,).

        Args:
            image: (3, height, width), see `encode_color` and `encode_depth`.
            state: (9,), see `state_observation`; with the velocity over `pace`.

        Raises:
            ValueError: if the image has another shape.
        """
        spec = self.spec
        if np.shape(image) != (3, spec.height, spec.width):
            raise ValueError(
                f"the student's image has shape {np.shape(image)}, but its network takes "
                f"{(3, spec.height, spec.width)}; give it a camera of {spec.width}x{spec.height}"
            )
        features = self._encoder(image).reshape(CHANNELS, -1)
        cells = _rectified(self._linear("cell_layer", features.T))
        y = _rectified(self._linear("state_layer", np.asarray(state, np.float32)))
        y = _rectified(self._linear("state_layer_2", y))
        joined = np.concatenate([cells.ravel(), y])
        if spec.head_features:
            joined = _rectified(self._linear("hidden_layer", joined))
        output = self._linear("head", joined).reshape(HYPOTHESES, -1)
        v_B, towards, up_B = np.reshape(state, (3, 3))
        goal_B = self.reach * towards
        way = spec.way(self.pace * v_B, goal_B, up_B, self._speed)
        waypoints = output[:, :-1].reshape(HYPOTHESES, NUM_WAYPOINTS, 3)
        return way + self.pace * spec.deviations(waypoints, goal_B), output[:, -1]

    def _linear(self, name: str, x: np.ndarray) -> np.ndarray:
        return x @ self._weights[f"{name}.weight"].T + self._weights[f"{name}.bias"]


def _rectified(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, np.float32(0.0))


def load_network(path: str, observation: str, speed: float | None = None) -> StudentNetwork:
    """The network from a file of weights, see `PolicyCheckpoint.load`, asked for a speed [m/s]."""
    checkpoint = PolicyCheckpoint.load(path, f"student_{observation}", StudentSpec)
    return checkpoint.build(partial(StudentNetwork, speed=speed))


def plan(
    network: StudentNetwork,
    time: float,
    image: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    *,
    mirrored: bool = False,
) -> Hypotheses:
    """The hypotheses of one observation.

    Args:
        time: [s].
        image: (H, W, 3) uint8 colours or (H, W) [m] planar depth, as `network.spec.observation`.
        X_WB, v_WB: pose and velocity [m/s].
        p_WG: the goal [m].
        mirrored: whether the network sees all in a mirror, the image and what it is told, and its
            waypoints are mirrored back.

    Raises:
        ValueError: for an image of another size.
    """
    encode = encode_color if network.spec.pixels == "color" else encode_depth
    state = state_observation(X_WB, v_WB / network.pace, p_WG, network.reach)
    seen = encode(image)
    if mirrored:
        seen = np.ascontiguousarray(seen[:, :, ::-1])
        state = mirrored_vectors(state.reshape(3, 3)).ravel()
    waypoints_B, costs = network(seen, state)
    if mirrored:
        waypoints_B = mirrored_vectors(waypoints_B)
    return Hypotheses(time, X_WB, waypoints_B.astype(float), costs.astype(float))


ALIKE = 0.3
"""[m] Root mean square distance over which two trajectories cease to say the same."""
SHARPNESS = 2.0
"""[-] By how much the logarithm of a hypothesis's say falls for each unit of its cost."""


def consensus(waypoints: np.ndarray, costs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What hypotheses say together, about each of them.

    One step of mean shift, from every hypothesis: with weights
    w_mn = exp(-SHARPNESS c_n - |T_m - T_n|^2 / (T ALIKE^2)) the mean sum_n w_mn T_n / sum_n w_mn,
    and the cost -log sum_n w_mn: the cheapest is where most agree, and errors that they do not
    share average out.

    Args:
        waypoints: (M, T, 3) [m].
        costs: (M,).

    Returns:
        waypoints (M, T, 3) [m] and costs (M,).
    """
    apart = np.square(waypoints[:, None] - waypoints[None]).sum(3).mean(2)  # (M, M)
    weights = np.exp(-SHARPNESS * costs - apart / ALIKE**2)
    sums = weights.sum(1)
    return np.einsum("mn,ntk->mtk", weights / sums[:, None], waypoints), -np.log(sums)


def plan_both_views(
    network: StudentNetwork,
    time: float,
    image: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
) -> Hypotheses:
    """The consensus of the six hypotheses of an image, three of them seen in a mirror.

    Args, raises: see :func:`~splatpilot.systems.policies.student.plan`.
    """
    views = [
        plan(network, time, image, X_WB, v_WB, p_WG, mirrored=mirrored)
        for mirrored in (False, True)
    ]
    waypoints_B, costs = consensus(
        np.concatenate([view.waypoints_B for view in views]),
        np.concatenate([view.costs for view in views]),
    )
    return Hypotheses(time, X_WB, waypoints_B, costs)


@dataclass
class StudentConfig:
    """The student's weights, what it is asked for, and the camera that it sees through."""

    observation: ClassVar[str]
    """What it sees: rgb or depth."""
    shipped: ClassVar[str]
    """The name of its weights that ship."""
    mirrored: ClassVar[bool] = False
    """Whether it sees each image in a mirror too, and flies what both views agree upon, which at
    the goal is the unobstructed way."""
    rate: ClassVar[float] = RATE

    # [m/s] Speed that it is asked to fly at; the model card of its weights says its expert's.
    speed: float = 2.0
    # File of weights, as `splatpilot train` writes them; those that ship where left empty.
    weights: str = ""
    # With the size and field of view that it was trained with.
    camera: OnboardCamera = field(default_factory=lambda: OnboardCamera(width=160, height=120))

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        require_speed(self)
        self.camera.validate()


@dataclass
class StudentRgbConfig(StudentConfig):
    """A student that sees colours."""

    observation = "rgb"
    shipped = "student_rgb"


@dataclass
class PilotRgbConfig(StudentRgbConfig):
    """A student that sees colours twice, as they are and in a mirror. Any weights of `student_rgb`
    fit it; those that ship are its own."""

    shipped = "pilot_rgb"
    mirrored = True


@dataclass
class StudentDepthConfig(StudentConfig):
    """A student that sees depth."""

    observation = "depth"
    shipped = "student_depth"


class Student(LeafSystem):
    """Plans three trajectories with costs from an image of colours or of depth.

    .. pydrake_system::

        name: Student
        input_ports:
        - state
        - goal
        - color_image or depth_image_32f
        output_ports:
        - hypotheses

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``color_image`` (RGBA) or ``depth_image_32f`` (planar [m]) of the camera ``config.camera``, by
      ``config.observation``.
    - ``hypotheses`` (8 + 31 * 3): as `Hypotheses.to_vector`, in the body frame B at the time of
      planning; a discrete state, NaN before the first update. Six of them, (8 + 31 * 6), of a
      config that is ``mirrored``.

    Updates at 15 Hz from time 0 by
    :func:`~splatpilot.systems.policies.student.plan`, or, ``mirrored``, by
    :func:`~splatpilot.systems.policies.student.plan_both_views`.

    Raises:
        ValueError, FileNotFoundError: from the constructor on a config out of range, on weights
            that are missing, damaged, or of another policy, version or architecture, and for a
            camera other than these were trained with.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    hypotheses_output_port = output_port("hypotheses")

    def __init__(self, config: StudentConfig) -> None:
        super().__init__()
        config.validate()
        weights = config.weights or str(shipped_weights(config.shipped))
        self._network = load_network(weights, config.observation, config.speed)
        spec, camera = self._network.spec, config.camera
        for name in ("width", "height", "fov_x"):
            given, trained = getattr(camera, name), getattr(spec, name)
            if given != trained:
                raise ValueError(
                    f"camera.{name} of the student is {given}, but its weights were trained with "
                    f"{trained}; set it to that, or give weights that were trained with {given}"
                )
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        name, image = {
            "rgb": ("color_image", ImageRgba8U),
            "depth": ("depth_image_32f", ImageDepth32F),
        }[config.observation]
        self._image_port = self.DeclareAbstractInputPort(
            name, Value(image(camera.width, camera.height))
        )
        self._plan = plan_both_views if config.mirrored else plan
        plans = no_plan(2 * HYPOTHESES if config.mirrored else HYPOTHESES)
        self.DeclareStateOutputPort("hypotheses", self.DeclareDiscreteState(plans))
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = np.asarray(self._state_port.Eval(context))
        pixels = np.asarray(cast(Any, self._image_port.Eval(context)).data)  # (H, W, 4 or 1)
        image = pixels[..., :3] if self._network.spec.observation == "rgb" else pixels[..., 0]
        hypotheses = self._plan(
            self._network,
            context.get_time(),
            image,
            pose_from_state(state),
            QuadrotorState.of(state).v_WB,
            np.asarray(self._goal_port.Eval(context)),
        )
        discrete_state.set_value(hypotheses.to_vector())
