"""A study small enough for tests."""

from pathlib import Path

import pytest

from flysplat.analysis.study import StudyConfig


@pytest.fixture
def short_scenario(tmp_path) -> Path:
    """A forest of a few trees, flown for at most 1.5 s."""
    path = tmp_path / "short.yaml"
    path.write_text(
        "world: {length: 8, width: 5, height: 3, rocks: 0, logs: 0, voxel_size: 0.25}\n"
        "timeout: 1.5\n"
    )
    return path


@pytest.fixture
def short_study(short_scenario) -> StudyConfig:
    """Six flights in three places."""
    return StudyConfig(
        scenarios=[str(short_scenario)], policies=["straight", "planner"], speeds=[2.0], seeds=3
    )
