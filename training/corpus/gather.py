"""Gathering in one world: the expert flies; its states are labelled, seen and written."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from splatpilot.diagrams.flight import Flight
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.sensors import make_camera
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.infeasible import InfeasibleFlightError
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
from splatpilot.training.policies.expert import Labeller, fly_expert, is_demonstration

SHORTEST = 4.0
"""[m], least length of the way from a start that is drawn."""

_ROOM = 0.3  # [m], clearance of such a start


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
    flights, parts = [], []
    for number in range(config.flights):
        rng = np.random.default_rng([config.seed, source.seed, number])
        start = _draw_start(labeller, rng) if number else world.p_WS
        scenario = Scenario(seed=source.seed, start=start.tolist())
        look = draw_appearance(rng, config.appearance)
        labelled, entry = _fly(scenario, world, config, labeller)
        if labelled:
            bound = source.perturbation_bound
            seen = with_appearance(world, look)
            parts.append(see_states(labelled, seen, labeller, config, bound, rng))
        flights.append({"flight": number, "seed": source.seed} | entry)
    write_shard(
        shard_folder(folder, source.name),
        Samples.concatenate(parts, config.size),
        world=source.name,
        source=EXPERT,
        flights=flights,
        revision=revision,
    )


def shard_folder(folder: Path, world: str) -> Path:
    """Where what the expert showed in a world is kept."""
    return folder / "shards" / f"expert-{world}"


def _fly(
    scenario: Scenario, world: World, config: CorpusConfig, labeller: Labeller
) -> tuple[list[LabelledState], dict[str, Any]]:
    """The labelled states of a flight of the expert, none if it failed, and what to say of it."""
    entry: dict[str, Any] = {"start": scenario.start, "goal": labeller.toa.p_WG.tolist()}
    try:
        flight = fly_expert(scenario, world, config.expert, labeller)
    except InfeasibleFlightError as error:
        return [], entry | {"outcome": "infeasible", "reason": str(error), "states": 0}
    labelled = []
    if is_demonstration(flight):
        labelled = list(label_states(_states(flight, config.expert.period), labeller))
    return labelled, entry | {
        "outcome": str(flight.outcome),
        "time_s": float(flight.times[-1]),
        "least_clearance_m": float(np.nanmin(flight.clearances)),
        "states": len(labelled),
    }


def _states(flight: Flight, period: float) -> np.ndarray:
    """The states (n, 13) of a flight, one every `period` [s] from its start."""
    times = np.arange(0.0, flight.times[-1], period)
    return flight.states[np.searchsorted(flight.times, times - 1e-9)]


def label_states(states: Iterable[np.ndarray], labeller: Labeller) -> Iterator[LabelledState]:
    """What the expert would do from each state (13,). States without a way on that touches nothing
    are left out; of those with fewer than K the ways that do stand first."""
    for state in states:
        try:
            label = labeller.label(0.0, state)
        except InfeasibleFlightError:
            continue
        waypoints_W = label.waypoints_W
        clear = (labeller.field.distance(waypoints_W) > VEHICLE_RADIUS).all(axis=1)  # (K,)
        if clear.any():
            waypoints_W = np.where(clear[:, None, None], waypoints_W, np.nan)
            yield LabelledState(state, waypoints_W[np.argsort(~clear, kind="stable")])


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


def _draw_start(labeller: Labeller, rng: np.random.Generator) -> np.ndarray:
    """A free place p_WS (3,) [m] with room, from which the way to the goal is long enough."""
    field, toa = labeller.field, labeller.toa
    roomy = toa.reachable & (field.distances > VEHICLE_RADIUS + _ROOM)
    cells = np.argwhere(roomy & (toa.times > SHORTEST))
    if len(cells) == 0:
        raise InfeasibleFlightError(
            f"no place has room to start from with a way of {SHORTEST} m to the goal"
        )
    return field.lower_W + field.voxel_size * (cells[rng.integers(len(cells))] + 0.5)
