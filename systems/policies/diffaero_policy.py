"""What DiffAero's policy sees, what network it has and what its output means."""

import numpy as np

from flysplat.systems.policies.recurrent_network import NetworkSpec

RATE = 15.0  # [Hz]
FOV_X = 90.0  # [deg]
NEAREST, FARTHEST = 0.3, 12.0  # [m] range of depth
ACCELERATION_LIMITS = np.array([10.0, 10.0, 6.0])  # [m/s^2], in the heading frame

DIFFAERO_NETWORK = NetworkSpec(
    image_height=9,
    image_width=16,
    convolutions=((16, 3, 2, 1), (32, 3, 2, 1), (32, 3, 1, 0)),
    state_size=9,
    state_features=64,
    hidden_size=128,
    output_size=3,
)
