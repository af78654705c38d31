"""`study` and `splatpilot benchmark`: fly, resume or extend a study, and write its report."""

import functools
import tempfile
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import batched, chain, groupby, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from splatpilot.analysis.benchmark.report import write_report
from splatpilot.analysis.benchmark.rollout import Fault, Rollout, fly_rollouts
from splatpilot.analysis.benchmark.study import (
    MakeSystem,
    RolloutSpec,
    StudyConfig,
    named_scenarios,
    parameter_rows,
    policy_texts,
    scenario_texts,
)
from splatpilot.analysis.benchmark.study_folder import (
    StudyFolder,
    input_digests,
    keep_inputs,
    kept_flights,
    plugin_digests,
    require_test_scenes,
    source_digest,
)
from splatpilot.analysis.benchmark.tables import (
    Row,
    compare,
    external_table,
    format_table,
    policy_table,
    scenario_table,
)
from splatpilot.analysis.benchmark.variants import SCENARIO, ScenarioVariant
from splatpilot.diagrams.flight.policies import DEFAULT_SPEED, POLICIES, at_speed, policy_speed
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.sensors import SENSORS
from splatpilot.diagrams.worlds.scene_folder import SceneSource, find_scene
from splatpilot.diagrams.worlds.world_registry import WORLDS
from splatpilot.systems.common.config import dump_config
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import locks_folder, write_csv
from splatpilot.systems.common.processes import available_cores, map_processes
from splatpilot.systems.common.progress import Progress, resumable
from splatpilot.systems.common.provenance import program
from splatpilot.systems.common.readers import error_summary
from splatpilot.systems.common.validation import require
from splatpilot.systems.vehicle.vehicles import VEHICLES

if TYPE_CHECKING:
    import pandas as pd

CONNECT_TIMEOUT = 10.0  # [s], to a scheduler
_CHUNK = 6  # maximum number of flights through one world that a worker takes together


def fly_all(
    flights: Iterable[tuple[RolloutSpec, Scenario]],
    jobs: int,
    cluster: str | None = None,
    changed: Mapping[str, ScenarioVariant] = {},
    systems: Mapping[str, MakeSystem] = {},
) -> Generator[Rollout | Fault, None, None]:
    """Flies rollouts in worker processes, or on the workers of the dask scheduler `cluster`, and
    yields them as they end, in any order; see `fly_rollouts`."""
    registries = POLICIES, WORLDS, SENSORS, VEHICLES
    modules = sorted(each for registry in registries for each in registry.modules())
    found = [name for name in POLICIES.registered() if ":" in name]
    fly = functools.partial(
        fly_rollouts, modules=modules, policies=found, changed=changed, systems=systems
    )
    texts = ((spec, dump_config(scenario)) for spec, scenario in flights)
    work = chunks(texts, _CHUNK, changed)
    if cluster is None:
        yield from chain.from_iterable(map_processes(fly, work, jobs))
        return
    distributed = import_extra("distributed", "cluster")
    try:
        client = distributed.Client(cluster, timeout=CONNECT_TIMEOUT)
    except (OSError, TimeoutError, ValueError) as error:
        raise OSError(
            f"--cluster must be the address of a dask scheduler, got {cluster} ({error}); start "
            "one with `dask scheduler` and workers with `dask worker ADDRESS --nthreads 1`"
        ) from None
    with client:
        for worker, found in client.run(program).items():
            what, remedy = f"program of worker {worker}", "install the same version there"
            require(found == program(), what, f"{program()}", found, remedy)
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
    flights: Iterable[tuple[RolloutSpec, Payload]],
    size: int,
    changed: Mapping[str, ScenarioVariant] = {},
) -> Iterator[list[tuple[RolloutSpec, Payload]]]:
    """Yields chunks of at most `size` neighbors through the same world; for `changed` see
    `fly_rollouts`."""
    worlds = {label: variant.world for label, variant in changed.items()}

    def world(flight: tuple[RolloutSpec, Payload]) -> Any:
        return worlds.get(flight[0].scenario, flight[0].scenario), flight[0].seed

    for _, neighbors in groupby(flights, world):
        yield from map(list, batched(neighbors, size))


