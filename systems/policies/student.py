"""Student: plans three trajectories from one RGB or depth image, learned by imitation.

The network is MobileNetV2 for the image, layers for the state, and a head for all hypotheses. It
runs without torch: the encoder in OpenCV, the rest in numpy.
"""

import math
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
from splatpilot.systems.common.validation import Config, bounded, require
from splatpilot.systems.policies.checkpoint import (
    OnnxModel,
    PolicyCheckpoint,
    check_weights,
    shipped_weights,
)
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, Hypotheses, no_plan
from splatpilot.systems.policies.lattice import BASIS, HORIZON, unobstructed_way
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.state import (
    QuadrotorState,
    array_namespace,
    lengths,
    pose_from_state,
)

RATE = 15.0  # [Hz]
MIN_DEPTH, MAX_DEPTH = 0.3, 20.0  # [m]
STATE_SIZE = 9


def encode_color(color: Any) -> Any:
    """Encodes RGB (..., H, W, 3), floats of 0 to 255, as (..., 3, H, W), -1 to 1."""
    return array_namespace(color).moveaxis(color, -1, -3) * (1.0 / 127.5) - 1.0


def encode_depth(depth: Any) -> Any:
    """Encodes planar depth (..., H, W) [m] as gray images (..., 3, H, W) by its logarithm, -1 to 1.

    Equal ratios of depths give equal contrasts; near is bright.
    """
    xp = array_namespace(depth)
    near, far = math.log(MIN_DEPTH), math.log(MAX_DEPTH)
    z = xp.log(depth.clip(MIN_DEPTH, MAX_DEPTH))
    encoded = (far + near) / (far - near) - 2.0 / (far - near) * z
    *batch, height, width = depth.shape
    return xp.broadcast_to(encoded[..., None, :, :], (*batch, 3, height, width))


def encode_state(R_WB: Any, v_B: Any, goal_B: Any, reach: float) -> Any:
    """Encodes states (N, 9): velocity, direction to the goal and the unit vector upwards, all in B.

    Args:
        R_WB: attitudes (N, 3, 3).
        v_B: velocities (N, 3) [m/s].
        goal_B: vectors to the goal (N, 3) [m].
        reach: distance [m] beyond which directions have length 1; nearer they are proportional.
    """
    direction = goal_B / lengths(goal_B).clip(min=reach)
    return array_namespace(v_B).concatenate([v_B, direction, R_WB[:, 2]], 1)


# MobileNetV2 of width 1, after "MobileNetV2: Inverted Residuals and Linear Bottlenecks" (M. Sandler
# et al., CVPR 2018). Layers have torchvision's names; batch norms are folded into the convolutions,
# which leaves a bias of each.

BLOCKS = 19
"""Number of modules of the encoder; the first and the last are a single convolution."""

CHANNELS = 1280
"""Number of output channels, each of 1/32 of the image's height and width, rounded up."""

_STAGES = (
    (1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2),
    (6, 320, 1, 1),
)  # fmt: skip
"""Expansion, channels, blocks and first stride of each stage between the first and last."""


