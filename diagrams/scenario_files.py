"""The files of the scenarios that come with the program, and of others."""

from pathlib import Path

from splatpilot.systems.messages import unknown

_FOLDER = Path(__file__).parent / "scenarios"


def benchmark_scenarios() -> dict[str, Path]:
    """The files of the benchmark's scenarios by name."""
    return _files(_FOLDER)


def other_scenarios() -> dict[str, Path]:
    """The files of the scenarios that come with the program and are not in the benchmark."""
    return _files(_FOLDER / "others")


def _files(folder: Path) -> dict[str, Path]:
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def scenario_file(scenario: str) -> Path:
    """
    The file of a scenario that comes with the program, given by its name, or of another, given as a
    path.

    Raises:
        ValueError: if it is neither.
    """
    known = benchmark_scenarios() | other_scenarios()
    if scenario in known:
        return known[scenario]
    if Path(scenario).suffix in (".yaml", ".yml") or Path(scenario).is_file():
        return Path(scenario)
    raise ValueError(unknown("scenario", scenario, known, "and others as YAML files"))
