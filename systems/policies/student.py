"""Student: plans three trajectories from one RGB or depth image, learned by imitation.

The network is MobileNetV2 for the image, layers for the state, and a head for all hypotheses. It
runs without torch: the encoder in OpenCV, the rest in numpy.
"""

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import numpy as np

from splatpilot.systems.common.validation import require
from splatpilot.systems.policies.base import LearnedPolicyConfig, Observation, Policy
from splatpilot.systems.policies.checkpoint import (
    PolicyCheckpoint,
    check_weights,
    linear,
    linear_shapes,
    require_shape,
)
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, Hypotheses, no_plan
from splatpilot.systems.policies.lattice import HORIZON, reference_trajectory
from splatpilot.systems.policies.networks import Convolution, convolution_shapes, opencv_net
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.state import array_namespace, lengths

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
    """Encodes states (N, 9): velocity [m/s], direction to the goal and the unit vector upwards, all
    (N, 3) in B. Directions have length 1 beyond `reach` [m]; nearer they are proportional."""
    direction = goal_B / lengths(goal_B).clip(min=reach)
    return array_namespace(v_B).concatenate([v_B, direction, R_WB[:, 2]], 1)


# MobileNetV2 of width 1, after "MobileNetV2: Inverted Residuals and Linear Bottlenecks" (M. Sandler
# et al., CVPR 2018). Layers have torchvision's names; batch norms are folded into the convolutions,
# which leaves a bias of each.

BLOCKS = 19  # modules of the encoder; the first and the last are a single convolution
CHANNELS = 1280  # of the output, each of 1/32 of the image's height and width, rounded up

_STAGES = (
    (1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2),
    (6, 320, 1, 1),
)  # fmt: skip
"""Expansion, channels, blocks and first stride of each stage between the first and last."""


def mobilenet_blocks() -> list[list[Convolution]]:
    """Lists the convolutions of each of the `BLOCKS` modules."""

    def convolution(prefix: str, *sizes: int) -> Convolution:
        return Convolution(f"{prefix}.0.weight", f"{prefix}.1.bias", *sizes, activation="relu6")

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
            skip = n + 2 if stride == 1 and inputs == outputs else 0
            block.append(Convolution(weight, bias, hidden, outputs, skip=skip))
            blocks.append(block)
            inputs = outputs
    return [*blocks, [convolution("features.18", inputs, CHANNELS)]]


def mobilenet_shapes() -> dict[str, tuple[int, ...]]:
    """Returns the shapes of all arrays of weights by name."""
    return convolution_shapes([layer for block in mobilenet_blocks() for layer in block])


HYPOTHESES = 3
PIXELS = {"rgb": "color", "depth": "depth"}
"""Field of a corpus's samples that each kind of observation sees."""
WAYPOINT_SCALE = 2.0  # [m] deviation for an output of 1
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
    # Number of features of each cell of the encoder's output.
    cell_features: int = 64
    state_features: int = 64
    # Width of the hidden layer of the head.
    head_features: int = 256
    # [m/s] of the expert.
    nominal_speed: float = 2.0
    # Version of the reference trajectory.
    way_version: int = 2

    def __post_init__(self) -> None:
        words = ", ".join(PIXELS)
        require(self.observation in PIXELS, "observation", f"one of {words}", self.observation)
        require(self.way_version == 2, "way_version", "2", self.way_version)
        require(self.nominal_speed > 0.0, "nominal_speed", "> 0", self.nominal_speed)

    @property
    def pixels(self) -> str:
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
        joined = self.image_features + self.state_features
        return mobilenet_shapes() | linear_shapes(
            ("cell_layer", CHANNELS, self.cell_features),
            ("state_layer", STATE_SIZE, self.state_features),
            ("state_layer_2", self.state_features, self.state_features),
            ("hidden_layer", joined, self.head_features),
            ("head", self.head_features, HYPOTHESES * (3 * NUM_WAYPOINTS + 1)),
        )


def deviations(output: Any, goal_B: Any) -> Any:
    """Computes deviations (..., M, T, 3) [m] from the reference trajectory.

    The network's output (..., M, T, 3) fades with the squared distance to the goal. A constant
    deviation would make the vehicle hover beside the goal.
    """
    fading = ((goal_B * goal_B).sum(-1) / FADING_DISTANCE**2).clip(max=1.0)
    return WAYPOINT_SCALE * fading[..., None, None, None] * output