class Flown(NamedTuple):
    """The flights of a study."""

    rows: list[Row]  # of all flights
    table: list[Row]  # of `policy_table`


@locks_folder("out")
def run(
    *,
    config: StudyConfig,
    out: Path,
    jobs: int | None = None,
    cluster: str | None = None,
    given: Mapping[str, Scenario] | None = None,
    systems: Mapping[str, MakeSystem] | None = None,
    report: bool = True,
) -> Flown:
    """Flies the missing flights of a study, and writes tables and report.

    The same call resumes an interrupted study, whose files, except timings, are then bitwise
    identical to those of an uninterrupted one. A study with more scenarios, policies, speeds or
    seeds flies what is missing. Flights with damaged files are flown again. Scenarios without their
    scene are not flown, and reported.

    Args:
        given: scenarios by name; others are found by `scenario_file`.
        systems: functions that make the systems of policies, by label.
        report: writes tables and report; flights are written anyway.
    """
    require(jobs is None or jobs >= 1, "--jobs", "at least 1", jobs)
    jobs, systems = jobs or available_cores(), systems or {}
    loaded = config.load_scenarios(given)
    absent = absent_scenes(loaded)
    specs = [spec for spec in config.rollouts() if spec.scenario not in absent]
    if not specs:
        raise FileNotFoundError("nothing can be flown: " + "; ".join(absent.values()))
    flyable = {name: scenario for name, scenario in loaded.items() if name not in absent}
    if config.split == "test":
        require_test_scenes(flyable)
    complete = [
        replace(loaded[each.label], policy=variant.config(speed, loaded[each.label].policy))
        for each, variant, speed in product(
            config.scenario_variants, config.variants, config.speeds
        )
    ]
    if jobs > 1 or cluster is not None:
        _require_importable(complete, systems)
    flown_by = program() | plugin_digests(complete) | input_digests(config, loaded)
    flown_by |= {f"system of {label}": source_digest(make) for label, make in systems.items()}
    folder = StudyFolder(out)
    folder.begin(config, flown_by)
    keep_inputs(folder, config, flyable)
    for name, reason in absent.items():
        print(f"{name} is not flown: {reason}")
    for file in config.unflown_policies(given or ()):
        print(
            f"The policy of {file} is not flown, but those of --policies are; add {SCENARIO} to "
            "them to fly it."
        )

    rows, damaged = _read_flights(folder, specs)
    missing = [spec for spec in specs if spec.id not in rows]
    if rows:
        for name, version in folder.program().items():
            # A complete study may be read by another program, but not as one of other policies.
            is_needed = missing or name.startswith("system of ")
            if is_needed and flown_by.get(name) != version:
                raise ValueError(
                    f"{name} of {out} must be {version}, with which it was started, got "
                    f"{flown_by.get(name)}; use that one or choose another --out"
                )
    if rows and missing:
        print(f"{len(rows)} of {len(specs)} flights exist already.")
    if missing:
        folder.record(config, flown_by)
    changed = {each.label: each for each in config.scenario_variants}
    flights = fly_all(kept_flights(folder, missing), jobs, cluster, changed, systems)
    with closing(flights):
        _keep_flights(folder, flights, rows, len(specs))
    flown = [rows[spec.id] for spec in specs]
    table = policy_table(flown, config, len(absent))
    if report:
        _conclude(folder, config, flown, table, absent, damaged)
    return Flown(flown, table)


