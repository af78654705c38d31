"""Finding scenarios by name or path."""

import pytest

from flysplat.diagrams.scenario_files import benchmark_scenarios, scenario_file


def test_names_and_paths_are_found(tmp_path):
    """The benchmark's names give its files; what looks like a file is one."""
    assert scenario_file("P01") == benchmark_scenarios()["P01"]
    assert scenario_file("P01").is_file()
    other = tmp_path / "other"
    other.write_text("")
    assert scenario_file(str(other)) == other
    assert scenario_file("mine.yaml").name == "mine.yaml"


def test_unknown_scenario_lists_those_there_are():
    """An id that does not exist is an error with the ids that do."""
    with pytest.raises(ValueError, match=r"no scenario 'P99'.*P01, P02"):
        scenario_file("P99")
