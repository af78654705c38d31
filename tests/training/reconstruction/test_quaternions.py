import numpy as np
import torch

from splatpilot.training.reconstruction.quaternions import rotate


def test_rotation_by_quaternions():
    """A quarter turn about z, by a quaternion of any length, takes x to y."""
    q = torch.tensor([[2.0, 0, 0, 2.0]])
    turned = rotate(q, torch.tensor([[1.0, 0, 0.5]]))
    np.testing.assert_allclose(turned, [[0, 1, 0.5]], atol=1e-6)
