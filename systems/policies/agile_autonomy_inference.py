"""What Agile Autonomy's policy sees, what network it has and what its output means."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.policies.checkpoint import PolicyCheckpoint, check_weights
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, Hypotheses
from splatpilot.systems.policies.observations import pool_depth, target_velocity
from splatpilot.systems.policies.recurrent_network import (
    Convolutions,
    Layer,
    convolution_shapes,
    layer_sizes,
    leaky_relu,
)
from splatpilot.systems.vehicle.state import QuadrotorState

RATE = 15.0  # [Hz]
IMAGE_SIZE = 128, 96  # [px] width and height before pooling
FOV_X = 90.0  # [deg]
NEAREST, FARTHEST = 0.3, 20.0  # [m] range of depth
MODES = 3
STATE_SIZE = 18
WAYPOINT_SCALE = 2.0  # [m] that a waypoint of 1 at the network's output means
PROGRESS = 0.1
"""[1/m], what each metre towards the goal takes off a cost: by collisions alone the cheapest way is
often to stay."""

NEAR_TIE = 0.02
"""[-], a hypothesis of a cost up to this much above the least is followed instead, if it continues
the last."""


@dataclass(frozen=True)
class TrajectoryNetworkSpec:
    """The architecture: convolutions of the image and layers of the state, joined; one layer to
    the features of each mode; and one head for all modes."""

    image_height: int = 24
    image_width: int = 32
    convolutions: tuple[Layer, ...] = ((16, 5, 2, 2), (32, 3, 2, 1), (64, 3, 2, 1), (32, 3, 1, 1))
    image_features: int = 128
    state_features: int = 64
    mode_features: int = 64
    head_features: int = 128

    def flat_features(self) -> int:
        """Numbers after the last convolution."""
        image = (1, self.image_height, self.image_width)
        return int(np.prod(layer_sizes(image, self.convolutions)[-1]))

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """The name and shape of every array of weights."""
        shapes = convolution_shapes(self.convolutions)
        joined = self.image_features + self.state_features
        for name, inputs, outputs in (
            ("image_layer", self.flat_features(), self.image_features),
            ("state_layer", STATE_SIZE, self.state_features),
            ("state_layer_2", self.state_features, self.state_features),
            ("modes", joined, MODES * self.mode_features),
            ("head", self.mode_features, self.head_features),
            ("output", self.head_features, 3 * NUM_WAYPOINTS + 1),
        ):
            shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (outputs, inputs), (outputs,)
        return shapes


AGILE_NETWORK = TrajectoryNetworkSpec()


class TrajectoryNetwork:
    """The network with its weights, in numpy.

    Raises:
        ValueError: if weights are missing, of another shape or not finite.
    """

    def __init__(self, spec: TrajectoryNetworkSpec, weights: dict[str, np.ndarray]) -> None:
        self.spec = spec
        self._weights = check_weights(weights, spec.weight_shapes())
        image = (1, spec.image_height, spec.image_width)
        self._convolutions = Convolutions(image, spec.convolutions, self._weights)

    def __call__(self, image: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Waypoints (3, 10, 3) [m] in the body frame and costs (3,).

        Args:
            image: (24, 32), encoded depth.
            state: (18,).

        Raises:
            ValueError: if an argument has the wrong shape.
        """
        spec = self.spec
        for name, array, shape in (
            ("image", image, (spec.image_height, spec.image_width)),
            ("state", state, (STATE_SIZE,)),
        ):
            if np.shape(array) != shape:
                raise ValueError(
                    f"the policy's {name} has shape {np.shape(array)}, but its network takes "
                    f"{shape}"
                )
        x = leaky_relu(self._linear("image_layer", self._convolutions(image)))
        y = leaky_relu(self._linear("state_layer", np.asarray(state, np.float32)))
        y = leaky_relu(self._linear("state_layer_2", y))
        modes = leaky_relu(self._linear("modes", np.concatenate([x, y])))
        hidden = leaky_relu(self._linear("head", modes.reshape(MODES, -1)))
        output = self._linear("output", hidden)
        waypoints = WAYPOINT_SCALE * output[:, :-1].reshape(MODES, NUM_WAYPOINTS, 3)
        return waypoints, output[:, -1]

    def _linear(self, name: str, x: np.ndarray) -> np.ndarray:
        return x @ self._weights[f"{name}.weight"].T + self._weights[f"{name}.bias"]


def load_network(path: str | None) -> TrajectoryNetwork:
    """The network from a file of weights; see `PolicyCheckpoint.load`."""
    return PolicyCheckpoint.load(path, "agile_autonomy", AGILE_NETWORK).build(TrajectoryNetwork)


def state_observation(
    R_WB: np.ndarray, p_WB: np.ndarray, v_WB: np.ndarray, w_WB_B: np.ndarray, p_WG: np.ndarray,
    speed: float,
) -> np.ndarray:  # fmt: skip
    """(18,): the attitude row by row, velocity [m/s] and rates [rad/s] in the body frame, and the
    way to the goal there: its direction times the velocity wanted [m/s], less near the goal."""
    v_target = target_velocity(p_WB, p_WG, speed)
    return np.concatenate([R_WB.ravel(), v_WB @ R_WB, w_WB_B, v_target @ R_WB])


def plan(
    network: TrajectoryNetwork,
    time: float,
    depth: np.ndarray,
    X_WB: RigidTransform,
    state: np.ndarray,
    p_WG: np.ndarray,
    speed: float,
    last: Hypotheses | None,
) -> Hypotheses:
    """The hypotheses of one observation, the one to follow with the least cost.

    A cost is the network's, of collisions, less `PROGRESS` for each metre that the trajectory leads
    towards the goal. Among near-ties the one that continues `last`, the plan before, gets the least
    cost.

    Args:
        time: [s].
        depth: (H, W) [m] planar, whole multiples of 24 and 32 pixels.
        X_WB, state: pose, and the state (13,) that it is of.
        p_WG: the goal [m].
        speed: wanted [m/s].

    Raises:
        ValueError: for a depth image of another size.
    """
    spec = network.spec
    nearest = pool_depth(depth, spec.image_height, spec.image_width)
    image = 1.0 / np.clip(nearest, NEAREST, FARTHEST)
    R_WB = X_WB.rotation().matrix()
    _, v_WB, _, w_WB_B = QuadrotorState.of(state)
    observed = state_observation(R_WB, X_WB.translation(), v_WB, w_WB_B, p_WG, speed)
    waypoints_B, costs = network(image, observed)
    v_target_B = observed[-3:]
    advances = waypoints_B[:, -1] @ v_target_B / max(float(np.linalg.norm(v_target_B)), 1e-6)
    costs = costs.astype(float) - PROGRESS * advances
    return _prefer_continuation(Hypotheses(time, X_WB, waypoints_B.astype(float), costs), last)


def _prefer_continuation(hypotheses: Hypotheses, last: Hypotheses | None) -> Hypotheses:
    if last is None:
        return hypotheses
    costs = hypotheses.costs
    least = costs.min()
    ties = np.flatnonzero(costs <= least + NEAR_TIE)
    if len(ties) < 2:
        return hypotheses
    before = last.position_W(hypotheses.plan_time + 0.5, last.best)
    half = NUM_WAYPOINTS // 2 - 1
    away = np.linalg.norm(hypotheses.waypoints_W[ties, half] - before, axis=1)
    chosen = ties[np.argmin(away)]
    costs = costs.copy()
    costs[chosen] = least - 1e-3
    return Hypotheses(hypotheses.plan_time, hypotheses.X_WB, hypotheses.waypoints_B, costs)
