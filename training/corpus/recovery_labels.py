"""Recovery: labels of states before a student's near-misses, and along flights that failed.

The expert labels states of recorded flights; nothing is flown here. Labels along flights that did
not reach their goal are an addition to the paper: a student that hovers, circles or leaves the
volume has no near-misses.
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
from splatpilot.training.corpus.collect import keep_clear, render_samples
from splatpilot.training.corpus.corpus import Corpus, CorpusConfig, write_ledger
from splatpilot.training.corpus.expert import Labeler
from splatpilot.training.corpus.library import WorldRecord
from splatpilot.training.corpus.samples import RECOVERY, write_shard

NEAR = 1.2  # [m] clearance from obstacles, below which a minimum is a near-miss
BEFORE = 0.5, 2.5  # [s] before a near-miss, range of the labeled states
SEPARATION = 1.0  # [s] between two near-misses
FAILED_PERIOD = 0.8  # [s] between two labeled states of a flight that did not reach its goal

_LEVEL = 0.87  # [-], minimum vertical part of the normal of the ground and of ceilings
_STEPS = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])  # [m]
_AWAY = 0.2  # [m], maximum increase of their distance by such a step


@dataclass(frozen=True, eq=False)
class StudentFlight:
    """A flight of a student through a world of a corpus, sampled evenly."""

    world: str  # name in the corpus
    p_WG: np.ndarray  # (3,) [m], goal
    times: np.ndarray  # (N,) [s]
    states: np.ndarray  # (N, 13)
    clearances: np.ndarray  # (N,) [m], distances less the vehicle's radius

    @property
    def arrived(self) -> bool:
        """Tells whether it ends at its goal."""
        distance = np.linalg.norm(self.states[-1, :3] - self.p_WG)
        return bool(distance <= Scenario.goal_radius + 1e-6)

    def digest(self) -> str:
        """Computes a digest of its content."""
        arrays = self.p_WG, self.times, self.states
        content = b"".join(np.ascontiguousarray(array, float).tobytes() for array in arrays)
        return hashlib.sha256(content).hexdigest()[:16]


def obstacle_clearances(flight: StudentFlight, field: DistanceField) -> np.ndarray:
    """Returns the clearances (N,) [m] of a flight; infinite if ground or ceiling are nearest. Their
    normal is vertical, and no horizontal step leads away from them; one does from a wire, the top
    of a wall or a table."""
    p_WB = flight.states[:, :3]
    nearest = field.query(p_WB)
    level = np.abs(nearest.gradient[:, 2]) > _LEVEL
    for step in _STEPS:
        level &= ~(field.distance(p_WB + step) - nearest.distance > _AWAY)
    return np.where(level, np.inf, flight.clearances)


def near_misses(times: np.ndarray, clearances: np.ndarray) -> np.ndarray:
    """Finds the times (m,) [s] of minima below `NEAR` of evenly sampled clearances (N,) [m]. They
    are at least `SEPARATION` apart; the first and the last sample may be minima."""
    closeness = np.concatenate([[-np.inf], -np.nan_to_num(clearances, nan=np.inf), [-np.inf]])
    samples = max(1.0, SEPARATION / np.median(np.diff(times))) if len(times) > 1 else 1.0
    peaks, _ = find_peaks(closeness, height=np.nextafter(-NEAR, 0.0), distance=samples)
    return times[peaks - 1]


def rows_before(times: np.ndarray, events: np.ndarray, period: float) -> np.ndarray:
    """Returns the indices (n,) of samples `BEFORE` events (m,) [s], every `period` [s]."""
    ahead = np.arange(BEFORE[0], BEFORE[1] + 1e-9, period)
    desired = (events[:, None] - ahead).ravel()
    desired = desired[desired >= times[0] - 1e-9]
    return np.unique(np.searchsorted(times, desired - 1e-9))


def rows_to_recover(flight: StudentFlight, events: np.ndarray, period: float) -> np.ndarray:
    """Returns the indices (n,) of the samples to label, none in contact: before the near-misses
    `events` (m,) [s], every `period` [s], and all along if the flight did not arrive."""
    times = flight.times
    rows = rows_before(times, events, period)
    if not flight.arrived:
        along = np.arange(times[0], times[-1], FAILED_PERIOD)
        rows = np.union1d(rows, np.searchsorted(times, along - 1e-9))
    return rows[flight.clearances[rows] > 0.0]


def add_recovery(folder: Path, flights: Sequence[StudentFlight], jobs: int | None = None) -> Corpus:
    """Adds samples of recovery from flights to a corpus; flights that were added add nothing."""
    corpus = Corpus(folder)
    records = {record.name: record for record in corpus.worlds}
    by_world: dict[str, list[StudentFlight]] = {}
    for flight in flights:
        if flight.world not in records:
            raise ValueError(
                f"{folder} was not collected in the world {flight.world!r}, where a student flew; "
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
    write_ledger(corpus)
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
        labeler = labelers[goal]
        events = near_misses(flight.times, obstacle_clearances(flight, world.distance_field))
        states = flight.states[rows_to_recover(flight, events, config.expert.period)]
        demonstrations = keep_clear(labeler.labels(states), labeler.field)
        rng, bound = np.random.default_rng(int(flight.digest(), 16)), source.perturbation_bound
        parts.append(render_samples(demonstrations, world, labeler, config, bound, rng))
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
    about = {"world": record.name, "source": RECOVERY, "flights": entries, "revision": revision}
    write_shard(path, parts, config.size, **about)
