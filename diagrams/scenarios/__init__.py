"""The scenarios that come with the program, one YAML file each."""

from pathlib import Path

from splatpilot.systems.common.validation import unknown

_FOLDER = Path(__file__).parent


def benchmark_scenarios() -> dict[str, Path]:
    """Returns the files of the benchmark's scenarios by name."""
    return {path.stem: path for path in sorted(_FOLDER.glob("*.yaml"))}


def other_scenarios() -> dict[str, Path]:
    """Returns the files of the scenarios outside the benchmark by name."""
    return {path.stem: path for path in sorted((_FOLDER / "others").glob("*.yaml"))}


def scenario_file(scenario: str) -> Path:
    """Returns the file of a scenario, given by its name or its path."""
    known = benchmark_scenarios() | other_scenarios()
    if scenario in known:
        return known[scenario]
    if Path(scenario).suffix in (".yaml", ".yml") or Path(scenario).is_file():
        return Path(scenario)
    raise ValueError(unknown("scenario", scenario, known, "and others as YAML files"))
