"""Trains in two stages: by an expert's flights, then also by its labels of a student's near-misses.

After the paper, Sec. III-B: the student of the first stage, or another policy, flies the expert's
paths in its training worlds; the second stage trains on all samples.
"""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import blake2b, sha256
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import find_peaks

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.simulation import fly
from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.common.files import (
    claim_folder,
    locks_folder,
    write_text,
    written_atomically,
)
from splatpilot.systems.common.processes import map_processes
from splatpilot.systems.common.progress import Progress, resumable, say
from splatpilot.systems.common.provenance import InfeasibleFlightError, revision
from splatpilot.systems.common.readers import read_archive
from splatpilot.systems.common.validation import require, validate
from splatpilot.systems.policies.diffaero_rgb import DiffAeroRgbConfig
from splatpilot.systems.policies.student import StudentConfig
from splatpilot.training.corpus.collect import keep_clear, render_samples
from splatpilot.training.corpus.corpus import (
    EXPERT,
    RECOVERY,
    Corpus,
    CorpusConfig,
    Shard,
    distinct_shards,
    distinct_worlds,
    link_corpus,
    write_ledger,
    write_shard,
)
from splatpilot.training.corpus.expert import Labeler
from splatpilot.training.corpus.library import WorldRecord
from splatpilot.training.policies import train
from splatpilot.training.policies.train_student import held_out_worlds
from splatpilot.training.policies.trainer import CorpusTraining, Trainer

_PATIENCE = 2.0  # maximum time of a student's flight, in times of the expert's
_ARRAYS = "p_WG", "times", "states", "clearances"  # of a `StudentFlight`, in a file of flights

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
        content = b"".join(np.asarray(array, float).tobytes() for array in arrays)
        return sha256(content).hexdigest()[:16]


def obstacle_clearances(flight: StudentFlight, field: DistanceField) -> np.ndarray:
    """Returns the clearances (N,) [m] of a flight; infinite if ground or ceiling are nearest: with
    a vertical normal, from which no horizontal step leads away."""
    p_WB = flight.states[:, :3]
    nearest = field.query(p_WB)
    level = np.abs(nearest.gradient[:, 2]) > _LEVEL
    for step in _STEPS:
        level &= ~(field.distance(p_WB + step) - nearest.distance > _AWAY)
    return np.where(level, np.inf, flight.clearances)


def near_misses(times: np.ndarray, clearances: np.ndarray) -> np.ndarray:
    """Finds times (m,) [s] of minima of clearances (N,) [m] below `NEAR`, `SEPARATION` apart."""
    closeness = np.concatenate([[-np.inf], -np.nan_to_num(clearances, nan=np.inf), [-np.inf]])
    samples = max(1.0, SEPARATION / np.median(np.diff(times))) if len(times) > 1 else 1.0
    peaks, _ = find_peaks(closeness, height=np.nextafter(-NEAR, 0.0), distance=samples)
    return times[peaks - 1]


def rows_to_recover(flight: StudentFlight, events: np.ndarray, period: float) -> np.ndarray:
    """Returns the indices (n,) of the samples to label, none in contact: `BEFORE` the near-misses
    `events` (m,) [s], every `period` [s], and all along if the flight did not arrive."""
    times = flight.times
    labeled = (events[:, None] - np.arange(BEFORE[0], BEFORE[1] + 1e-9, period)).ravel()
    labeled = labeled[labeled >= times[0] - 1e-9]
    if not flight.arrived:
        labeled = np.append(labeled, np.arange(times[0], times[-1], FAILED_PERIOD))
    rows = np.unique(np.searchsorted(times, labeled - 1e-9))
    return rows[flight.clearances[rows] > 0.0]


def add_recovery(folder: Path, flights: Sequence[StudentFlight], jobs: int) -> Corpus:
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
        digest = sha256("".join(f.digest() for f in flown).encode()).hexdigest()[:12]
        path = folder / "shards" / f"recovery-{world}-{digest}"
        if not path.exists():
            work.append((path, records[world], flown))
    add = partial(_add_world, corpus.config, revision())
    with Progress(total=len(work), desc="labeling near-misses", unit="world") as bar:
        for _ in map_processes(add, work, jobs):
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
    write_shard(path, parts, config.size, about)


