"""AgileAutonomy: three trajectories from a depth image, imitated from a sampling expert."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatpilot.systems.policies.base import (
    LearnedPolicyConfig,
    Observation,
    Policy,
    pool_depth,
    target_velocity,
)
from splatpilot.systems.policies.checkpoint import (
    PolicyCheckpoint,
    check_weights,
    linear,
    linear_shapes,
    require_shape,
)
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, Hypotheses, no_plan
from splatpilot.systems.policies.networks import (
    DepthEncoder,
    DepthLayer,
    DepthSpec,
    convolution_shapes,
    leaky_relu,
)
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.state import array_namespace

RATE = 15.0  # [Hz]
CAMERA_SIZE = 128, 96  # [px] width and height before pooling
FOV_X = 90.0  # [deg]
MIN_DEPTH, MAX_DEPTH = 0.3, 20.0  # [m]
MODES = 3
STATE_SIZE = 18
WAYPOINT_SCALE = 2.0  # [m] per unit of the network's output
PROGRESS = 0.1
"""[1/m] Reward for progress; by collision costs alone the cheapest trajectory is often to stay."""

NEAR_TIE = 0.02
"""Difference of costs below which the hypothesis that continues the last plan is preferred."""
IMAGE_SIZE = 24, 32  # [px] height and width


@dataclass
class AgileAutonomyConfig(LearnedPolicyConfig):
    """Weights, speed and camera, whose pixels are pooled to 32x24."""

    rate = RATE
    image_size = IMAGE_SIZE

    camera: OnboardCamera = field(
        default_factory=lambda: OnboardCamera(
            width=CAMERA_SIZE[0], height=CAMERA_SIZE[1], fov_x=FOV_X, max_depth=MAX_DEPTH
        )
    )


@dataclass(frozen=True)
class TrajectoryNetworkSpec(DepthSpec):
    """Architecture: convolutions of the image and layers of the state, joined; one layer to the
    features of each mode; and one head for all modes."""

    image_height: int = 24
    image_width: int = 32
    convolutions: tuple[DepthLayer, ...] = (
        (16, 5, 2, 2),
        (32, 3, 2, 1),
        (64, 3, 2, 1),
        (32, 3, 1, 1),
    )
    image_features: int = 128
    state_features: int = 64
    mode_features: int = 64
    head_features: int = 128

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Returns the shapes of all arrays of weights by name."""
        joined = self.image_features + self.state_features
        return convolution_shapes(self.image_layers()) | linear_shapes(
            ("image_layer", self.image_outputs(), self.image_features),
            ("state_layer", STATE_SIZE, self.state_features),
            ("state_layer_2", self.state_features, self.state_features),
            ("modes", joined, MODES * self.mode_features),
            ("head", self.mode_features, self.head_features),
            ("output", self.head_features, 3 * NUM_WAYPOINTS + 1),
        )


AGILE_NETWORK = TrajectoryNetworkSpec()


class TrajectoryNetwork:
    """The network with its weights, by the names of `weight_shapes`, in numpy."""

    def __init__(self, spec: TrajectoryNetworkSpec, weights: dict[str, np.ndarray]) -> None:
        self.spec = spec
        self._weights = check_weights(weights, spec.weight_shapes())
        self._encoder = DepthEncoder(spec, self._weights)

    def __call__(self, image: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Computes waypoints (3, 10, 3) [m] in the body frame and costs (3,) from encoded depth
        (24, 32) and `state_observation` (18,)."""
        require_shape("state", state, (STATE_SIZE,))
        x = self._layer("image_layer", self._encoder(image))
        y = self._layer("state_layer_2", self._layer("state_layer", np.asarray(state, np.float32)))
        modes = self._layer("modes", np.concatenate([x, y]))
        output = linear(self._weights, "output", self._layer("head", modes.reshape(MODES, -1)))
        waypoints = WAYPOINT_SCALE * output[:, :-1].reshape(MODES, NUM_WAYPOINTS, 3)
        return waypoints, output[:, -1]

    def _layer(self, name: str, x: np.ndarray) -> np.ndarray:
        return leaky_relu(linear(self._weights, name, x))


def state_observation(R_WB: Any, v_WB: Any, w_WB_B: Any, v_target: Any) -> Any:
    """Returns (..., 18): attitude R_WB (..., 3, 3) row by row, then in the body frame velocity
    [m/s], rates [rad/s] and target velocity [m/s]. Arrays are numpy or torch."""
    xp = array_namespace(v_WB)
    rows = xp.stack([v_WB, v_target], -2) @ R_WB
    attitude = R_WB.reshape(*R_WB.shape[:-2], 9)
    return xp.concatenate([attitude, rows[..., 0, :], w_WB_B, rows[..., 1, :]], -1)


def plan(
    network: TrajectoryNetwork, observed: Observation, speed: float, last: Hypotheses | None
) -> Hypotheses:
    """Computes the hypotheses from depth (H, W) and the nominal speed [m/s].

    A cost is the network's collision cost minus `PROGRESS` per meter toward the goal. Among near
    ties the hypothesis that continues the `last` plan gets the lowest cost.
    """
    image = 1.0 / np.clip(pool_depth(observed.image, *IMAGE_SIZE), MIN_DEPTH, MAX_DEPTH)
    p_WB, v_WB, _, w_WB_B = observed.state
    v_target = target_velocity(p_WB, observed.p_WG, speed)
    state = state_observation(observed.X_WB.rotation().matrix(), v_WB, w_WB_B, v_target)
    waypoints_B, costs = network(image, state)
    v_target_B = state[-3:]
    progress = waypoints_B[:, -1] @ v_target_B / max(float(np.linalg.norm(v_target_B)), 1e-6)
    costs = costs.astype(float) - PROGRESS * progress
    new = Hypotheses(observed.time, observed.X_WB, waypoints_B.astype(float), costs)
    return new if last is None else prefer_continuation(new, last)


def prefer_continuation(new: Hypotheses, last: Hypotheses) -> Hypotheses:
    """Lowers the cost of the near tie that is closest to the best of `last` below all others."""
    ties = np.flatnonzero(new.costs <= new.costs.min() + NEAR_TIE)
    if len(ties) < 2:
        return new
    expected = last.position_W(new.plan_time + 0.5, last.best)
    middle = new.waypoints_W[ties, NUM_WAYPOINTS // 2 - 1]
    costs = new.costs.copy()
    chosen = ties[np.argmin(np.linalg.norm(middle - expected, axis=1))]
    costs[chosen] = new.costs.min() - 1e-3
    return Hypotheses(new.plan_time, new.X_WB, new.waypoints_B, costs)


class AgileAutonomy(Policy):
    """Plans three trajectories with costs from a 32x24 depth image.

    .. pydrake_system::

        name: AgileAutonomy
        input_ports: [state, goal, depth_image_32f]
        output_ports: [hypotheses]

    - ``hypotheses`` (8 + 31 * 3): as `Hypotheses.to_vector`, in the body frame B at the time of
      planning; NaN before the first update.
    """

    def __init__(self, config: AgileAutonomyConfig | None = None) -> None:
        super().__init__(config or AgileAutonomyConfig(), "depth_image_32f")
        checkpoint = PolicyCheckpoint.load(self.config.weights, "agile_autonomy", AGILE_NETWORK)
        self._network = checkpoint.build(TrajectoryNetwork)
        self.declare_state(no_plan(MODES), "hypotheses")

    def decide(self, observed: Observation, *state: np.ndarray) -> list[np.ndarray]:
        last = Hypotheses.from_vector(state[0], MODES)
        return [plan(self._network, observed, self.config.speed, last).to_vector()]
