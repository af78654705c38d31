"""DiffAero in colours: it judges the depths that it flies by from a single image."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, cast

import cv2
import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from splatpilot.systems.common.drake import input_port, output_port
from splatpilot.systems.policies.checkpoint import OnnxModel, PolicyCheckpoint, check_weights
from splatpilot.systems.policies.depth_policy_config import require_speed
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK, RATE, decide_by_grid
from splatpilot.systems.policies.observations import heading_frame
from splatpilot.systems.policies.recurrent_network import LEAK, NetworkSpec, RecurrentNetwork
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state

# Nearest depths in a coarse grid from one colour image: what the network is told, and its layers.
#
# Each pixel comes with its ray in the heading frame, so that the network knows where the horizon
# is, however the vehicle leans.


WIDTH, HEIGHT = 160, 90  # [px], of what is looked at
FOV_X = 90.0  # [deg]
CHANNELS = 6
"""Of what the network takes: red, green, blue, and a ray."""


@dataclass(frozen=True)
class MonocularSpec:
    """The architecture: residual blocks at a fifth and at a tenth of the image's size.

    A block adds to its input a convolution of 3x3, dilated, and one of 1x1.
    """

    fine_channels: int = 32
    fine_dilations: tuple[int, ...] = (1, 2)
    coarse_channels: int = 64
    coarse_dilations: tuple[int, ...] = (1, 2, 4, 1, 2, 4)

    def layers(self) -> "list[Layer]":
        """First to last."""
        fine, coarse = self.fine_channels, self.coarse_channels
        layers = [Layer("stem", CHANNELS, fine, 7, stride=5)]
        for i, dilation in enumerate(self.fine_dilations):
            layers += _block(f"fine.{i}", fine, dilation)
        layers.append(Layer("halving", fine, coarse, 3, stride=2))
        for i, dilation in enumerate(self.coarse_dilations):
            layers += _block(f"coarse.{i}", coarse, dilation)
        return [*layers, Layer("head", coarse, 2, 1, rectified=False)]

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """The name and shape of every array of weights."""
        shapes: dict[str, tuple[int, ...]] = {}
        for layer in self.layers():
            shape = (layer.outputs, layer.inputs, layer.kernel, layer.kernel)
            shapes[f"{layer.name}.weight"] = shape
            shapes[f"{layer.name}.bias"] = (layer.outputs,)
        return shapes


@dataclass(frozen=True)
class Layer:
    """A convolution with bias, padded by half its kernel times its dilation."""

    name: str
    inputs: int
    outputs: int
    kernel: int
    stride: int = 1
    dilation: int = 1
    rectified: bool = True
    """Whether a leaky rectifier follows."""
    adds_to_block: bool = False
    """Whether what the layer before the last one took is added."""


def _block(name: str, channels: int, dilation: int) -> list[Layer]:
    return [
        Layer(f"{name}.0", channels, channels, 3, dilation=dilation),
        Layer(f"{name}.1", channels, channels, 1, rectified=False, adds_to_block=True),
    ]


class MonocularDepth:
    """The network with its weights, run by OpenCV: the same bits on any number of its threads.

    Args:
        spec: the architecture.
        weights: arrays by the names of `MonocularSpec.weight_shapes`, single precision.
    """

    def __init__(self, spec: MonocularSpec, weights: Mapping[str, np.ndarray]) -> None:
        model, before = OnnxModel((CHANNELS, HEIGHT, WIDTH)), []
        for layer in spec.layers():
            before.append(model.output)
            weight, bias = weights[f"{layer.name}.weight"], weights[f"{layer.name}.bias"]
            model.convolution(weight, bias, stride=layer.stride, dilation=layer.dilation)
            if layer.rectified:
                model.leaky_relu(LEAK)
            if layer.adds_to_block:
                model.add(before[-2])
        self._net = cv2.dnn.readNetFromONNX(model.serialize((2, 9, 16)))

    def __call__(self, view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inverse depths (9, 16), as `inverse_depth` has them, and the logarithms of their expected
        absolute errors, of a view (6, 90, 160), see `encode_view`."""
        self._net.setInput(view[None])
        inverse, log_error = self._net.forward()[0]
        return inverse, log_error


def encode_view(color: np.ndarray, R_WB: np.ndarray) -> np.ndarray:
    """What the network takes (6, 90, 160): colours of -1 to 1, and the pixels' rays in the heading
    frame.

    Args:
        color: (H, 160, 3) uint8 of a camera of 90 degrees; its middle 90 rows are looked at.
        R_WB: (3, 3) attitude.

    Raises:
        ValueError: for an image of another width, or without 90 rows in its middle.
    """
    H, W = color.shape[:2]
    require_view(W, H)
    first = (H - HEIGHT) // 2
    view = np.empty((CHANNELS, HEIGHT, WIDTH), np.float32)
    view[:3] = color[first : first + HEIGHT].transpose(2, 0, 1) * np.float32(1.0 / 127.5)
    view[:3] -= np.float32(1.0)
    R_HB = (heading_frame(R_WB).T @ R_WB).astype(np.float32)
    view[3:] = (R_HB @ rays_B().reshape(-1, 3).T).reshape(3, HEIGHT, WIDTH)
    return view


def require_view(width: int, height: int) -> None:
    """Raises ValueError unless images of this size [px] have the pixels that are looked at."""
    if width != WIDTH or height < HEIGHT or height % 2:
        raise ValueError(
            f"the colour image has {width}x{height} pixels, but this policy looks at the middle "
            f"{WIDTH}x{HEIGHT}; give its camera a width of {WIDTH} and an even height of at least "
            f"{HEIGHT}"
        )


