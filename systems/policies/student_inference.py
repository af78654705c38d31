"""The student's network in flight, and what it plans."""

from functools import partial

import numpy as np
from pydrake.math import RigidTransform

from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, Hypotheses
from splatpilot.systems.policies.mobilenet import CHANNELS, MobileNet
from splatpilot.systems.policies.policy_checkpoint import PolicyCheckpoint, check_weights
from splatpilot.systems.policies.student_observation import (
    encode_color,
    encode_depth,
    mirrored_vectors,
    state_observation,
)
from splatpilot.systems.policies.student_spec import HYPOTHESES, StudentSpec
from splatpilot.systems.policies.unobstructed_way import HORIZON

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
