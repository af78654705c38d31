"""`splatpilot benchmark`: flies or resumes a study, and writes its report."""

import functools
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import batched, chain, groupby, product
from pathlib import Path

from splatpilot.analysis.benchmark.report import write_report
from splatpilot.analysis.benchmark.rollout import Fault, Rollout, fly_rollouts
from splatpilot.analysis.benchmark.study import RolloutSpec, StudyConfig
from splatpilot.analysis.benchmark.study_folder import (
    StudyFolder,
    input_digests,
    keep_inputs,
    kept_flights,
    plugin_digests,
    require_test_scenes,
)
from splatpilot.analysis.benchmark.tables import (
    Row,
    external_table,
    format_external,
    format_table,
    policy_table,
)
from splatpilot.analysis.benchmark.variants import SCENARIO
from splatpilot.analysis.output import write_csv
from splatpilot.diagrams.flight.policies import POLICIES
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.sensors import SENSORS
from splatpilot.diagrams.worlds.scene_folder import SceneSource, find_scene
from splatpilot.diagrams.worlds.world_registry import WORLDS
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import locks_folder
from splatpilot.systems.common.processes import available_cores, map_processes
from splatpilot.systems.common.progress import Progress, resumable
from splatpilot.systems.common.provenance import program
from splatpilot.systems.common.validation import require

CONNECT_TIMEOUT = 10.0  # [s], to a scheduler
_CHUNK = 6  # maximum number of flights through one world that a worker takes together


def fly_all(
    flights: Iterable[tuple[RolloutSpec, Scenario]], jobs: int, cluster: str | None = None
) -> Generator[Rollout | Fault, None, None]:
    """Flies rollouts in worker processes, or on the workers of the dask scheduler `cluster`, and
    yields them as they end, in any order."""
    modules = sorted(POLICIES.modules() | WORLDS.modules() | SENSORS.modules())
    found = [name for name in POLICIES.registered() if ":" in name]
    fly = functools.partial(fly_rollouts, modules=modules, policies=found)
    work = chunks(((spec, dump_config(scenario)) for spec, scenario in flights), _CHUNK)
    if cluster is None:
        yield from chain.from_iterable(map_processes(fly, work, jobs))
        return
    distributed = import_extra("distributed", "cluster")
    try:
        client = distributed.Client(cluster, timeout=CONNECT_TIMEOUT)
    except (OSError, TimeoutError, ValueError) as error:
        raise OSError(
            f"no dask scheduler answers at {cluster} ({error}); start one with `dask scheduler` "
            "and workers with `dask worker ADDRESS --nthreads 1`"
        ) from None
    with client:
        futures = client.map(fly, list(work), pure=False, retries=3)
        try:
            for _, rollouts in distributed.as_completed(futures, with_results=True):
                yield from rollouts
        except distributed.KilledWorker as error:
            raise OSError(
                f"the cluster's workers die of the same flights ({error}); finished flights are "
                "kept: give the workers more memory and run the same command again"
            ) from None


def chunks[Payload](
    flights: Iterable[tuple[RolloutSpec, Payload]], size: int
) -> Iterator[list[tuple[RolloutSpec, Payload]]]:
    """Yields chunks of at most `size` neighbors through the same world."""
    for _, neighbors in groupby(flights, lambda flight: (flight[0].scenario, flight[0].seed)):
        yield from map(list, batched(neighbors, size))


