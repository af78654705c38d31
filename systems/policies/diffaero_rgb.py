"""DiffAero that predicts its depth grid from a single RGB image.

A network predicts the grid, and DiffAero's network decides. By `DiffAeroRgbConfig` they are trained
apart; by `DistilledRgbConfig` as a whole, in flight, and features of the image reach the decisions
beside the grid.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from splatpilot.systems.common.validation import require, require_field
from splatpilot.systems.policies.base import LearnedPolicyConfig, Observation, Policy, heading_frame
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint, check_weights
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK, RATE, compute_command
from splatpilot.systems.policies.networks import (
    Convolution,
    NetworkSpec,
    RecurrentNetwork,
    convolution_shapes,
    leaky_relu,
    opencv_net,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

WIDTH, HEIGHT = 160, 90  # [px] of the view, the middle of the image
FOV_X = 90.0  # [deg]
CHANNELS = 6  # red, green, blue, and a ray in the heading frame, which shows the horizon


@dataclass
class DiffAeroRgbConfig(LearnedPolicyConfig):
    """Weights, speed and a camera of 160 pixels and 90 degrees; its middle 90 rows are used."""

    rate = RATE
    policy: ClassVar[str] = "diffaero_rgb"
    """Name of the policy that the weights are of."""

    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(width=WIDTH, height=HEIGHT, fov_x=FOV_X)
    )

    def check(self) -> None:
        require_view(self.camera)


@dataclass
class DistilledRgbConfig(DiffAeroRgbConfig):
    """Weights, speed and a camera as of `DiffAeroRgbConfig`."""

    policy = "distilled_rgb"


@dataclass(frozen=True)
class MonocularSpec:
    """Architecture: residual blocks at a fifth and at a tenth of the image's size.

    A block adds to its input a dilated convolution of 3x3, followed by one of 1x1.
    """

    features = 0  # channels beside the grid

    fine_channels: int = 32
    fine_dilations: tuple[int, ...] = (1, 2)
    coarse_channels: int = 64
    coarse_dilations: tuple[int, ...] = (1, 2, 4, 1, 2, 4)

    def layers(self) -> list[Convolution]:
        """Lists the convolutions, first to last."""
        fine, coarse = self.fine_channels, self.coarse_channels
        layers = [_convolution("stem", CHANNELS, fine, 7, stride=5)]
        for i, dilation in enumerate(self.fine_dilations):
            layers += _block(f"fine.{i}", fine, dilation)
        layers.append(_convolution("halving", fine, coarse, 3, stride=2))
        for i, dilation in enumerate(self.coarse_dilations):
            layers += _block(f"coarse.{i}", coarse, dilation)
        return [*layers, _convolution("head", coarse, 2 + self.features, 1, activation="")]

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Returns the shapes of all arrays of weights by name."""
        return convolution_shapes(self.layers())


def _convolution(name: str, *sizes: int, activation="leaky_relu", **options: int) -> Convolution:
    weight, bias = f"{name}.weight", f"{name}.bias"
    return Convolution(weight, bias, *sizes, activation=activation, **options)


def _block(name: str, channels: int, dilation: int) -> list[Convolution]:
    return [
        _convolution(f"{name}.0", channels, channels, 3, dilation=dilation),
        _convolution(f"{name}.1", channels, channels, 1, activation="", skip=2),
    ]


class MonocularDepth:
    """The network with its weights, by the names of `weight_shapes`, in OpenCV."""

    def __init__(self, spec: MonocularSpec, weights: Mapping[str, np.ndarray]) -> None:
        self._net = opencv_net((CHANNELS, HEIGHT, WIDTH), spec.layers(), weights)

    def __call__(self, view: np.ndarray) -> np.ndarray:
        """Predicts (2 + F, 9, 16) from a view (6, 90, 160), see `encode_view`: inverse depths, the
        logarithms of their expected absolute errors, and features."""
        self._net.setInput(view[None])
        return self._net.forward()[0]


@dataclass(frozen=True)
class DiffAeroRgbSpec:
    """Architecture of both networks."""

    monocular: MonocularSpec = field(default_factory=MonocularSpec)
    policy: NetworkSpec = DIFFAERO_NETWORK


DIFFAERO_RGB_NETWORK = DiffAeroRgbSpec()


@dataclass(frozen=True)
class FeatureSpec(MonocularSpec):
    """A network with features beside the grid."""

    features: int = 8


@dataclass(frozen=True)
class DistilledPolicySpec(NetworkSpec):
    """A network by the grid and features."""

    image_channels: int = 1 + FeatureSpec.features


@dataclass(frozen=True)
class DistilledRgbSpec(DiffAeroRgbSpec):
    """Architecture of both networks with features between them."""

    monocular: FeatureSpec = field(default_factory=FeatureSpec)
    policy: DistilledPolicySpec = DistilledPolicySpec(**vars(DIFFAERO_NETWORK))


DISTILLED_RGB_NETWORK = DistilledRgbSpec()


