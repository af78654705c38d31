"""What a corpus holds of one moment: images, how the vehicle moves, where it wants to, and how."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS

EXPERT, RECOVERY, OFF_PATH = 0, 1, 2
"""Where a sample comes from: a flight of the expert, the time before a student's near-miss, or
anywhere in free space."""

SOURCES = {EXPERT: "expert", RECOVERY: "recovery", OFF_PATH: "off_path"}
"""Their names."""


class SampleSize(NamedTuple):
    """What samples of one corpus have in common."""

    height: int  # [px]
    width: int  # [px]
    trajectories: int  # K

    def image_types(self) -> dict[str, np.dtype]:
        """The types of one sample's images."""
        return {
            "color": np.dtype((np.uint8, (self.height, self.width, 3))),
            "depth": np.dtype((np.float16, (self.height, self.width))),
        }

    def label_type(self) -> np.dtype:
        """The type of everything else that is one sample's own, a record."""
        return np.dtype(
            [
                ("X_WB", "<f8", (7,)),
                ("v_B", "<f4", (3,)),
                ("goal_B", "<f4", (3,)),
                ("trajectories_B", "<f4", (self.trajectories, NUM_WAYPOINTS, 3)),
            ]
        )


@dataclass(frozen=True, eq=False)
class Samples:
    """N samples. B is the body (x forward, y left, z up) at the pose that was rendered from."""

    color: np.ndarray  # (N, H, W, 3) uint8
    depth: np.ndarray  # (N, H, W) float16 [m], planar z; 0: too near, inf: nothing within range
    X_WB: np.ndarray  # (N, 7) float64, quaternion wxyz and position [m]
    v_B: np.ndarray  # (N, 3) float32 [m/s]
    goal_B: np.ndarray  # (N, 3) float32 [m], p_BG_B, from the body to the goal
    # (N, K, 10, 3) float32 [m], waypoints at 0.1 s to 1.0 s, cheapest first; NaN where there are
    # fewer than K.
    trajectories_B: np.ndarray
    world: np.ndarray  # (N,) int32, index into `Corpus.worlds`
    source: np.ndarray  # (N,) uint8, of `SOURCES`

    @classmethod
    def zeros(cls, count: int, size: SampleSize) -> Self:
        """`count` samples to be written to."""
        label = size.label_type()
        types = size.image_types() | {name: label[name] for name in label.names or ()}
        types |= {"world": np.dtype(np.int32), "source": np.dtype(np.uint8)}
        return cls(**{name: np.zeros(count, dtype) for name, dtype in types.items()})

    @property
    def size(self) -> SampleSize:
        """What they have in common."""
        _, height, width = self.depth.shape
        return SampleSize(height, width, self.trajectories_B.shape[1])

    def __len__(self) -> int:
        return len(self.color)
