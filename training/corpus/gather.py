"""Gathering in one world: the expert flies; its states are labelled, seen and written."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.sensors import make_camera
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.infeasible import InfeasibleFlightError
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.splats.drake_images import color_pixels, ranged_depth
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_to_pose import pose_from_state
from splatpilot.training.corpus.appearance import draw_appearance, with_appearance
from splatpilot.training.corpus.config import CorpusConfig
from splatpilot.training.corpus.library import world_source
from splatpilot.training.corpus.perturbation import perturbed
from splatpilot.training.corpus.sample import EXPERT, Samples
from splatpilot.training.corpus.shard import write_shard
from splatpilot.training.corpus.world_record import record_world
from splatpilot.training.policies.expert import PLANNER, ExpertFlight, Labeller, fly_policy
from splatpilot.training.policies.planner_flights import fly_planner

_ROOM = 0.3  # [m], clearance of a start that is drawn


class LabelledState(NamedTuple):
    """A state and the best ways on from it."""

    state: np.ndarray  # (13,)
    waypoints_W: np.ndarray  # (K, 10, 3) [m], cheapest first; NaN for those that touch something


def gather_world(folder: Path, config: CorpusConfig, index: int, revision: str) -> None:
    """
    Gathers the world `index` of the library into a corpus: its record, then its shard.

    Args:
        folder: of the corpus.
        config: of the corpus.
        index: see `world_source`.
        revision: of the program.

    Raises:
        InfeasibleFlightError: if there is no such world, or its goal cannot be flown to.
        OSError: if it cannot be written.
    """
    source = world_source(config.worlds, config.seed, index)
    world = make_world(source.world, source.seed)
    labeller = Labeller(world.esdf, world.p_WG, config.expert)
    record_world(folder / "worlds" / source.name, source, world.esdf)
    rngs = [np.random.default_rng([config.seed, source.seed, k]) for k in range(config.flights)]
    starts = np.stack([world.p_WS, *(_draw_start(labeller, world.p_WS, rng) for rng in rngs[1:])])
    parts, entries = [], []
    for number, (flight, rng) in enumerate(
        zip(_fly(starts, world, config, labeller), rngs, strict=True)
    ):
        labels = zip(flight.states, flight.labels, strict=True)
        labelled = keep_clear(labels, labeller.field) if flight.is_demonstration else []
        look = draw_appearance(rng, config.appearance)
        if labelled:
            seen, bound = with_appearance(world, look), source.perturbation_bound
            parts.append(see_states(labelled, seen, labeller, config, bound, rng))
        entries.append(
            {
                "flight": number,
                "seed": source.seed,
                "start": starts[number].tolist(),
                "goal": world.p_WG.tolist(),
                "outcome": str(flight.outcome),
                "time_s": flight.time,
                "least_clearance_m": flight.least_clearance,
                "states": len(labelled),
            }
        )
    write_shard(
        shard_folder(folder, source.name),
        Samples.concatenate(parts, config.size),
        world=source.name,
        source=EXPERT,
        flights=entries,
        revision=revision,
    )


def shard_folder(folder: Path, world: str) -> Path:
    """Where what the expert showed in a world is kept."""
    return folder / "shards" / f"expert-{world}"


def _fly(
    starts: np.ndarray, world: World, config: CorpusConfig, labeller: Labeller
) -> Iterable[ExpertFlight]:
    """The expert's flights from each of the starts (N, 3) [m] to the goal of the world."""
    if config.expert.policy == PLANNER:
        return fly_planner(starts, world, config.expert, labeller)
    scenarios = (Scenario(start=start, start_radius=0.0) for start in starts.tolist())
    return (fly_policy(scenario, world, config.expert, labeller) for scenario in scenarios)


def keep_clear(labels: Iterable[tuple[np.ndarray, Hypotheses]], field: Esdf) -> list[LabelledState]:
    """The labelled states (13,) less the trajectories that touch something; of those with fewer
    than K the ones that do not stand first, and states without any are left out."""
    kept = []
    for state, label in labels:
        waypoints_W = label.waypoints_W
        clear = (field.distance(waypoints_W) > VEHICLE_RADIUS).all(axis=1)  # (K,)
        if clear.any():
            waypoints_W = np.where(clear[:, None, None], waypoints_W, np.nan)
            kept.append(LabelledState(state, waypoints_W[np.argsort(~clear, kind="stable")]))
    return kept


def see_states(
    labelled: list[LabelledState],
    world: World,
    labeller: Labeller,
    config: CorpusConfig,
    bound: float,
    rng: np.random.Generator,
) -> Samples:
    """
    Renders labelled states, each from its own pose and from perturbed ones.

    Args:
        labelled: n of them.
        world: as it is to look.
        labeller: that of the labels.
        config: of the corpus.
        bound: how far poses may be perturbed in this world [m].
        rng: draws the perturbations.

    Returns:
        n (1 + copies) samples, `world` and `source` left open.
    """
    camera, optics = make_camera(config.camera, world), config.camera
    copies = config.perturbation.copies
    samples = Samples.zeros(len(labelled) * (1 + copies), config.size)
    row = 0
    for state, waypoints_W in labelled:
        p_WB, v_WB, _, _ = QuadrotorState.of(state)
        X_WB = pose_from_state(state)
        clearance = float(labeller.field.distance(p_WB)) - VEHICLE_RADIUS
        reach = min(bound, clearance)
        around = [perturbed(X_WB, config.perturbation, reach, rng) for _ in range(copies)]
        for X_WP in [X_WB, *around]:
            R_PW, p_WP = X_WP.rotation().matrix().T, X_WP.translation()
            view = camera.render(X_WP)
            samples.color[row] = color_pixels(view.color)
            samples.depth[row] = ranged_depth(view, optics.min_depth, optics.max_depth)
            samples.X_WB[row] = *X_WP.rotation().ToQuaternion().wxyz(), *p_WP
            samples.v_B[row] = R_PW @ v_WB
            to_goal = R_PW @ (labeller.toa.p_WG - p_WP)
            samples.goal_B[row] = to_goal / max(np.linalg.norm(to_goal), 1e-9)
            samples.trajectories_B[row] = (waypoints_W - p_WP) @ R_PW.T
            row += 1
    return samples


def _draw_start(labeller: Labeller, p_WS: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A free place (3,) [m] with room, at least half as far from the goal as p_WS (3,) [m]."""
    field, toa = labeller.field, labeller.toa
    roomy = toa.reachable & (field.distances > VEHICLE_RADIUS + _ROOM)
    cells = np.argwhere(roomy & (toa.times > 0.5 * toa.value(p_WS)))
    if len(cells) == 0:
        raise InfeasibleFlightError("no place half as far from the goal as the start has room")
    return field.lower_W + field.voxel_size * (cells[rng.integers(len(cells))] + 0.5)
