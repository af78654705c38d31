"""Finding scenarios by name or path, and writing them."""

import subprocess
import sys

import pytest

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios, other_scenarios, scenario_file
from splatpilot.systems.common.config import dump_config, load_config, parse_config


def test_names_and_paths_are_found(tmp_path):
    assert scenario_file("P01") == benchmark_scenarios()["P01"]
    assert scenario_file("P01").is_file()
    other = tmp_path / "other"
    other.write_text("")
    assert scenario_file(str(other)) == other
    assert scenario_file("mine.yaml").name == "mine.yaml"


def test_scenarios_outside_the_benchmark_have_names_too():
    assert len(benchmark_scenarios()) == 17
    assert not set(benchmark_scenarios()) & set(other_scenarios())
    assert scenario_file("alley_splat").is_file()


def test_unknown_scenario_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"no scenario 'nothing'.*P01, P02"):
        scenario_file("nothing")


@pytest.mark.parametrize("name", benchmark_scenarios() | other_scenarios())
def test_scenario_that_was_written_is_the_same(name):
    scenario = load_config(Scenario(), scenario_file(name))
    again = parse_config(Scenario(), dump_config(scenario), name)
    assert type(again.world) is type(scenario.world)
    assert again.world == scenario.world


def test_drakes_reader_reads_scenarios():
    text = "world: !WallsConfig {pattern: slalom}\npolicy: !ReactiveConfig {margin: 0.4}\n"
    program = f"""
import splatpilot as sp
from pydrake.common.yaml import yaml_load_typed
print(sp.dump_config(yaml_load_typed(schema=sp.Scenario, data={text!r})))
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ran.stdout.strip() == dump_config(parse_config(Scenario(), text, "text")).strip()
