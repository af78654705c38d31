"""The files of the scenarios that come with the program, and of others."""

from pathlib import Path


def benchmark_scenarios() -> dict[str, Path]:
    """The files of the benchmark's scenarios by name."""
    folder = Path(__file__).parent / "scenarios"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def scenario_file(scenario: str) -> Path:
    """
    The file of a scenario, given by its name in the benchmark or as a path.

    Raises:
        ValueError: if it is neither.
    """
    known = benchmark_scenarios()
    if scenario in known:
        return known[scenario]
    if Path(scenario).suffix in (".yaml", ".yml") or Path(scenario).is_file():
        return Path(scenario)
    raise ValueError(
        f"there is no scenario {scenario!r}; the benchmark's are {', '.join(known)}, others are "
        "given as YAML files"
    )