def rays_B() -> np.ndarray:
    """Unit vectors (90, 160, 3), float32, through the pixels in the body frame, of a camera that
    looks along body x."""
    focal = 0.5 * WIDTH / np.tan(np.deg2rad(0.5 * FOV_X))
    y = (0.5 * WIDTH - 0.5 - np.arange(WIDTH)) / focal
    z = (0.5 * HEIGHT - 0.5 - np.arange(HEIGHT)) / focal
    rays = np.ones((HEIGHT, WIDTH, 3))
    rays[..., 1], rays[..., 2] = y, z[:, None]
    return (rays / np.linalg.norm(rays, axis=2, keepdims=True)).astype(np.float32)


@dataclass(frozen=True)
class DiffAeroRgbSpec:
    """The architecture: what sees, and what decides."""

    monocular: MonocularSpec = field(default_factory=MonocularSpec)
    policy: NetworkSpec = DIFFAERO_NETWORK


DIFFAERO_RGB_NETWORK = DiffAeroRgbSpec()


class DiffAeroRgbNetwork:
    """Both networks with their weights, whose names begin with `monocular.` and `policy.`.

    Raises:
        ValueError: if an array is missing, of another shape or not finite.
    """

    def __init__(self, spec: DiffAeroRgbSpec, weights: dict[str, np.ndarray]) -> None:
        def part(name: str, shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
            checked = check_weights(weights, {f"{name}.{key}": shapes[key] for key in shapes})
            return {key.removeprefix(f"{name}."): value for key, value in checked.items()}

        self.monocular = MonocularDepth(
            spec.monocular, part("monocular", spec.monocular.weight_shapes())
        )
        self.policy = RecurrentNetwork(spec.policy, part("policy", spec.policy.weight_shapes()))


def load_network(path: str | None) -> DiffAeroRgbNetwork:
    """The networks from a file of weights; see `PolicyCheckpoint.load`."""
    checkpoint = PolicyCheckpoint.load(path, "diffaero_rgb", DIFFAERO_RGB_NETWORK)
    return checkpoint.build(DiffAeroRgbNetwork)


def decide(
    network: DiffAeroRgbNetwork,
    color: np.ndarray,
    X_WB: RigidTransform,
    v_WB: np.ndarray,
    p_WG: np.ndarray,
    speed: float,
    memory: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The acceleration a_WB (3,) [m/s^2] in W, gravity excluded, and the memory (H,) afterwards.

    Args:
        network: see `DiffAeroRgbNetwork`.
        color: (H, 160, 3) uint8, see `encode_view`.
        X_WB, v_WB: pose and velocity [m/s].
        p_WG: the goal [m].
        speed: wanted [m/s].
        memory: (H,), before.

    Raises:
        ValueError: for an image of another size.
    """
    grid, _ = network.monocular(encode_view(color, X_WB.rotation().matrix()))
    return decide_by_grid(network.policy, grid, X_WB, v_WB, p_WG, speed, memory)


@dataclass
class DiffAeroRgbConfig:
    """The policy's weights, and what it is asked for."""

    rate: ClassVar[float] = RATE

    # [m/s] Speed that it is asked to fly at; the model card of its weights says what they know.
    speed: float = 2.0
    # File of weights, as `splatpilot train` writes them; those that ship where left empty.
    weights: str = ""
    # What it sees through: 160 pixels of 90 degrees wide, level; the middle 90 rows are looked at.
    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(width=WIDTH, height=HEIGHT, fov_x=FOV_X)
    )

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        require_speed(self)
        self.camera.validate()
        require_view(self.camera.width, self.camera.height)
        if self.camera.fov_x != FOV_X:
            raise ValueError(
                f"camera.fov_x is {self.camera.fov_x} deg, but this policy judges depths through "
                f"{FOV_X:g}; set it to that"
            )


class DiffAeroRgb(LeafSystem):
    """Flies to the goal by a colour image and what it remembers.

    .. pydrake_system::

        name: DiffAeroRgb
        input_ports:
        - state
        - goal
        - color_image
        output_ports:
        - acceleration

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``color_image``: RGBA of the camera ``config.camera``.
    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded; zero before the first update.

    Updates at 15 Hz from time 0 by
    :func:`~splatpilot.systems.policies.diffaero_rgb.decide`. The discrete state holds the
    acceleration and the network's memory.

    Raises:
        ValueError, FileNotFoundError: from the constructor on a config out of range, and on weights
            that are missing, damaged, or of another policy, version or architecture.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    color_image_input_port = input_port("color_image")
    acceleration_output_port = output_port("acceleration")

    def __init__(self, config: DiffAeroRgbConfig | None = None) -> None:
        super().__init__()
        self._config = config = config or DiffAeroRgbConfig()
        config.validate()
        self._network = load_network(config.weights)
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        self._color_port = self.DeclareAbstractInputPort(
            "color_image", Value(ImageRgba8U(config.camera.width, config.camera.height))
        )
        self.DeclareStateOutputPort("acceleration", self.DeclareDiscreteState(3))
        self._memory = self.DeclareDiscreteState(self._network.policy.initial_hidden())
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = np.asarray(self._state_port.Eval(context))
        image = cast(ImageRgba8U, self._color_port.Eval(context))
        a_WB, memory = decide(
            self._network,
            np.asarray(image.data)[..., :3],
            pose_from_state(state),
            QuadrotorState.of(state).v_WB,
            np.asarray(self._goal_port.Eval(context)),
            self._config.speed,
            np.asarray(context.get_discrete_state(int(self._memory)).value()),
        )
        discrete_state.set_value(0, a_WB)
        discrete_state.set_value(int(self._memory), memory)
