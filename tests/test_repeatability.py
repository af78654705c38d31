import functools
import json
import os
import subprocess
import sys

# Numbers of threads are read when numpy and OpenBLAS are imported, so each flight has a process.
_FLY = """
import functools
import json
from splatpilot.analysis.benchmark.rollout import digest
from splatpilot.diagrams.flight.simulation import fly
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config

WORLD = "world={length: 10, width: 6, height: 4, rocks: 1, logs: 1, voxel_size: 0.25}"
scenario = load_config(Scenario(), overrides=[WORLD, "timeout=1", "seed=3"])
world = make_world(scenario.world, scenario.seed)
digests = {}
for name in ("planner", "diffaero"):
    scenario.policy = policy_named(name)
    diagram = BuildFlightDiagram(scenario, world, video=name == "planner")
    digests[name] = digest(fly(diagram))
print(json.dumps(digests))
"""

SETTINGS = [
    {"OMP_NUM_THREADS": "1", "SPLATPILOT_SIMD": "v4"},
    {"OMP_NUM_THREADS": "2", "SPLATPILOT_SIMD": "v3"},
]


@functools.cache
def _digests(number: int, first: str = "") -> dict[str, str]:
    from splatpilot import _native

    settings = SETTINGS[number]
    if settings["SPLATPILOT_SIMD"] not in _native.simd_levels():
        settings = {name: v for name, v in settings.items() if name != "SPLATPILOT_SIMD"}
    ended = subprocess.run(
        [sys.executable, "-c", first + _FLY],
        env=os.environ | settings,
        check=True,
        capture_output=True,
        text=True,
    )
    return json.loads(ended.stdout.splitlines()[-1])


def test_flights_do_not_depend_on_threads_and_simd_levels():
    assert _digests(0) == _digests(1)


def test_flights_do_not_depend_on_the_order_of_imports():
    assert _digests(0, "import pandas, pydrake.all\n") == _digests(0)


def test_importing_the_package_changes_no_environment():
    script = "import os; before = dict(os.environ); import splatpilot; assert os.environ == before"
    subprocess.run([sys.executable, "-c", script], check=True)
