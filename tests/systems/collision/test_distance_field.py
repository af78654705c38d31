import math

import numpy as np
import pytest
import torch

from splatpilot.systems.collision.distance_field import in_collision, soft_barrier


def test_equation_three_at_hand_computed_values():
    assert soft_barrier(1.354, 0.354) == pytest.approx(math.log(2.0) / 4.0)
    assert soft_barrier(0.9, 0.3, beta=2.0, margin=0.5) == pytest.approx(
        math.log1p(math.exp(-0.2)) / 2.0
    )


def test_barrier_is_stable_at_both_ends():
    d = np.array([-1e6, -100.0, 100.0])
    np.testing.assert_allclose(soft_barrier(d, 0.354)[:2], 1.354 - d[:2])
    assert soft_barrier(d, 0.354)[2] == pytest.approx(math.exp(4.0 * (1.354 - 100.0)) / 4.0)
    assert soft_barrier(np.inf, 0.354) == 0.0
    assert np.isnan(soft_barrier(np.nan, 0.354))


def test_torch_gives_the_same_values_and_gradients():
    d = torch.tensor([-1e4, -1.0, 0.0, 1.3, 5.0, 80.0], dtype=torch.float64, requires_grad=True)
    value = soft_barrier(d, 0.354)
    np.testing.assert_allclose(value.detach(), soft_barrier(d.detach().numpy(), 0.354), rtol=1e-12)
    value.sum().backward()
    expected = -torch.sigmoid(4.0 * (1.354 - d.detach()))
    torch.testing.assert_close(d.grad, expected, rtol=1e-12, atol=0.0)


def test_beta_must_be_positive():
    with pytest.raises(ValueError, match=r"beta must be .* got 0\.0"):
        soft_barrier(1.0, 0.354, beta=0.0)


def test_hard_indicator():
    d = np.array([0.353, 0.354, 1.0, -1.0, np.nan])
    np.testing.assert_array_equal(in_collision(d, 0.354), [True, False, False, True, False])
    assert in_collision(torch.tensor([0.1, 1.0]), 0.354).tolist() == [True, False]