@dataclass(frozen=True)
class Convolution:
    """A convolution with bias."""

    weight: str  # name of its weights (outputs, inputs / groups, kernel, kernel)
    bias: str  # name of its biases (outputs,)
    inputs: int
    outputs: int
    kernel: int = 1
    stride: int = 1
    groups: int = 1
    rectified: bool = True  # output limited to 0 to 6

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Returns the shapes of its arrays of weights by name."""
        shape = (self.outputs, self.inputs // self.groups, self.kernel, self.kernel)
        return {self.weight: shape, self.bias: (self.outputs,)}


def mobilenet_blocks() -> list[list[Convolution]]:
    """Lists the convolutions of each of the `BLOCKS` modules; see `adds_input` for skips."""

    def convolution(prefix: str, *numbers) -> Convolution:
        return Convolution(f"{prefix}.0.weight", f"{prefix}.1.bias", *numbers)

    blocks = [[convolution("features.0", 3, 32, 3, 2)]]
    inputs = 32
    for expansion, outputs, count, first_stride in _STAGES:
        for i in range(count):
            name, hidden = f"features.{len(blocks)}.conv", expansion * inputs
            stride = first_stride if i == 0 else 1
            block = [convolution(f"{name}.0", inputs, hidden)] if expansion > 1 else []
            n = len(block)
            block.append(convolution(f"{name}.{n}", hidden, hidden, 3, stride, hidden))
            weight, bias = f"{name}.{n + 1}.weight", f"{name}.{n + 2}.bias"
            block.append(Convolution(weight, bias, hidden, outputs, rectified=False))
            blocks.append(block)
            inputs = outputs
    return [*blocks, [convolution("features.18", inputs, CHANNELS)]]


def adds_input(block: list[Convolution]) -> bool:
    """Tells whether a module adds its input to its output."""
    same = block[0].inputs == block[-1].outputs and all(c.stride == 1 for c in block)
    return len(block) > 1 and same


def mobilenet_shapes() -> dict[str, tuple[int, ...]]:
    """Returns the shapes of all arrays of weights by name."""
    return {k: v for block in mobilenet_blocks() for c in block for k, v in c.shapes().items()}


def _mobilenet(height: int, width: int, weights: Mapping[str, np.ndarray]) -> cv2.dnn.Net:
    """Builds the encoder for images of a size [px] from float32 weights by name."""
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
    return cv2.dnn.readNetFromONNX(model.serialize(features))


HYPOTHESES = 3
PIXELS = {"rgb": "color", "depth": "depth"}
"""Field of a corpus's samples that each kind of observation sees."""
WAYPOINT_SCALE = 2.0  # [m] deviation that an output of 1 means
FADING_DISTANCE = 1.0  # [m] from the goal