def study(
    scenario: Scenario | str | Path | Sequence[str | Path] | Mapping[str, Scenario],
    parameters: Any = None,
    *,
    policies: Any = None,
    seeds: int = 20,
    speeds: Sequence[float] | None = None,
    samples: int | None = None,
    split: str = "dev",
    jobs: int | None = None,
    cluster: str | None = None,
    out: Path | str | None = None,
) -> "pd.DataFrame":
    """Flies scenarios x parameters x policies x speeds x seeds; returns a row for each flight.

    .. code-block:: python

        flights = sp.study("P02", {"vehicle.drag": [0.3, 0.5]}, policies=["planner", "reactive"])
        flights.groupby(["policy", "vehicle.drag"]).success.mean()

    The flights are written to `out` as they end, in the format of `splatpilot benchmark`. The same
    call resumes; with more seeds, policies, speeds, parameters or scenarios it flies what is
    missing.

    Args:
        scenario: a scenario, names of the benchmark's, YAML files, or scenarios by name.
        parameters: values of dotted fields of the scenario, such as `world.spacing` and
            `policy.margin`, which is a field of each policy. A table is a DataFrame or a list of
            dictionaries. A dictionary of lists is a grid. A dictionary may also have distributions
            of `pydrake.common.schema`, which each flight draws by its seed.
        policies: names, texts as `--policies` has them, configurations, and functions from scenario
            and world to a system, which replaces the policy; or a dictionary of these by label.
            Default: the scenario's own.
        seeds: number of seeds.
        speeds: nominal speeds [m/s] of all policies that have one; by default that of the
            configurations, or 2.
        samples: draws this number of values of distributions instead, and flies each with all
            seeds.
        split: seeds, "dev" or "test".
        jobs: worker processes; by default one for each core.
        cluster: address of a dask scheduler whose workers fly.
        out: folder of the study; by default a temporary one.

    Returns:
        Rows with scenario, policy, speed and seed; the swept and drawn fields; outcome, success,
        flight time, path, minimum clearance, position p_WB at the end; measures of difficulty; see
        `flight_metrics` and `Difficulty`.
    """
    import pandas as pd

    names, given = named_scenarios(scenario)
    texts, systems, own = policy_texts(policies)
    if SCENARIO in texts:
        flown = (policy_speed(each.policy) for each in given.values())
        own += [speed for speed in flown if isinstance(speed, float | int)]
    if speeds is None:
        speeds = sorted(set(own)) or [DEFAULT_SPEED]
        what, listed = "speeds of the policies", ", ".join(f"{speed:g}" for speed in speeds)
        require(len(speeds) == 1, what, "equal", listed, f"give speeds=[{listed}]")
    elif SCENARIO in texts and len(speeds) == 1:
        for name, each in given.items():
            if policy_speed(each.policy) is not None:
                given[name] = replace(each, policy=at_speed(each.policy, speeds[0]))
    config = StudyConfig(
        scenarios=scenario_texts(names, parameter_rows(parameters, samples)),
        policies=texts,
        speeds=[float(speed) for speed in speeds],
        seeds=seeds,
        split=split,
    )
    with tempfile.TemporaryDirectory() as folder:
        options: dict[str, Any] = {"jobs": jobs, "cluster": cluster, "report": out is not None}
        flown = run(config=config, out=Path(out or folder), given=given, systems=systems, **options)
    return pd.DataFrame(flown.rows)


def _require_importable(scenarios: list[Scenario], systems: Mapping[str, MakeSystem]) -> None:
    """Checks that worker processes can import what flies."""
    for scenario in scenarios:
        for config in (scenario.policy, scenario.world, *scenario.sensors.values()):
            valid = type(config).__module__ != "__main__"
            what, remedy = type(config).__name__, "put it into a module, or use one job (jobs=1)"
            require(valid, what, "of a module that worker processes import", "__main__", remedy)
    from joblib.externals.loky.backend.reduction import dumps

    for label, make in systems.items():
        try:
            dumps(make)
        except Exception as error:  # Pickling raises any type.
            raise ValueError(
                f"policy {label} must be picklable for worker processes, got "
                f"{error_summary(error)}; use one job (jobs=1)"
            ) from None


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
    table: list[Row],
    absent: dict[str, str],
    damaged: list[str],
) -> None:
    timings = [folder.read_timing(row["id"]) for row in rows]
    tables = {"rollouts.csv": rows, "timings.csv": timings, "table.csv": table}
    tables["scenarios.csv"] = scenario_table(rows, config)
    if pairs := compare(rows, config):
        tables["pairs.csv"] = [pair._asdict() for pair in pairs]
    if external := external_table(rows, config):
        tables["external.csv"] = external
    for name, content in tables.items():
        write_csv(folder.path / name, content)
    write_report(folder, config, rows, timings, table, external, absent, damaged)
    print(format_table(table, config))
    for row in rows:
        if "reason" in row:
            print(f"{row['id']}, {row['outcome']}: {row['reason']}")
    print(f"Wrote {', '.join(tables)} and report.html in {folder.path}")