def list_tasks(shards: Sequence[Shard], flights: int) -> dict[str, list[dict[str, Any]]]:
    """Lists, by world, the expert's first `flights` in shards, as fields of `Scenario`."""
    tasks: dict[str, list[dict[str, Any]]] = {}
    for shard in shards:
        for flight in shard.flights if shard.source == EXPERT else ():
            if flight["states"]:
                task = {"start": flight["start"], "goal": flight["goal"]}
                task["timeout"] = _PATIENCE * flight["time_s"]
                tasks.setdefault(shard.world, []).append(task)
    return {world: paths[:flights] for world, paths in tasks.items()}


def fly_worlds(
    corpus: Corpus, tasks: dict[str, list[dict[str, Any]]], policy: str, folder: Path, jobs: int
) -> tuple[list[StudentFlight], Counter[str]]:
    """Flies a policy, or a file of weights, in worlds of a corpus; also counts outcomes."""
    folder.mkdir(parents=True, exist_ok=True)
    work = [
        (record, tasks[record.name], folder / f"{record.name}.npz")
        for record in corpus.worlds
        if record.name in tasks
    ]
    missing = [piece for piece in work if not _is_intact(piece[2])]
    fly_world = partial(_fly_world, policy, corpus.config)
    bar = Progress(total=len(work), initial=len(work) - len(missing), desc="flying", unit="world")

    def kept() -> str:
        return f"flights in {bar.n} of {len(work)} worlds are in {folder}; the same command resumes"

    with bar, resumable(kept):
        for _ in map_processes(fly_world, missing, min(jobs, max(len(missing), 1))):
            bar.update()
    flown, outcomes = [], Counter()
    for record, _, file in work:
        arrays = read_archive(file)
        outcomes.update(map(str, arrays["outcomes"]))
        for n in range(len(arrays["outcomes"])):
            flown.append(StudentFlight(record.name, *(arrays[f"{name}_{n}"] for name in _ARRAYS)))
    return flown, outcomes


def _is_intact(file: Path) -> bool:
    """Tells whether a file of flights exists; removes it if damaged."""
    try:
        read_archive(file)
    except FileNotFoundError:
        return False
    except ValueError as error:
        say(f"{error}: it is flown again")
        file.unlink()
        return False
    return True


def _fly_world(
    name: str, config: CorpusConfig, work: tuple[WorldRecord, list[dict[str, Any]], Path]
) -> None:
    """Flies the tasks of one world at the expert's speed, and writes the flights to a file."""
    record, tasks, file = work
    policy: Any = policy_named(name, config.expert.speed)
    world, source = record.make(), record.source
    if isinstance(policy, StudentConfig | DiffAeroRgbConfig):
        policy = replace(policy, camera=config.camera)
    arrays: dict[str, Any] = {}
    outcomes = []
    fields = {"seed": source.seed, "world": source.world, "start_radius": 0.0, "policy": policy}
    for task in tasks:
        try:
            flight = fly(BuildFlightDiagram(Scenario(**fields, **task), world, camera=False))
        except InfeasibleFlightError:
            continue
        parts = np.array(task["goal"]), flight.times, flight.states, flight.clearances
        for name, array in zip(_ARRAYS, parts, strict=True):
            arrays[f"{name}_{len(outcomes)}"] = array
        outcomes.append(str(flight.outcome))
    with written_atomically(file) as path:
        np.savez(path, outcomes=np.array(outcomes, dtype="U16"), **arrays)


@dataclass
class RecoveryFlights:
    """Content of `recovery.yaml`: what determines a run besides the configuration of training."""

    # [-] Maximum number of flights in each world.
    flights: int = 6
    # Policy, or file of weights, that flies; the first stage's if empty.
    flown_by: str = ""
    # Digest of that file.
    flown_by_digest: str = ""
    # Folders of the corpora, and the fraction of their worlds that is held out.
    corpora: list[str] = field(default_factory=list)
    held_out: float = 0.0