class StudentNetwork:
    """The network with its weights, in OpenCV and numpy.

    At a speed other than its expert's, the reference trajectory has that speed, deviations are
    scaled by the ratio of the two (`pace`), and the observed velocity by its inverse.
    """

    def __init__(
        self, spec: StudentSpec, weights: dict[str, np.ndarray], speed: float | None = None
    ) -> None:
        self.spec = spec
        self.speed = spec.nominal_speed if speed is None else speed
        self.pace = self.speed / spec.nominal_speed
        self.reach = HORIZON * self.speed  # [m], see `StudentSpec.reach`
        self._weights = check_weights(weights, spec.weight_shapes())
        layers = [layer for block in mobilenet_blocks() for layer in block]
        self._encoder = opencv_net((3, spec.height, spec.width), layers, self._weights)

    def __call__(self, image: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Computes waypoints (3, 10, 3) [m] in the body frame and costs (3,) from an encoded image
        (3, height, width) and state (9,), with the velocity divided by `pace`."""
        spec = self.spec
        remedy = f"give it a camera of {spec.width}x{spec.height}"
        require_shape("image", image, (3, spec.height, spec.width), remedy)
        self._encoder.setInput(np.ascontiguousarray(image[None], np.float32))
        features = self._encoder.forward().reshape(CHANNELS, -1)
        cells = self._layer("cell_layer", features.T)
        y = self._layer("state_layer_2", self._layer("state_layer", np.asarray(state, np.float32)))
        hidden = self._layer("hidden_layer", np.concatenate([cells.ravel(), y]))
        output = linear(self._weights, "head", hidden).reshape(HYPOTHESES, -1)
        v_B, direction, up_B = np.reshape(state, (3, 3))
        goal_B = self.reach * direction
        reference = reference_trajectory(self.pace * v_B, goal_B, up_B, self.speed)
        waypoints = output[:, :-1].reshape(HYPOTHESES, NUM_WAYPOINTS, 3)
        return reference + self.pace * deviations(waypoints, goal_B), output[:, -1]

    def _layer(self, name: str, x: np.ndarray) -> np.ndarray:
        return np.maximum(linear(self._weights, name, x), np.float32(0.0))


def load_checkpoint(path: str, observation: str) -> PolicyCheckpoint:
    """Reads a file of a student's weights; the shipped one if `path` is empty."""

    def spec(way_version: int = 1, **fields: Any) -> StudentSpec:  # Old files are without it.
        return StudentSpec(**fields, way_version=way_version)

    return PolicyCheckpoint.load(path, f"student_{observation}", spec)


def load_network(path: str, observation: str, speed: float | None = None) -> StudentNetwork:
    """Loads the network from a file for a nominal speed [m/s], see `load_checkpoint`."""
    return load_checkpoint(path, observation).build(partial(StudentNetwork, speed=speed))


def plan(network: StudentNetwork, observed: Observation) -> Hypotheses:
    """Computes the hypotheses from RGB (H, W, 3) uint8 or planar depth (H, W) [m], by
    `network.spec.observation`."""
    R_WB = observed.X_WB.rotation().matrix()
    v_B = R_WB.T @ observed.state.v_WB / network.pace
    goal_B = R_WB.T @ (observed.p_WG - observed.X_WB.translation())
    state = encode_state(R_WB[None], v_B[None], goal_B[None], network.reach)[0]
    encode = encode_color if network.spec.pixels == "color" else encode_depth
    waypoints_B, costs = network(encode(observed.image.astype(np.float32)), state)
    return Hypotheses(observed.time, observed.X_WB, waypoints_B.astype(float), costs.astype(float))


@dataclass
class StudentConfig(LearnedPolicyConfig):
    """Weights, speed and camera of a student, with the size and field of view of training."""

    rate = RATE
    observation: ClassVar[str]
    """One of `PIXELS`."""

    camera: OnboardCamera = field(default_factory=lambda: OnboardCamera(width=160, height=120))


@dataclass
class StudentRgbConfig(StudentConfig):
    """A student that sees RGB."""

    observation = "rgb"


@dataclass
class StudentDepthConfig(StudentConfig):
    """A student that sees depth."""

    observation = "depth"


class Student(Policy):
    """Plans three trajectories with costs from an RGB or depth image.

    .. pydrake_system::

        name: Student
        input_ports: [state, goal, color_image or depth_image_32f]
        output_ports: [hypotheses]

    - ``hypotheses`` (8 + 31 * 3): as `Hypotheses.to_vector`, in the body frame B at the time of
      planning; NaN before the first update.
    """

    def __init__(self, config: StudentConfig) -> None:
        rgb = config.observation == "rgb"
        super().__init__(config, "color_image" if rgb else "depth_image_32f")
        self._network = load_network(config.weights, config.observation, config.speed)
        for name in ("width", "height", "fov_x"):
            given, trained = getattr(config.camera, name), getattr(self._network.spec, name)
            remedy = f"its weights were trained with {trained}"
            require(given == trained, f"camera.{name} of the student", trained, given, remedy)
        self.declare_state(no_plan(HYPOTHESES), "hypotheses")

    def decide(self, observed: Observation, *state: np.ndarray) -> list[np.ndarray]:
        return [plan(self._network, observed).to_vector()]
