"""`splatpilot benchmark`: flies a study, or the rest of one, and reports on it."""

import functools
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from splatpilot.analysis.benchmark.external import external_table, format_external
from splatpilot.analysis.benchmark.report import write_report
from splatpilot.analysis.benchmark.rollout import Fault, Rollout, chunks, fly_rollouts
from splatpilot.analysis.benchmark.study import SCENARIO, RolloutSpec, StudyConfig
from splatpilot.analysis.benchmark.study_folder import (
    StudyFolder,
    foreign_code,
    input_digests,
    keep_inputs,
    kept_flights,
    require_test_scenes,
)
from splatpilot.analysis.benchmark.tables import format_table, policy_table
from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.sensors import SENSORS
from splatpilot.diagrams.worlds.scene_folder import SceneSource, find_scene
from splatpilot.diagrams.worlds.world_registry import WORLDS
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import holds_folder
from splatpilot.systems.common.processes import available_cores, map_processes
from splatpilot.systems.common.progress import Progress, resumable
from splatpilot.systems.common.provenance import program
from splatpilot.systems.common.validation import require

CONNECT_TIMEOUT = 10.0
"""[s], for a scheduler to answer."""

_CHUNK = 6
"""Most flights through one place handed out together: what of a kill is flown again."""

_Chunk = list[tuple[RolloutSpec, str]]
_Work = Iterator[_Chunk]
_Fly = Callable[[_Chunk], list[Rollout | Fault]]


def fly_all(
    flights: Iterable[tuple[RolloutSpec, Scenario]], jobs: int, cluster: str | None = None
) -> Generator[Rollout | Fault, None, None]:
    """
    Flies rollouts in worker processes and yields them as they end, in any order.

    Args:
        flights: what to fly; neighbours through the same place are flown by the same worker.
        jobs: worker processes on this machine, 1 or more.
        cluster: address of a dask scheduler, whose workers fly instead.

    Raises:
        ModuleNotFoundError: a cluster is wanted and dask.distributed is not installed.
        OSError: if a worker process dies, or the cluster cannot be reached; all that was yielded
            before is good.
    """
    modules = sorted(POLICIES.modules() | WORLDS.modules() | SENSORS.modules())
    found = [name for name in POLICIES.registered() if ":" in name]
    fly = functools.partial(fly_rollouts, modules=modules, policies=found)
    work = chunks(((spec, dump_config(scenario)) for spec, scenario in flights), _CHUNK)
    if cluster is not None:
        yield from _on_cluster(fly, work, cluster)
        return
    yield from chain.from_iterable(map_processes(fly, work, jobs))


def _on_cluster(fly: _Fly, work: _Work, address: str) -> Iterator[Rollout | Fault]:
    distributed = import_extra("distributed", "cluster")
    try:
        client = distributed.Client(address, timeout=CONNECT_TIMEOUT)
    except (OSError, TimeoutError, ValueError) as error:
        raise OSError(
            f"no dask scheduler answers at {address} ({error}); start one with `dask scheduler` "
            "and workers with `dask worker ADDRESS --nthreads 1`"
        ) from None
    with client:
        # A chunk whose worker dies is given to another; flights are pure, so that costs only time.
        futures = client.map(fly, list(work), pure=False, retries=3)
        try:
            for _, rollouts in distributed.as_completed(futures, with_results=True):
                yield from rollouts
        except distributed.KilledWorker as error:
            raise OSError(
                f"the cluster's workers die of one and the same work ({error}); what was flown is "
                "kept: give them more memory and run the same command again"
            ) from None


Row = dict[str, Any]
"""The specification and measures of a flight."""


@holds_folder("out")
def run(
    *,
    config: StudyConfig,
    out: Path,
    jobs: int | None = None,
    cluster: str | None = None,
) -> list[Row]:
    """
    Flies the flights of a study that `out` does not hold yet, each written as it ends, and leaves
    the tables and the report (`splatpilot.analysis.benchmark.study_folder` says which files).

    A run that was interrupted, however, is continued by running it again, and leaves the same bytes
    as one that was not: in all files but those of the timings. Flights whose files are damaged are
    flown again. Scenarios whose scene is absent are not flown, and reported as such.

    Args:
        config: what is flown.
        out: the study's folder.
        jobs: worker processes; one for each core by default.
        cluster: address of a dask scheduler to fly on instead.

    Returns:
        The rows of `table.csv`.

    Raises:
        ValueError: for a study that cannot be flown, another one in `out`, or a flight that an
            exception ended which is no failure of it (`InfeasibleFlightError` is one).
        OSError: if `out` cannot be written, the workers fail, or nothing can be flown because all
            scenes are absent.
    """
    require(jobs is None or jobs >= 1, "--jobs", "at least 1", jobs)
    scenarios = config.load_scenarios()
    names = {spec.scenario for spec in config.rollouts()}
    absent = absent_scenes({name: scenarios[name] for name in scenarios if name in names})
    specs = [spec for spec in config.rollouts() if spec.scenario not in absent]
    if not specs:
        raise FileNotFoundError("nothing can be flown: " + "; ".join(absent.values()))
    flyable = {name: scenarios[name] for name in dict.fromkeys(spec.scenario for spec in specs)}
    if config.split == "test":
        require_test_scenes(flyable)
    folder, flown_by = StudyFolder(out), program() | foreign_code(_complete(config, scenarios))
    flown_by |= input_digests(config, scenarios)
    folder.claim(config, flown_by)
    keep_inputs(folder, config, flyable)
    for name, reason in absent.items():
        print(f"{name} is not flown: {reason}")
    for file in config.unflown_policies():
        print(
            f"The policy that {file} names is not flown, but those of --policies are; add "
            f"{SCENARIO} to them to fly it."
        )

    rows, damaged = flights_there(folder, specs)
    for problem in damaged:
        print(f"{problem}; this flight is flown again")
    missing = [spec for spec in specs if spec.id not in rows]
    if rows and missing:
        _check_program(folder, flown_by)
        print(f"{len(rows)} of {len(specs)} flights are there already.")
    if missing:
        folder.keep_program(flown_by)
    flights = fly_all(kept_flights(folder, missing), jobs or available_cores(), cluster)
    with closing(flights):
        _keep(folder, flights, rows, len(specs))
    return conclude(folder, config, [rows[spec.id] for spec in specs], absent, damaged)


