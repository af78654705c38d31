"""Gathering in one world: the expert flies; its states are labelled, seen and written."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.infeasible import InfeasibleFlightError
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS
from splatpilot.training.corpus.config import CorpusConfig
from splatpilot.training.corpus.demonstrations import keep_clear, see_states
from splatpilot.training.corpus.library import world_source
from splatpilot.training.corpus.off_path import STATES_A_LOOK, draw_off_path
from splatpilot.training.corpus.sample import EXPERT, OFF_PATH, SOURCES
from splatpilot.training.corpus.shard import write_shard
from splatpilot.training.corpus.world_record import WorldSource, record_world
from splatpilot.training.policies.expert import PLANNER, ExpertFlight, Labeller, fly_policy
from splatpilot.training.policies.planner_flights import fly_planner

_ROOM = 0.3  # [m], clearance of a start that is drawn


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
    _gather_off_path(folder, config, source, world, labeller, revision)
    rngs = [np.random.default_rng([config.seed, source.seed, k]) for k in range(config.flights)]
    starts = np.stack([world.p_WS, *(_draw_start(labeller, world.p_WS, rng) for rng in rngs[1:])])
    parts, entries = [], []
    for number, (flight, rng) in enumerate(
        zip(_fly(starts, world, config, labeller), rngs, strict=True)
    ):
        labels = flight.labels if flight.is_demonstration else []
        demonstrations = keep_clear(labels, labeller.field)
        bound = source.perturbation_bound
        parts.append(see_states(demonstrations, world, labeller, config, bound, rng))
        entries.append(
            {
                "flight": number,
                "seed": source.seed,
                "start": starts[number].tolist(),
                "goal": world.p_WG.tolist(),
                "outcome": str(flight.outcome),
                "time_s": flight.time,
                "least_clearance_m": flight.least_clearance,
                "states": len(demonstrations),
            }
        )
    write_shard(
        shard_folder(folder, source.name),
        parts,
        config.size,
        world=source.name,
        source=EXPERT,
        flights=entries,
        revision=revision,
    )


def shard_folder(folder: Path, world: str, source: int = EXPERT) -> Path:
    """Where what is seen in a world is kept: on the expert's flights, or off its path."""
    return folder / "shards" / f"{SOURCES[source]}-{world}"


def _gather_off_path(
    folder: Path,
    config: CorpusConfig,
    source: WorldSource,
    world: World,
    labeller: Labeller,
    revision: str,
) -> None:
    """Writes the shard of states that lie on no flight, if any are asked for."""
    if not config.off_path:
        return
    alone = replace(config, perturbation=replace(config.perturbation, copies=0))
    parts = []
    for first in range(0, config.off_path, STATES_A_LOOK):
        # The expert's flights have the numbers from 0 on.
        rng = np.random.default_rng([config.seed, source.seed, config.flights + first])
        count = min(STATES_A_LOOK, config.off_path - first)
        states = draw_off_path(labeller, count, config.expert.speed, rng)
        demonstrations = keep_clear(labeller.labels(states), labeller.field)
        bound = source.perturbation_bound
        parts.append(see_states(demonstrations, world, labeller, alone, bound, rng))
    write_shard(
        shard_folder(folder, source.name, OFF_PATH),
        parts,
        config.size,
        world=source.name,
        source=OFF_PATH,
        flights=[{"states": sum(map(len, parts))}],
        revision=revision,
    )


def _fly(
    starts: np.ndarray, world: World, config: CorpusConfig, labeller: Labeller
) -> Iterable[ExpertFlight]:
    """The expert's flights from each of the starts (N, 3) [m] to the goal of the world."""
    if config.expert.policy == PLANNER:
        return fly_planner(starts, world, config.expert, labeller)
    scenarios = (Scenario(start=start, start_radius=0.0) for start in starts.tolist())
    return (fly_policy(scenario, world, config.expert, labeller) for scenario in scenarios)


def _draw_start(labeller: Labeller, p_WS: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A free place (3,) [m] with room, at least half as far from the goal as p_WS (3,) [m]."""
    field, toa = labeller.field, labeller.toa
    roomy = toa.reachable & (field.distances > VEHICLE_RADIUS + _ROOM)
    cells = np.argwhere(roomy & (toa.times > 0.5 * toa.value(p_WS)))
    if len(cells) == 0:
        raise InfeasibleFlightError("no place half as far from the goal as the start has room")
    return field.lower_W + field.voxel_size * (cells[rng.integers(len(cells))] + 0.5)
