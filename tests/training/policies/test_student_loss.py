"""What the student learns from, against formulas and finite differences."""

import math

import pytest
import torch

from splatpilot.training.policies.train_student import (
    barrier_along,
    cost_error,
    cost_targets,
    hypothesis_errors,
    hypothesis_penalties,
    imitation_terms,
    missing_clearances,
    root_mean_square,
    winners,
)


def straight(*ends) -> torch.Tensor:
    """(1, n, 10, 3) [m] straight ways to these ends."""
    along = torch.linspace(0.1, 1.0, 10, dtype=torch.float64)[:, None]
    return torch.stack([along * torch.tensor(end, dtype=torch.float64) for end in ends])[None]


def random(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_error_of_a_shifted_trajectory():
    """A trajectory that runs d metres beside another differs by 10/3 d^2: ten times the mean
    squared error of a coordinate."""
    experts = straight((2, 0, 0), (2, 1, 0))
    waypoints = experts[:, :1] + torch.tensor([0.0, 0.3, 0.4])
    errors = hypothesis_errors(experts, waypoints)
    assert errors[0, 0, 0].item() == pytest.approx(10 / 3 * 0.25)
    assert root_mean_square(errors)[0, 0, 0].item() == pytest.approx(0.5)


def test_experts_that_are_not_there_neither_vote_nor_pull():
    """Of a sample with two experts instead of three the third changes neither term nor gradient."""
    experts, waypoints = random(0, 4, 3, 10, 3), random(1, 4, 3, 10, 3).requires_grad_()
    experts[:, 2] = torch.nan
    terms = imitation_terms(hypothesis_errors(experts, waypoints), 0.05)
    fewer = imitation_terms(hypothesis_errors(experts[:, :2], waypoints), 0.05)
    assert [t.item() for t in terms] == [t.item() for t in fewer]
    gradient, expected = (
        torch.autograd.grad(sum(of), waypoints)[0] for of in (terms, fewer)
    )  # fmt: skip
    assert gradient.isfinite().all() and torch.equal(gradient, expected)
    assert winners(hypothesis_errors(experts, waypoints)).sum().item() == 4 * 2


def test_winners_take_nearly_all_and_the_unvoted_follow_the_best():
    """Two experts vote for the hypotheses beside them; the third hypothesis, for which none votes,
    is pulled to the best expert by epsilon / 2."""
    experts = straight((2, 0, 0), (2, 1, 0), (2, 1.1, 0))
    waypoints = straight((2, 0.1, 0), (2, 1, 0), (0, 0, 2))
    errors = hypothesis_errors(experts, waypoints)
    assert winners(errors)[0].tolist() == [[1, 0, 0], [0, 1, 0], [0, 1, 0]]
    won, unvoted = imitation_terms(errors, 0.05)
    mean_square = sum((k / 10) ** 2 for k in range(1, 11)) / 10
    assert won.item() == pytest.approx(0.95 * 10 / 3 * mean_square * (0.1**2 + 0 + 0.1**2))
    assert unvoted.item() == pytest.approx(0.025 * 10 / 3 * mean_square * (2**2 + 2**2))


def test_others_than_the_first_win_where_it_is_far_off():
    """With a handicap of 10 in squares, against a first hypothesis d off its expert another wins at
    0.3 d and does not at 0.33 d; among the others the closest wins."""
    experts = straight((2, 0, 0))
    loses = hypothesis_errors(experts, straight((2, 1, 0), (2, 0.33, 0), (2, 0.8, 0)))
    wins = hypothesis_errors(experts, straight((2, 1, 0), (2, 0.31, 0), (2, 0.3, 0)))
    assert winners(loses, 10.0)[0, 0].tolist() == [1, 0, 0]
    assert winners(wins, 10.0)[0, 0].tolist() == [0, 0, 1]
    assert imitation_terms(loses, 0.05, 10.0)[0].item() == pytest.approx(0.95 * loses[0, 0, 0])
    assert imitation_terms(wins, 0.05, 10.0)[0].item() == pytest.approx(0.95 * wins[0, 0, 2])


def test_costs_are_of_error_and_of_the_clearance_of_the_own_way():
    """Equation 4: of two hypotheses the one that runs at 1.354 m from a surface for a second has
    log(2) / 4 of barrier; targets have the mean 1 and no gradient."""
    distances = torch.tensor([[[1.354] * 10, [100.0] * 10]], dtype=torch.float64)
    barriers = barrier_along(distances)
    assert barriers[0].tolist() == pytest.approx([math.log(2.0) / 4.0, 0.0])
    errors = torch.tensor([[[0.9, 0.1], [0.3, 0.5]]], dtype=torch.float64).requires_grad_()
    penalties = hypothesis_penalties(errors, barriers, 2.0)
    assert penalties[0].tolist() == pytest.approx([0.3 + math.log(2.0) / 2.0, 0.1])
    targets = cost_targets(penalties)
    assert targets.mean().item() == pytest.approx(1.0, abs=1e-5) and not targets.requires_grad
    expected = penalties[0, 0] / penalties[0].mean()
    assert targets[0, 0].item() == pytest.approx(expected.item(), rel=1e-5)
    perfect = cost_targets(torch.zeros(1, 3))
    assert perfect.tolist() == [[0.0, 0.0, 0.0]]


def test_lacking_clearance_counts_up_to_the_cap():
    """Of an expert 0.5 m from surfaces, and of one that is far from them with a cap of 0.8 m: a
    hypothesis at 0.3 m lacks 0.2 and 0.5 m all along; one farther off than its expert nothing, and
    none of an expert that there is not."""
    distances = torch.tensor([0.3, 0.9], dtype=torch.float64)[:, None].expand(3, 2, 10)
    kept = torch.tensor([0.5, 3.0, -math.inf], dtype=torch.float64)[:, None].expand(3, 10)
    found = missing_clearances(distances, kept, 0.8)
    assert found[:, 0].tolist() == pytest.approx([10 / 3 * 0.2**2, 10 / 3 * 0.5**2, 0.0])
    assert found[:, 1].tolist() == [0.0, 0.0, 0.0]


def test_gradients_are_those_of_finite_differences():
    """Of each term, by waypoints and by costs, in double precision; also with an expert missing."""
    experts, waypoints = random(0, 3, 3, 10, 3), random(1, 3, 3, 10, 3).requires_grad_()
    experts[1, 2] = torch.nan
    distances = (1.0 + 0.3 * random(2, 3, 3, 10)).requires_grad_()
    costs, targets = random(3, 3, 3).requires_grad_(), random(4, 3, 3)
    check = torch.autograd.gradcheck
    assert check(lambda w: imitation_terms(hypothesis_errors(experts, w), 0.05)[0], waypoints)
    handicapped = lambda w: imitation_terms(hypothesis_errors(experts, w), 0.05, 10.0)[0]  # noqa: E731
    assert check(handicapped, waypoints)
    # Far from the experts, so that one hypothesis gets no votes.
    aside = (waypoints.detach() + 9.0 * torch.eye(3, dtype=torch.float64)[:, None]).requires_grad_()
    unvoted = lambda w: imitation_terms(hypothesis_errors(experts, w), 0.05)[1]  # noqa: E731
    assert unvoted(aside) > 0.0 and check(unvoted, aside)
    assert check(barrier_along, distances)
    kept = 1.0 + 0.3 * random(5, 3, 10)
    assert check(lambda d: missing_clearances(d, kept, 1.1), distances)
    assert check(
        lambda w, d: hypothesis_penalties(hypothesis_errors(experts, w), barrier_along(d), 2.0),
        (waypoints, distances),
    )
    assert check(lambda c: cost_error(c, targets), costs)
