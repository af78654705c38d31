"""What to imitate, and how it looks: labelled states, rendered from their poses and beside them."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from splatpilot.diagrams.sensors import make_camera
from splatpilot.diagrams.worlds.appearance import draw_appearance, with_appearance
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.splats.drake_images import color_pixels, ranged_depth
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_to_pose import pose_from_state
from splatpilot.training.corpus.config import CorpusConfig
from splatpilot.training.corpus.perturbation import perturbed
from splatpilot.training.corpus.sample import Samples
from splatpilot.training.policies.expert import Label, Labeller


class Demonstration(NamedTuple):
    """A state and what to imitate there."""

    state: np.ndarray  # (13,)
    waypoints_W: np.ndarray  # (K, 10, 3) [m], cheapest first; NaN for those that touch something


def keep_clear(labels: Iterable[Label], field: Esdf) -> list[Demonstration]:
    """The labels less the trajectories that touch something: those that do not stand first, and
    states without any are left out."""
    kept = []
    for state, plan in labels:
        waypoints_W = plan.waypoints_W
        clear = (field.distance(waypoints_W) > VEHICLE_RADIUS).all(axis=1)  # (K,)
        if clear.any():
            waypoints_W = np.where(clear[:, None, None], waypoints_W, np.nan)
            kept.append(Demonstration(state, waypoints_W[np.argsort(~clear, kind="stable")]))
    return kept


def see_states(
    demonstrations: list[Demonstration],
    world: World,
    labeller: Labeller,
    config: CorpusConfig,
    bound: float,
    rng: np.random.Generator,
) -> Samples:
    """
    Renders demonstrations, each from its own pose and from perturbed ones.

    Args:
        demonstrations: n of them.
        world: where; its look is drawn anew.
        labeller: that of the labels.
        config: of the corpus.
        bound: how far poses may be perturbed in this world [m].
        rng: draws look and perturbations.

    Returns:
        n (1 + copies) samples, `world` and `source` left open.
    """
    copies = config.perturbation.copies
    samples = Samples.zeros(len(demonstrations) * (1 + copies), config.size)
    if not demonstrations:
        return samples
    look = draw_appearance(rng, config.appearance)
    camera, optics = make_camera(config.camera, with_appearance(world, look)), config.camera
    row = 0
    for state, waypoints_W in demonstrations:
        p_WB, v_WB, _, _ = QuadrotorState.of(state)
        X_WB = pose_from_state(state)
        clearance = float(labeller.field.distance(p_WB)) - VEHICLE_RADIUS
        reach = min(bound, clearance)
        around = [perturbed(X_WB, config.perturbation, reach, rng) for _ in range(copies)]
        for X_WP in [X_WB, *around]:
            R_PW, p_WP = X_WP.rotation().matrix().T, X_WP.translation()
            view = camera.render(X_WP)
            samples.color[row] = color_pixels(view.color)
            samples.depth[row] = ranged_depth(view.depth, optics.min_depth, optics.max_depth)
            samples.X_WB[row] = *X_WP.rotation().ToQuaternion().wxyz(), *p_WP
            samples.v_B[row] = R_PW @ v_WB
            samples.goal_B[row] = R_PW @ (labeller.toa.p_WG - p_WP)
            samples.trajectories_B[row] = (waypoints_W - p_WP) @ R_PW.T
            row += 1
    return samples