@dataclass(frozen=True)
class StudentSpec:
    """Architecture of the network.

    Waypoints are deviations from the obstacle-free reference trajectory.
    """

    weights_type: ClassVar[type] = np.float16
    """Type of weights in files; it changes waypoints by less than a millimeter."""

    observation: str = "depth"
    # Size [px] and horizontal field of view [deg] of the camera.
    width: int = 160
    height: int = 120
    fov_x: float = 90.0
    # Number of features of each cell of the encoder's output. Cells are not averaged, because
    # averages do not tell where things are.
    cell_features: int = 64
    state_features: int = 64
    # Width of the hidden layer of the head.
    head_features: int = 256
    # [m/s] of the expert.
    nominal_speed: float = 2.0
    # Version of the reference trajectory. Files without it were trained with the first.
    way_version: int = 1

    def __post_init__(self) -> None:
        """Raises ValueError for fields that no network can be made with."""
        words = ", ".join(PIXELS)
        require(self.observation in PIXELS, "observation", f"one of {words}", self.observation)
        require(self.way_version == 2, "way_version", "2", self.way_version)
        for name in ("width", "height", "cell_features", "state_features", "head_features"):
            value = getattr(self, name)
            require(isinstance(value, int) and 1 <= value <= 4096, name, "in [1, 4096]", value)
        for name, lower, upper in (("fov_x", 1.0, 179.0), ("nominal_speed", 0.1, 20.0)):
            value = getattr(self, name)
            valid = isinstance(value, int | float) and lower <= value <= upper
            require(valid, name, f"in [{lower:g}, {upper:g}]", value)

    @property
    def pixels(self) -> str:
        """See `PIXELS`."""
        return PIXELS[self.observation]

    @property
    def reach(self) -> float:
        """Distance [m] to the goal within which its distance is observed."""
        return HORIZON * self.nominal_speed

    @property
    def image_features(self) -> int:
        """Number of features of an image."""
        return self.cell_features * -(-self.height // 32) * -(-self.width // 32)

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Returns the shapes of all arrays of weights by name."""
        shapes = mobilenet_shapes()
        for name, inputs, outputs in (
            ("cell_layer", CHANNELS, self.cell_features),
            ("state_layer", STATE_SIZE, self.state_features),
            ("state_layer_2", self.state_features, self.state_features),
            ("hidden_layer", self.image_features + self.state_features, self.head_features),
            ("head", self.head_features, HYPOTHESES * (3 * NUM_WAYPOINTS + 1)),
        ):
            shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (outputs, inputs), (outputs,)
        return shapes


def deviations(output: Any, goal_B: Any) -> Any:
    """Computes deviations (..., M, T, 3) [m] from the reference trajectory.

    Near the goal the reference is slow, and a constant deviation would make the vehicle hover
    beside it. So deviations fade with the squared distance there.

    Args:
        output: (..., M, T, 3), of the network.
        goal_B: (..., 3) [m], vector to the goal.
    """
    fading = ((goal_B * goal_B).sum(-1) / FADING_DISTANCE**2).clip(max=1.0)
    return WAYPOINT_SCALE * fading[..., None, None, None] * output


class StudentNetwork:
    """The network with its weights, in OpenCV and numpy.

    At a speed other than its expert's, the reference trajectory is flown at that speed, deviations
    are scaled by the ratio of the two (`pace`), and the observed velocity by its inverse.

    Args:
        spec: architecture.
        weights: arrays by the names of `StudentSpec.weight_shapes`.
        speed: nominal speed [m/s]; the expert's if None.

    Raises:
        ValueError: if weights are missing, of another shape or not finite.
    """

    def __init__(
        self, spec: StudentSpec, weights: dict[str, np.ndarray], speed: float | None = None
    ) -> None:
        self.spec = spec
        self.speed = spec.nominal_speed if speed is None else speed
        self.pace = self.speed / spec.nominal_speed
        self.reach = HORIZON * self.speed  # [m], see `StudentSpec.reach`
        self._weights = check_weights(weights, spec.weight_shapes())
        self._encoder = _mobilenet(spec.height, spec.width, self._weights)

    def __call__(self, image: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Computes waypoints (3, 10, 3) [m] in the body frame and costs (3,).

        Args:
            image: (3, height, width), see `encode_color` and `encode_depth`.
            state: (9,), see `encode_state`, with the velocity divided by `pace`.

        Raises:
            ValueError: if the image has another shape.
        """
        spec = self.spec
        shape = 3, spec.height, spec.width
        remedy = f"give it a camera of {spec.width}x{spec.height}"
        require(np.shape(image) == shape, "shape of the image", str(shape), np.shape(image), remedy)
        self._encoder.setInput(np.ascontiguousarray(image[None], np.float32))
        features = self._encoder.forward().reshape(CHANNELS, -1)
        cells = self._relu("cell_layer", features.T)
        y = self._relu("state_layer_2", self._relu("state_layer", np.asarray(state, np.float32)))
        hidden = self._relu("hidden_layer", np.concatenate([cells.ravel(), y]))
        output = self._linear("head", hidden).reshape(HYPOTHESES, -1)
        v_B, direction, up_B = np.reshape(state, (3, 3))
        goal_B = self.reach * direction
        reference = unobstructed_way(self.pace * v_B, goal_B, up_B, self.speed, BASIS)
        waypoints = output[:, :-1].reshape(HYPOTHESES, NUM_WAYPOINTS, 3)
        return reference + self.pace * deviations(waypoints, goal_B), output[:, -1]

    def _linear(self, name: str, x: np.ndarray) -> np.ndarray:
        return x @ self._weights[f"{name}.weight"].T + self._weights[f"{name}.bias"]

    def _relu(self, name: str, x: np.ndarray) -> np.ndarray:
        return np.maximum(self._linear(name, x), np.float32(0.0))


def load_network(path: str, observation: str, speed: float | None = None) -> StudentNetwork:
    """Loads the network from a file, see `PolicyCheckpoint.load`, for a nominal speed [m/s]."""
    checkpoint = PolicyCheckpoint.load(path, f"student_{observation}", StudentSpec)
    return checkpoint.build(partial(StudentNetwork, speed=speed))


def plan(
    network: StudentNetwork,
    time: float,
    image: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
) -> Hypotheses:
    """Computes the hypotheses of one observation.

    Args:
        time: [s].
        image: RGB (H, W, 3) uint8 or planar depth (H, W) [m], by `network.spec.observation`.
        X_WB, v_WB: pose and velocity [m/s].
        p_WG: goal [m].

    Raises:
        ValueError: for an image of another size.
    """
    R_WB = X_WB.rotation().matrix()
    v_B, goal_B = R_WB.T @ v_WB / network.pace, R_WB.T @ (p_WG - X_WB.translation())
    state = encode_state(R_WB[None], v_B[None], goal_B[None], network.reach)[0]
    encode = encode_color if network.spec.pixels == "color" else encode_depth
    waypoints_B, costs = network(encode(image.astype(np.float32)), state)
    return Hypotheses(time, X_WB, waypoints_B.astype(float), costs.astype(float))


@dataclass
class StudentConfig(Config):
    """Weights, speed and camera of a student."""

    observation: ClassVar[str]
    """One of `PIXELS`."""
    rate: ClassVar[float] = RATE

    # [m/s] Nominal speed; the model card of the weights states the expert's.
    speed: float = bounded(2.0, "[0.1, 10] m/s")
    # File of weights from `splatpilot train`; the shipped ones if empty.
    weights: str = ""
    # Camera with the size and field of view of the training.
    camera: OnboardCamera = field(default_factory=lambda: OnboardCamera(width=160, height=120))


@dataclass
class StudentRgbConfig(StudentConfig):
    """A student that sees RGB."""

    observation = "rgb"


@dataclass
class StudentDepthConfig(StudentConfig):
    """A student that sees depth."""

    observation = "depth"


class Student(LeafSystem):
    """Plans three trajectories with costs from an RGB or depth image, by `plan` at 15 Hz.

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
      planning; a discrete state, NaN before the first update.

    Raises:
        ValueError, FileNotFoundError: from the constructor on a config out of range, on weights
            that are missing, damaged, or of another policy, version or architecture, and for a
            camera other than that of the training.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    hypotheses_output_port = output_port("hypotheses")

    def __init__(self, config: StudentConfig) -> None:
        super().__init__()
        config.validate()
        weights = config.weights or str(shipped_weights(f"student_{config.observation}"))
        self._network = load_network(weights, config.observation, config.speed)
        for name in ("width", "height", "fov_x"):
            given, trained = getattr(config.camera, name), getattr(self._network.spec, name)
            what = f"camera.{name} of the student"
            remedy = f"its weights were trained with {trained}"
            require(given == trained, what, trained, given, remedy)
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        rgb = config.observation == "rgb"
        name, image = ("color_image", ImageRgba8U) if rgb else ("depth_image_32f", ImageDepth32F)
        size = config.camera.width, config.camera.height
        self._image_port = self.DeclareAbstractInputPort(name, Value(image(*size)))
        self.DeclareStateOutputPort("hypotheses", self.DeclareDiscreteState(no_plan(HYPOTHESES)))
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = np.asarray(self._state_port.Eval(context))
        pixels = np.asarray(cast(Any, self._image_port.Eval(context)).data)  # (H, W, 4 or 1)
        hypotheses = plan(
            self._network,
            context.get_time(),
            pixels[..., :3] if self._network.spec.observation == "rgb" else pixels[..., 0],
            pose_from_state(state),
            QuadrotorState.of(state).v_WB,
            np.asarray(self._goal_port.Eval(context)),
        )
        discrete_state.set_value(hypotheses.to_vector())
