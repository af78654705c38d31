import numpy as np
import pytest
from pydrake.math import RigidTransform
from room import pinhole_rays, wall_depth

from splatpilot.systems.splats.scene import GaussianScene


class BoxRoom:
    """An empty room with its lower corner in the origin, and a camera of 160 x 120 px in it."""

    K = np.array([[80.0, 0.0, 80.0], [0.0, 80.0, 60.0], [0.0, 0.0, 1.0]])

    def __init__(self, *size: float):
        self.size = np.array(size)  # [m]

    def gaussians(self, step: float, scale: float = 1.0) -> GaussianScene:
        """The walls as round Gaussians `step` [m] apart, of `scale * step`."""
        axes, sides = [np.arange(step / 2, length, step) for length in self.size], []
        for axis, length in enumerate(self.size):
            for end in (0.0, length):
                grids = [np.array([end]) if a == axis else axes[a] for a in range(3)]
                sides.append(np.stack(np.meshgrid(*grids, indexing="ij"), -1).reshape(-1, 3))
        N = len(means := np.concatenate(sides))
        quats, scales = np.tile([1, 0, 0, 0], (N, 1)), np.full((N, 3), scale * step)
        looks = np.full(N, 0.99), np.full((N, 3), 0.3)
        return GaussianScene.from_colors(means, quats, scales, *looks)

    @staticmethod
    def rays(X_WC: RigidTransform) -> np.ndarray:
        """(120, 160, 3) of depth 1, in W."""
        rays_C = np.dstack([pinhole_rays(BoxRoom.K, 160, 120), np.ones((120, 160))])
        return rays_C @ X_WC.rotation().matrix().T

    def depth(self, X_WC: RigidTransform) -> np.ndarray:
        """(120, 160) [m] to the walls."""
        depth = wall_depth(X_WC.translation(), self.rays(X_WC), np.zeros(3), self.size)
        return depth.astype(np.float32)


@pytest.fixture(scope="session")
def box_room() -> type[BoxRoom]:
    return BoxRoom