class DiffAeroRgbNetwork:
    """Both networks with their weights, whose names begin with `monocular.` and `policy.`."""

    def __init__(self, spec: DiffAeroRgbSpec, weights: dict[str, np.ndarray]) -> None:
        def part(name: str, shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
            checked = check_weights(weights, {f"{name}.{key}": shapes[key] for key in shapes})
            return {key.removeprefix(f"{name}."): value for key, value in checked.items()}

        monocular = part("monocular", spec.monocular.weight_shapes())
        self.monocular = MonocularDepth(spec.monocular, monocular)
        self.policy = RecurrentNetwork(spec.policy, part("policy", spec.policy.weight_shapes()))

    def see(self, color: np.ndarray, R_WB: np.ndarray) -> np.ndarray:
        """Computes the image (9, 16) or (1 + F, 9, 16) for the policy, see `encode_view`."""
        inverse, _, *features = self.monocular(encode_view(color, R_WB))
        return np.stack([inverse, *leaky_relu(np.array(features))]) if features else inverse


_NETWORKS = {"diffaero_rgb": DIFFAERO_RGB_NETWORK, "distilled_rgb": DISTILLED_RGB_NETWORK}


def load_network(path: str | None, policy: str = "diffaero_rgb") -> DiffAeroRgbNetwork:
    """Loads the networks of a policy from a file of weights, see `PolicyCheckpoint.load`."""
    return PolicyCheckpoint.load(path, policy, _NETWORKS[policy]).build(DiffAeroRgbNetwork)


def encode_view(color: np.ndarray, R_WB: np.ndarray) -> np.ndarray:
    """Returns the network's input (6, 90, 160): RGB in [-1, 1] of images (H, 160, 3) uint8, and
    rays in the heading frame at the attitude R_WB (3, 3)."""
    H, W = color.shape[:2]
    _require_size(W, H)
    first = (H - HEIGHT) // 2
    view = np.empty((CHANNELS, HEIGHT, WIDTH), np.float32)
    view[:3] = color[first : first + HEIGHT].transpose(2, 0, 1) * np.float32(1.0 / 127.5)
    view[:3] -= np.float32(1.0)
    R_WH = heading_frame(np.arctan2(R_WB[1, 0], R_WB[0, 0]))
    R_HB = (R_WH.T @ R_WB).astype(np.float32)
    view[3:] = (R_HB @ rays_B().reshape(-1, 3).T).reshape(3, HEIGHT, WIDTH)
    return view


def require_view(camera: OnboardCamera) -> None:
    """Checks that images of a camera contain the view of `rays_B`."""
    _require_size(camera.width, camera.height)
    require_field(camera, "fov_x", camera.fov_x == FOV_X, f"{FOV_X:g} deg")
    for name in ("fov_y", "distortion"):
        require_field(camera, name, getattr(camera, name) is None, "left out")
    ahead = camera.mount().rotation().IsNearlyEqualTo(OnboardCamera().mount().rotation(), 1e-6)
    require_field(camera, "X_BC", ahead, "that of a camera along body x")


def _require_size(width: int, height: int) -> None:
    valid = width == WIDTH and height >= HEIGHT and height % 2 == 0
    condition = f"{WIDTH} pixels wide, with an even height of at least {HEIGHT}"
    require(valid, "the color image", condition, f"{width}x{height}")


def rays_B() -> np.ndarray:
    """Returns unit vectors (90, 160, 3), float32, through the pixels of a camera along body x."""
    focal = 0.5 * WIDTH / np.tan(np.deg2rad(0.5 * FOV_X))
    y = (0.5 * WIDTH - 0.5 - np.arange(WIDTH)) / focal
    z = (0.5 * HEIGHT - 0.5 - np.arange(HEIGHT)) / focal
    rays = np.ones((HEIGHT, WIDTH, 3))
    rays[..., 1], rays[..., 2] = y, z[:, None]
    return (rays / np.linalg.norm(rays, axis=2, keepdims=True)).astype(np.float32)


class DiffAeroRgb(Policy):
    """Flies to the goal by an RGB image and a hidden state.

    .. pydrake_system::

        name: DiffAeroRgb
        input_ports: [state, goal, color_image]
        output_ports: [acceleration]

    - ``acceleration`` (3): a_WB [m/s^2], W frame, gravity excluded.
    """

    def __init__(self, config: DiffAeroRgbConfig | None = None) -> None:
        super().__init__(config or DiffAeroRgbConfig(), "color_image")
        self._network = load_network(self.config.weights, self.config.policy)
        self.declare_state(np.zeros(3), "acceleration")
        self.declare_state(self._network.policy.initial_hidden())

    def decide(self, observed: Observation, *state: np.ndarray) -> tuple[np.ndarray, ...]:
        image = self._network.see(observed.image, observed.X_WB.rotation().matrix())
        return compute_command(self._network.policy, image, observed, self.config.speed, state[1])