@locks_folder("out")
def run[Config: CorpusTraining](
    *,
    config: Config,
    make: Callable[[Config], Trainer],
    out: Path,
    flights: int,
    jobs: int,
    flown_by: str = "",
) -> dict[str, Any]:
    """Trains a student, flies it, labels its near-misses, and trains another on all samples. The
    same call resumes an interrupted run; the corpora of `config` are not changed.

    Writes to `out`: `stage_1` and `stage_2`, see `train.run`; `corpora`, links to those of
    `config`, with the recovery samples; `flights`, files of up to `flights` flights in a world;
    `recovery.yaml`, see `RecoveryFlights`; `recovery.json`, counts, which is returned. `flown_by`,
    a policy or file of weights, flies instead of a first stage; students and policies of RGB see
    by the camera of the corpora, others by their own."""
    for name, value in (("flights", flights), ("jobs", jobs)):
        require(value >= 1, f"--{name}", "at least 1", value)
    # Missing inputs are refused before anything is written.
    validate(config)
    if flown_by:
        policy_named(flown_by)
    worlds = distinct_worlds([Corpus(Path(source)) for source in config.corpora])
    weights = Path(flown_by).read_bytes() if flown_by.endswith(".npz") else b""
    digest = blake2b(weights, digest_size=16).hexdigest() if weights else ""
    decisive = RecoveryFlights(flights, flown_by, digest, list(config.corpora), config.held_out)
    claim_folder(out / "recovery.yaml", decisive)
    policy, first = flown_by, {}
    if not flown_by:
        say(f"first stage, in {out / 'stage_1'}")
        first = train.run(config=config, out=out / "stage_1", make=make)
        policy = str(out / "stage_1" / f"{first['policy']}.npz")
    folders = [out / "corpora" / str(k) for k in range(len(config.corpora))]
    for source, folder in zip(config.corpora, folders, strict=True):
        link_corpus(Path(source), folder)
    corpora = [Corpus(folder) for folder in folders]
    others = {s.revision for corpus in corpora for s in corpus.shards} - {revision()}
    if others:
        say(
            f"samples of the corpora were labeled by revision {', '.join(sorted(others))} of the "
            f"program, recovery by {revision()}; see ledger.csv"
        )
    held_out = set(held_out_worlds(worlds, config.held_out))
    outcomes: Counter[str] = Counter()
    for folder, corpus, shards in zip(folders, corpora, distinct_shards(corpora), strict=True):
        tasks = list_tasks([shard for shard in shards if shard.world not in held_out], flights)
        flown, ended = fly_worlds(corpus, tasks, policy, out / "flights" / folder.name, jobs)
        outcomes += ended
        add_recovery(folder, flown, jobs)
    both = replace(config, corpora=[str(folder) for folder in folders])
    say(f"second stage, in {out / 'stage_2'}")
    second = train.run(config=both, out=out / "stage_2", make=make)
    summary = _count([Corpus(folder) for folder in folders], outcomes)
    summary |= {"flown_by": flown_by} if flown_by else {"stage_1": first}
    summary["stage_2"] = second
    write_text(out / "recovery.json", json.dumps(summary, indent=2) + "\n")
    return summary


def _count(corpora: Sequence[Corpus], outcomes: Counter[str]) -> dict[str, Any]:
    shards = list(chain.from_iterable(distinct_shards(corpora)))
    recovered = [shard for shard in shards if shard.source == RECOVERY]
    return {
        "flights": dict(sorted(outcomes.items())),
        "revisions": sorted({shard.revision for shard in shards}),
        "near_misses": sum(f["near_misses"] for shard in recovered for f in shard.flights),
        "expert_samples": sum(len(shard) for shard in shards if shard.source == EXPERT),
        "recovery_samples": sum(map(len, recovered)),
    }
