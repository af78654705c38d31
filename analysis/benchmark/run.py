"""`splatpilot benchmark`: flies a study, or the rest of one, and reports on it."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from splatpilot.analysis.benchmark.provenance import program
from splatpilot.analysis.benchmark.report import write_report
from splatpilot.analysis.benchmark.rollout import Rollout
from splatpilot.analysis.benchmark.study import RolloutSpec, StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.benchmark.tables import format_table, policy_table
from splatpilot.analysis.benchmark.workers import fly_all
from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.scene import SceneSource, find_scene
from splatpilot.systems.configuration import dump_config
from splatpilot.systems.cores import available_cores


def run(
    *, config: StudyConfig, out: Path, jobs: int | None = None, cluster: str | None = None
) -> list[dict[str, Any]]:
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
        ValueError: for a study that cannot be flown, or another one in `out`.
        OSError: if `out` cannot be written or the workers fail.
    """
    if jobs is not None and jobs < 1:
        raise ValueError(f"--jobs is {jobs}; it must be at least 1")
    scenarios = config.load_scenarios()
    absent = absent_scenes(scenarios)
    folder = StudyFolder(out)
    flown_by = program()
    flyable = {name: scenarios[name] for name in scenarios if name not in absent}
    folder.begin(config, flyable, flown_by)
    for name, reason in absent.items():
        print(f"{name} is not flown: {reason}")

    specs = [spec for spec in config.rollouts() if spec.scenario not in absent]
    missing, damaged = missing_rollouts(folder, specs)
    for problem in damaged:
        print(f"{problem}; this flight is flown again")
    if missing and len(missing) < len(specs):
        _check_program(folder, flown_by)
        print(f"{len(specs) - len(missing)} of {len(specs)} flights are there already.")
    kept = {name: dump_config(folder.scenario(name)) for name in flyable}
    done = [folder.read(spec)[0] for spec in specs if spec not in set(missing)]
    flights = fly_all(missing, kept, jobs or available_cores(), cluster, folder.weights())
    _keep(folder, flights, done, len(specs))

    rows = [folder.read(spec)[0] for spec in specs]
    timings = [folder.read_timing(spec.id) for spec in specs]
    table = policy_table(rows, config, len(absent))
    folder.write_table("rollouts.csv", rows)
    folder.write_table("timings.csv", timings)
    folder.write_table("table.csv", table)
    write_report(folder, config, rows, timings, absent, damaged)
    print(format_table(table))
    for row in rows:
        if "error" in row:
            print(f"{row['id']} ended in an error: {row['error']}")
    print(f"Wrote rollouts.csv, timings.csv, table.csv and report.html in {out}")
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


def missing_rollouts(
    folder: StudyFolder, specs: list[RolloutSpec]
) -> tuple[list[RolloutSpec], list[str]]:
    """The flights that are not in the folder, and what is wrong with the files that are."""
    missing, damaged = [], []
    for spec in tqdm(specs, "checking", leave=False, disable=None):
        try:
            folder.read(spec)
        except FileNotFoundError:
            missing.append(spec)
        except ValueError as error:
            missing.append(spec)
            damaged.append(str(error))
    return missing, damaged


def _check_program(folder: StudyFolder, flown_by: dict[str, str]) -> None:
    """Raises ValueError if the flights in the folder come from another program."""
    for name, version in folder.program().items():
        if flown_by.get(name) != version:
            raise ValueError(
                f"{folder.path} was begun with {name} {version}, this is {flown_by.get(name)}, and "
                "one study is flown by one program; go back to that one or choose another --out"
            )


def _keep(
    folder: StudyFolder, flights: Iterable[Rollout], done: list[dict[str, Any]], total: int
) -> None:
    """Writes flights as they end; `done` are the rows of those that were there."""
    successes = [row["success"] for row in done]
    with tqdm(total=total, initial=len(successes), desc="flying", unit="flight") as bar:
        for rollout in flights:
            folder.write(rollout)
            successes.append(rollout.row["success"])
            bar.set_postfix_str(f"{sum(successes) / len(successes):.0%} success", refresh=False)
            bar.update()
