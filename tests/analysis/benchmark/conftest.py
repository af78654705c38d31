import csv
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from splatpilot.analysis.benchmark import run_study
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.commands.main import main

SHORT = (
    "world: {length: 8, width: 5, height: 3, rocks: 0, logs: 0, voxel_size: 0.25}\ntimeout: 1.5\n"
)


@pytest.fixture
def short_scenario(tmp_path) -> Path:
    """A forest of a few trees, flown for at most 1.5 s."""
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    return path


@pytest.fixture
def benchmark(short_scenario, tmp_path) -> Callable[..., int]:
    """Runs `splatpilot benchmark` in the short scenario, with one seed in this process."""

    def run(out: str, *words: str) -> int:
        options = ["--out", str(tmp_path / out), "--seeds", "1", "--jobs", "1", *words]
        return main(["benchmark", "--scenarios", str(short_scenario), *options])

    return run


@pytest.fixture
def short_study(short_scenario) -> StudyConfig:
    """Six flights in three forests."""
    return StudyConfig([str(short_scenario)], ["straight", "planner"], [2.0], seeds=3)


@pytest.fixture(scope="session")
def study(tmp_path_factory) -> tuple[StudyConfig, Path]:
    """A study flown without interruption in this process, and its folder; not to be changed."""
    folder = tmp_path_factory.mktemp("study")
    scenario = folder / "short.yaml"
    scenario.write_text(SHORT)
    config = StudyConfig([str(scenario)], ["straight", "planner"], [2.0], seeds=3)
    run_study.run(config=config, out=folder / "out", jobs=1)
    return config, folder / "out"


@pytest.fixture(scope="session")
def contents() -> Callable[[Path], dict[str, bytes]]:
    """Reads all files of a folder that are identical in two runs of a study, by name."""

    def read(folder: Path) -> dict[str, bytes]:
        files = (path for path in sorted(folder.rglob("*")) if path.is_file())
        named = {str(path.relative_to(folder)): path for path in files}
        return {
            name: path.read_bytes()
            for name, path in named.items()
            if not re.match(r"timings|report\.html", name)
        }

    return read


@pytest.fixture(scope="session")
def rows_of() -> Callable[[Path], list[dict[str, str]]]:
    """Reads the rows of a CSV file."""

    def read(file: Path) -> list[dict[str, str]]:
        with file.open() as lines:
            return list(csv.DictReader(lines))

    return read
