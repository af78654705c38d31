"""Recovery: what the expert would have done just before a student came too near, or lost its way.

The student has flown; nothing is flown here. The states before its near-misses are labeled anew
and rendered offline. Beyond the paper, so are states all along flights that did not reach their
goal: who hovers before it, circles it or leaves the volume comes near to nothing.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.signal import find_peaks

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.common.processes import available_cores, map_processes
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import revision
from splatpilot.training.corpus.collect import keep_clear, see_states
from splatpilot.training.corpus.corpus import Corpus, CorpusConfig, write_ledger
from splatpilot.training.corpus.expert import Labeler
from splatpilot.training.corpus.library import WorldRecord
from splatpilot.training.corpus.samples import RECOVERY, write_shard

NEAR = 1.2
"""[m], clearance from obstacles below which the least of a while is a near-miss."""

BEFORE = 0.5, 2.5
"""[s], how long before a near-miss states are taken."""

APART = 1.0
"""[s], between two near-misses."""


LOST = 0.8
"""[s], between two states of a flight that did not reach its goal."""

_LEVEL = 0.87  # [-], least vertical part of the normal of the ground and of ceilings
_STEPS = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])  # [m]
_AWAY = 0.2  # [m], by which such a step leads away from them at most


@dataclass(frozen=True, eq=False)
class StudentFlight:
    """A flight of a student through a world of a corpus, sampled evenly."""

    world: str  # its name in the corpus
    p_WG: np.ndarray  # (3,) [m], the goal that it flew to
    times: np.ndarray  # (N,) [s]
    states: np.ndarray  # (N, 13)
    clearances: np.ndarray  # (N,) [m], distances less the vehicle's radius

    @property
    def arrived(self) -> bool:
        """Whether it ends at its goal."""
        away = np.linalg.norm(self.states[-1, :3] - self.p_WG)
        return bool(away <= Scenario.goal_radius + 1e-6)

    def digest(self) -> str:
        """What tells it from others."""
        arrays = self.p_WG, self.times, self.states
        whole = b"".join(np.ascontiguousarray(array, float).tobytes() for array in arrays)
        return hashlib.sha256(whole).hexdigest()[:16]


def obstacle_clearances(flight: StudentFlight, field: DistanceField) -> np.ndarray:
    """Returns the clearances (N,) [m] of a flight; infinite where ground or ceiling are nearest.

    That is a surface whose normal is vertical, and from which a horizontal step leads away in no
    direction; it does from a wire, a wall's top or a table.
    """
    p_WB = flight.states[:, :3]
    nearest = field.query(p_WB)
    level = np.abs(nearest.gradient[:, 2]) > _LEVEL
    for step in _STEPS:
        level &= ~(field.distance(p_WB + step) - nearest.distance > _AWAY)
    return np.where(level, np.inf, flight.clearances)


def near_misses(times: np.ndarray, clearances: np.ndarray) -> np.ndarray:
    """The times (m,) [s] at which evenly sampled clearances (N,) [m] are least and below `NEAR`,
    two of them at least `APART` apart; also at the beginning and the end, where flights collide."""
    closeness = np.concatenate([[-np.inf], -np.nan_to_num(clearances, nan=np.inf), [-np.inf]])
    samples = max(1.0, APART / np.median(np.diff(times))) if len(times) > 1 else 1.0
    peaks, _ = find_peaks(closeness, height=np.nextafter(-NEAR, 0.0), distance=samples)
    return times[peaks - 1]


def rows_before(times: np.ndarray, events: np.ndarray, period: float) -> np.ndarray:
    """The samples (n,) that lie 0.5 to 2.5 s before events (m,) [s], in steps of `period` [s]."""
    earliest, latest = BEFORE[1], BEFORE[0]
    ahead = np.arange(latest, earliest + 1e-9, period)
    wanted = (events[:, None] - ahead).ravel()
    wanted = wanted[wanted >= times[0] - 1e-9]
    return np.unique(np.searchsorted(times, wanted - 1e-9))


def rows_to_recover(flight: StudentFlight, events: np.ndarray, period: float) -> np.ndarray:
    """The samples (n,) of a flight that are labeled, none of them in contact: before near-misses,
    and all along if it did not arrive.

    Args:
        flight: of a student.
        events: its near-misses (m,) [s].
        period: [s], between two states before a near-miss.
    """
    times = flight.times
    rows = rows_before(times, events, period)
    if not flight.arrived:
        lost = np.searchsorted(times, np.arange(times[0], times[-1], LOST) - 1e-9)
        rows = np.union1d(rows, lost)
    return rows[flight.clearances[rows] > 0.0]


def add_recovery(folder: Path, flights: Sequence[StudentFlight], jobs: int | None = None) -> Corpus:
    """
    Adds to a corpus what the expert would have done before the near-misses of flights, and along
    those that did not arrive.

    The same flights add the same bytes, and those that were added already add nothing.

    Args:
        folder: of the corpus.
        flights: of a student.
        jobs: worker processes; one for each core by default.

    Returns:
        The corpus with them.

    Raises:
        FileNotFoundError, ValueError: if there is no corpus, it is damaged, or was not gathered in
            one of the flights' worlds.
        OSError: if it cannot be written, or a worker process dies.
    """
    corpus = Corpus(folder)
    records = {record.name: record for record in corpus.worlds}
    by_world: dict[str, list[StudentFlight]] = {}
    for flight in flights:
        if flight.world not in records:
            raise ValueError(
                f"{folder} was not gathered in the world {flight.world!r}, where a student flew; "
                "fly it in one of the corpus"
            )
        by_world.setdefault(flight.world, []).append(flight)
    work = []
    for world, flown in by_world.items():
        digest = hashlib.sha256("".join(f.digest() for f in flown).encode()).hexdigest()[:12]
        path = folder / "shards" / f"recovery-{world}-{digest}"
        if not path.exists():
            work.append((path, records[world], flown))
    add = partial(_add_world, corpus.config, revision())
    with Progress(total=len(work), desc="labeling near-misses", unit="world") as bar:
        for _ in map_processes(add, work, jobs or available_cores()):
            bar.update()
    corpus = Corpus(folder)
    write_ledger(folder, corpus)
    return corpus


def _add_world(
    config: CorpusConfig, revision: str, work: tuple[Path, WorldRecord, list[StudentFlight]]
) -> None:
    path, record, flights = work
    world, source = record.make(), record.source
    labelers: dict[bytes, Labeler] = {}
    parts, entries = [], []
    for number, flight in enumerate(flights):
        goal = flight.p_WG.tobytes()
        if goal not in labelers:
            labelers[goal] = Labeler(world.esdf, flight.p_WG, config.expert)
        clearances = obstacle_clearances(flight, world.distance_field)
        events = near_misses(flight.times, clearances)
        states = flight.states[rows_to_recover(flight, events, config.expert.period)]
        labeler, bound = labelers[goal], source.perturbation_bound
        demonstrations = keep_clear(labeler.labels(states), labeler.field)
        rng = np.random.default_rng(int(flight.digest(), 16))
        parts.append(see_states(demonstrations, world, labeler, config, bound, rng))
        entries.append(
            {
                "flight": number,
                "seed": source.seed,
                "start": flight.states[0, :3].tolist(),
                "goal": flight.p_WG.tolist(),
                "time_s": float(flight.times[-1]),
                "least_clearance_m": float(np.nanmin(flight.clearances)),
                "arrived": flight.arrived,
                "near_misses": len(events),
                "states": len(demonstrations),
            }
        )
    write_shard(
        path,
        parts,
        config.size,
        world=record.name,
        source=RECOVERY,
        flights=entries,
        revision=revision,
    )
