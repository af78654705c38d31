"""What a student, or another policy, flies in the worlds of a corpus: the ways of its expert."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatpilot.diagrams.flight import fly
from splatpilot.diagrams.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.policies import policy_named
from splatpilot.diagrams.scenario import Scenario
from splatpilot.systems.array_files import read_archive
from splatpilot.systems.files import written_atomically
from splatpilot.systems.infeasible import InfeasibleFlightError
from splatpilot.systems.policies.diffaero_rgb import DiffAeroRgbConfig
from splatpilot.systems.policies.student import StudentConfig
from splatpilot.systems.processes import map_processes
from splatpilot.systems.progress import Progress, resumable, say
from splatpilot.training.corpus.config import CorpusConfig
from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.corpus.recovery import StudentFlight
from splatpilot.training.corpus.sample import EXPERT
from splatpilot.training.corpus.shard import Shard
from splatpilot.training.corpus.world_record import WorldRecord

_PATIENCE = 2.0
"""How many times as long as the expert took a student may fly."""


_ARRAYS = "p_WG", "times", "states", "clearances"
"""Of each flight in a file of flights, see `StudentFlight`."""


@dataclass(frozen=True)
class Task:
    """A way that the expert flew."""

    start: list[float]  # [m]
    goal: list[float]  # [m]
    timeout: float  # [s]


def tasks_of(shards: Sequence[Shard], flights: int) -> dict[str, list[Task]]:
    """By world the ways of the expert's first `flights`, of those that shards are from."""
    tasks: dict[str, list[Task]] = {}
    for shard in shards:
        if shard.source == EXPERT:
            tasks.setdefault(shard.world, []).extend(
                Task(flight["start"], flight["goal"], _PATIENCE * flight["time_s"])
                for flight in shard.flights
                if flight["states"]
            )
    return {world: ways[:flights] for world, ways in tasks.items() if ways}


def fly_worlds(
    corpus: Corpus, tasks: dict[str, list[Task]], pilot: str, folder: Path, jobs: int
) -> tuple[list[StudentFlight], Counter[str]]:
    """The flights of a policy, or a file of weights, in worlds of a corpus, and how they ended."""
    folder.mkdir(parents=True, exist_ok=True)
    work = [
        (record, tasks[record.name], folder / f"{record.name}.npz")
        for record in corpus.worlds
        if record.name in tasks
    ]
    missing = [piece for piece in work if not _is_whole(piece[2])]
    fly_world = partial(_fly_world, pilot, corpus.config)
    bar = Progress(total=len(work), initial=len(work) - len(missing), desc="flying", unit="world")

    def kept() -> str:
        return f"flights in {bar.n} of {len(work)} worlds are in {folder}; the same command resumes"

    with bar, resumable(kept):
        for _ in map_processes(fly_world, missing, min(jobs, max(len(missing), 1))):
            bar.update()
    flown, outcomes = [], Counter()
    for record, _, file in work:
        with np.load(file) as arrays:
            outcomes.update(str(outcome) for outcome in arrays["outcomes"])
            for n in range(len(arrays["outcomes"])):
                parts = {name: arrays[f"{name}_{n}"] for name in _ARRAYS}
                flown.append(StudentFlight(record.name, **parts))
    return flown, outcomes


def _is_whole(file: Path) -> bool:
    """Whether a file of flights is there; one that is damaged goes, to be flown again."""
    if not file.exists():
        return False
    try:
        read_archive(file)
    except ValueError as error:
        say(f"{error}: it is flown again")
        file.unlink()
        return False
    return True


def _fly_world(
    pilot: str, config: CorpusConfig, work: tuple[WorldRecord, list[Task], Path]
) -> None:
    """Flies the tasks of one world, as fast as the expert did, and writes the flights to a file."""
    record, tasks, file = work
    policy, world = policy_named(pilot, config.expert.speed), record.make()
    learns_from_corpora = isinstance(policy, StudentConfig | DiffAeroRgbConfig)
    policy = replace(policy, **({"camera": config.camera} if learns_from_corpora else {}))
    arrays: dict[str, Any] = {}
    outcomes = []
    for task in tasks:
        scenario = Scenario(
            seed=record.source.seed,
            world=record.source.world,
            start=task.start,
            goal=task.goal,
            start_radius=0.0,
            timeout=task.timeout,
            policy=policy,
        )
        try:
            flight = fly(BuildFlightDiagram(scenario, world, camera=False), scenario, world)
        except InfeasibleFlightError:
            continue
        parts = np.array(task.goal), flight.times, flight.states, flight.clearances
        for name, array in zip(_ARRAYS, parts, strict=True):
            arrays[f"{name}_{len(outcomes)}"] = array
        outcomes.append(str(flight.outcome))
    with written_atomically(file) as path:
        np.savez(path, outcomes=np.array(outcomes, dtype="U16"), **arrays)