def conclude(
    folder: StudyFolder,
    config: StudyConfig,
    rows: list[Row],
    absent: dict[str, str],
    damaged: list[str],
) -> list[Row]:
    """
    Writes and prints the tables of a study, and writes its report.

    Args:
        folder, config: the study.
        rows: of all its flights.
        absent: the scenarios that were not flown, and why.
        damaged: what was flown again.

    Returns:
        The rows of `table.csv`.
    """
    timings = [folder.read_timing(row["id"]) for row in rows]
    table = policy_table(rows, config, len(absent))
    folder.write_table("rollouts.csv", rows)
    folder.write_table("timings.csv", timings)
    folder.write_table("table.csv", table)
    write_report(folder, config, rows, timings, table, absent, damaged)
    print(format_table(table, config))
    if external := external_table(rows, config):
        folder.write_table("external.csv", external)
        print(f"{format_external(external)}\nWrote external.csv in {folder.path}")
    for row in rows:
        if "reason" in row:
            print(f"{row['id']}, {row['outcome']}: {row['reason']}")
    print(f"Wrote rollouts.csv, timings.csv, table.csv and report.html in {folder.path}")
    return table


def absent_scenes(scenarios: dict[str, Scenario]) -> dict[str, str]:
    """Of the scenarios whose scene is not on this machine: why, and what to do."""
    absent = {}
    for name, scenario in scenarios.items():
        if isinstance(scenario.world, SceneSource):
            try:
                find_scene(scenario.world)
            except FileNotFoundError as error:
                absent[name] = str(error)
    return absent


def flights_there(
    folder: StudyFolder, specs: list[RolloutSpec]
) -> tuple[dict[str, Row], list[str]]:
    """The rows by id of the flights that are in the folder, and what is wrong with the files of
    others."""
    rows, damaged = {}, []
    for spec in Progress(specs, "checking flights", unit="flight", leave=False, delay=1.0):
        try:
            rows[spec.id] = folder.read(spec)[0]
        except FileNotFoundError:
            continue
        except ValueError as error:
            damaged.append(str(error))
    return rows, damaged


def _complete(config: StudyConfig, scenarios: dict[str, Scenario]) -> Iterator[Scenario]:
    """The scenarios with each policy that flies in them."""
    for scenario in scenarios.values():
        for variant in config.variants:
            for speed in config.speeds:
                yield replace(scenario, policy=variant.config(speed, scenario.policy))


def _check_program(folder: StudyFolder, flown_by: dict[str, str]) -> None:
    """Raises ValueError if the flights in the folder come from another program, weights or
    scenes."""
    for name, version in folder.program().items():
        if flown_by.get(name) != version:
            raise ValueError(
                f"{folder.path} was begun with {name} {version}, this is {flown_by.get(name)}, and "
                "one study is flown by one program; go back to that one or choose another --out"
            )


def _keep(
    folder: StudyFolder, flights: Iterator[Rollout | Fault], rows: dict[str, Row], total: int
) -> None:
    """Writes flights as they end, and adds their rows to those that were there.

    Raises:
        ValueError: at a fault.
    """
    successes = sum(row["success"] for row in rows.values())
    bar = Progress(total=total, initial=len(rows), desc="flying", unit="flight")

    def kept() -> str:
        return (
            f"{len(rows)} of {total} flights are in {folder.path}; the same command resumes there"
        )

    with bar, resumable(kept):
        for flown in flights:
            if isinstance(flown, Fault):
                raise ValueError(
                    f"flight {flown.id} was ended by an exception that is no failure of a flight, "
                    f"{flown.reason} (traceback in {folder.write_fault(flown)}); mend it and run "
                    "the same command again, with another --out where code that flies has changed"
                )
            folder.write(flown)
            rows[flown.row["id"]] = flown.row
            successes += flown.row["success"]
            bar.set_postfix_str(f"{successes / len(rows):.0%} success", refresh=False)
            bar.update()
