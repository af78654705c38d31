"""A study of six short flights, and how studies are read and compared."""

import csv
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from splatpilot.analysis.benchmark import run_study as benchmark
from splatpilot.analysis.benchmark.study import StudyConfig


@pytest.fixture(scope="session")
def study(tmp_path_factory) -> tuple[StudyConfig, Path]:
    """A study flown without interruption in this process, and its folder; not to be changed."""
    folder = tmp_path_factory.mktemp("study")
    scenario = folder / "short.yaml"
    scenario.write_text(
        "world: {length: 8, width: 5, height: 3, rocks: 0, logs: 0, voxel_size: 0.25}\n"
        "timeout: 1.5\n"
    )
    config = StudyConfig([str(scenario)], ["straight", "planner"], [2.0], seeds=3)
    benchmark.run(config=config, out=folder / "out", jobs=1)
    return config, folder / "out"


@pytest.fixture(scope="session")
def contents() -> Callable[[Path], dict[str, bytes]]:
    """All files of a folder that must be the same in two runs of a study, by name."""

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
    """The rows of a CSV file."""

    def read(file: Path) -> list[dict[str, str]]:
        with file.open() as lines:
            return list(csv.DictReader(lines))

    return read
