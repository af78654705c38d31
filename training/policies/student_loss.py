"""What the student learns from: relaxed winner-takes-all, and costs of what it predicts.

After the paper, whose objective adapts "Learning High-Speed Flight in the Wild" (A. Loquercio et
al., Science Robotics 2021). N samples, K experts, M hypotheses, T = 10 waypoints.
"""

import torch
from torch import Tensor

from splatpilot.systems.collision.soft_barrier import soft_barrier
from splatpilot.systems.policies.hypotheses import WAYPOINT_PERIOD
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS

_SMALLEST = 1e-6
"""The eta of equation 4 [-], for samples in which all is perfect."""


def hypothesis_errors(experts: Tensor, waypoints: Tensor) -> Tensor:
    """L_km (N, K, M) = 10 / (3 T) sum_t |T*_kt - T_mt|^2 [m^2].

    Infinite for experts that there are not, whose waypoints are NaN; their gradient is zero.

    Args:
        experts: (N, K, T, 3) [m].
        waypoints: (N, M, T, 3) [m].
    """
    there = experts.isfinite().flatten(2).all(2)[:, :, None]
    apart = torch.where(there[..., None, None], experts[:, :, None] - waypoints[:, None], 0.0)
    errors = 10.0 / (3 * experts.shape[2]) * apart.square().sum((3, 4))
    return torch.where(there, errors, torch.inf)


def root_mean_square(errors: Tensor) -> Tensor:
    """The distance [m], root mean square over waypoints, that an error L (...) stands for."""
    return (0.3 * errors).sqrt()


def winners(errors: Tensor, handicap: float = 1.0) -> Tensor:
    """Votes (N, K, M), 1 where hypothesis m is the closest to expert k; none of experts that there
    are not.

    Args:
        errors: L (N, K, M).
        handicap: times that the errors of all hypotheses but the first count.
    """
    contending = torch.cat([errors[..., :1], handicap * errors[..., 1:]], dim=2)
    votes = torch.zeros_like(errors).scatter(2, contending.argmin(2, keepdim=True), 1.0)
    return torch.where(errors.isfinite(), votes, 0.0)


def imitation_terms(errors: Tensor, epsilon: float, handicap: float = 1.0) -> tuple[Tensor, Tensor]:
    """How far the winners are from the experts that voted for them, and what pulls the others.

        winners = mean_n sum_k (1 - epsilon) L_km of the closest m
        unvoted = mean_n sum over m without votes of epsilon / (M - 1) L_0m

    Args:
        errors: L (N, K, M); expert 0 is the best.
        epsilon: the part of the pull that the unvoted share.
        handicap: see `winners`.
    """
    votes = winners(errors, handicap)
    finite = torch.where(errors.isfinite(), errors, 0.0)
    won = (1.0 - epsilon) * (votes * finite).sum((1, 2)).mean()
    unvoted = votes.sum(1) == 0.0  # (N, M)
    share = epsilon / max(errors.shape[2] - 1, 1)
    return won, share * (unvoted * finite[:, 0]).sum(1).mean()


def missing_clearances(distances: Tensor, experts: Tensor, cap: float) -> Tensor:
    """C_m (N, M) = 10 / (3 T) sum_t (min(d*_t, cap) - d_mt)^2 [m^2] where that is positive: how
    much nearer to surfaces hypotheses are than the expert at the same time.

    Args:
        distances: d (N, M, T) [m], signed, at the waypoints.
        experts: d* (N, T) [m] at the best expert's; -inf where there is none, and nothing missing.
        cap: [m], of which more is not asked.
    """
    missing = (experts.clamp(max=cap)[:, None] - distances).clamp(min=0.0)
    return 10.0 / (3 * distances.shape[2]) * missing.square().sum(2)


def barrier_along(distances: Tensor) -> Tensor:
    """g (N, M) [m s]: the soft barrier of equation 3 integrated over trajectories.

    Args:
        distances: (N, M, T) [m], signed, at the waypoints.
    """
    return WAYPOINT_PERIOD * soft_barrier(distances, VEHICLE_RADIUS).sum(2)


def hypothesis_penalties(errors: Tensor, barriers: Tensor, geometric_weight: float) -> Tensor:
    """u_m (N, M) = min_k L_km + geometric_weight g_m, of equation 4."""
    return errors.amin(1) + geometric_weight * barriers


def cost_targets(penalties: Tensor) -> Tensor:
    """c*_m (N, M) = u_m / (mean u + eta), of equation 4; detached."""
    return (penalties / (penalties.mean(1, keepdim=True) + _SMALLEST)).detach()


def cost_error(costs: Tensor, targets: Tensor) -> Tensor:
    """The mean squared error of predicted costs (N, M)."""
    return (costs - targets).square().mean()