@locks_folder("out")
def run(
    *,
    config: StudyConfig,
    out: Path,
    jobs: int | None = None,
    cluster: str | None = None,
) -> list[Row]:
    """Flies the missing flights of a study, and writes tables and report; returns those of
    `table.csv`.

    The same call resumes an interrupted study, whose files, except timings, are then bitwise
    identical to those of an uninterrupted one. Flights with damaged files are flown again.
    Scenarios without their scene are not flown, and reported.
    """
    require(jobs is None or jobs >= 1, "--jobs", "at least 1", jobs)
    scenarios = config.load_scenarios()
    absent = absent_scenes(scenarios)
    specs = [spec for spec in config.rollouts() if spec.scenario not in absent]
    if not specs:
        raise FileNotFoundError("nothing can be flown: " + "; ".join(absent.values()))
    flyable = {name: scenario for name, scenario in scenarios.items() if name not in absent}
    if config.split == "test":
        require_test_scenes(flyable)
    complete = (
        replace(scenario, policy=variant.config(speed, scenario.policy))
        for scenario, variant, speed in product(scenarios.values(), config.variants, config.speeds)
    )
    flown_by = program() | plugin_digests(complete) | input_digests(config, scenarios)
    folder = StudyFolder(out)
    folder.begin(config, flown_by)
    keep_inputs(folder, config, flyable)
    for name, reason in absent.items():
        print(f"{name} is not flown: {reason}")
    for file in config.unflown_policies():
        print(
            f"The policy of {file} is not flown, but those of --policies are; add {SCENARIO} to "
            "them to fly it."
        )

    rows, damaged = _read_flights(folder, specs)
    missing = [spec for spec in specs if spec.id not in rows]
    if rows and missing:
        for name, version in folder.program().items():
            if flown_by.get(name) != version:
                raise ValueError(
                    f"{out} was started with {name} {version}, this is {flown_by.get(name)}, and "
                    "one program must fly a study; use that one or choose another --out"
                )
        print(f"{len(rows)} of {len(specs)} flights exist already.")
    if missing:
        folder.keep_program(flown_by)
    flights = fly_all(kept_flights(folder, missing), jobs or available_cores(), cluster)
    with closing(flights):
        _keep_flights(folder, flights, rows, len(specs))
    return _conclude(folder, config, [rows[spec.id] for spec in specs], absent, damaged)


def absent_scenes(scenarios: dict[str, Scenario]) -> dict[str, str]:
    """Returns the reasons of scenarios without their scene on this machine."""
    absent = {}
    for name, scenario in scenarios.items():
        if isinstance(scenario.world, SceneSource):
            try:
                find_scene(scenario.world)
            except FileNotFoundError as error:
                absent[name] = str(error)
    return absent


def _read_flights(
    folder: StudyFolder, specs: list[RolloutSpec]
) -> tuple[dict[str, Row], list[str]]:
    """Returns the rows of existing flights by id, and the errors of damaged files."""
    rows, damaged = {}, []
    for spec in Progress(specs, "checking flights", unit="flight", leave=False, delay=1.0):
        try:
            rows[spec.id] = folder.read(spec)[0]
        except FileNotFoundError:
            continue
        except ValueError as error:
            damaged.append(str(error))
            print(f"{error}; this flight is flown again")
    return rows, damaged


def _keep_flights(
    folder: StudyFolder, flights: Iterator[Rollout | Fault], rows: dict[str, Row], total: int
) -> None:
    """Writes flights as they end, and adds them to `rows`. Raises ValueError at a fault."""
    successes = sum(row["success"] for row in rows.values())
    bar = Progress(total=total, initial=len(rows), desc="flying", unit="flight")
    where = f"flights are in {folder.path}; the same command resumes there"
    with bar, resumable(lambda: f"{len(rows)} of {total} {where}"):
        for flown in flights:
            if isinstance(flown, Fault):
                raise ValueError(
                    f"flight {flown.id} was ended by an exception, {flown.reason} (traceback in "
                    f"{folder.write_fault(flown)}); fix it and run the same command again, with "
                    "another --out if code that flies has changed"
                )
            folder.write(flown)
            rows[flown.row["id"]] = flown.row
            successes += flown.row["success"]
            bar.set_postfix_str(f"{successes / len(rows):.0%} success", refresh=False)
            bar.update()


def _conclude(
    folder: StudyFolder,
    config: StudyConfig,
    rows: list[Row],
    absent: dict[str, str],
    damaged: list[str],
) -> list[Row]:
    """Writes and prints the tables of a study, and writes its report; returns the policies'."""
    timings = [folder.read_timing(row["id"]) for row in rows]
    table = policy_table(rows, config, len(absent))
    tables = {"rollouts.csv": rows, "timings.csv": timings, "table.csv": table}
    if external := external_table(rows, config):
        tables["external.csv"] = external
    for name, content in tables.items():
        write_csv(folder.path / name, content)
    write_report(folder, config, rows, timings, table, external, absent, damaged)
    print(format_table(table, config))
    if external:
        print(format_external(external))
    for row in rows:
        if "reason" in row:
            print(f"{row['id']}, {row['outcome']}: {row['reason']}")
    print(f"Wrote {', '.join(tables)} and report.html in {folder.path}")
    return table
