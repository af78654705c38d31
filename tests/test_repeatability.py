import os
import subprocess
import sys

from splatpilot import _native

# Numbers of threads are read when numpy and OpenBLAS are imported, so each flight has a process.
_FLY = """
import hashlib
import json
from splatpilot.analysis.benchmark.rollout import digest
from splatpilot.diagrams.flight.simulation import fly
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config
from splatpilot.systems.splats.background import mean_color

WORLD = "world={length: 10, width: 6, height: 4, rocks: 1, logs: 1, voxel_size: 0.25}"
scenario = load_config(Scenario(), overrides=[WORLD, "timeout=1", "seed=3"])
world = make_world(scenario.world, scenario.seed)
seen = world.gaussians
arrays = seen.means, seen.quats, seen.scales, seen.opacities, seen.sh, world.p_WS, world.p_WG
digests = {"world": hashlib.sha256(b"".join(each.tobytes() for each in arrays)).hexdigest()}
digests["sky"] = [float(x) for x in mean_color(world.background)]
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
IMPORTS = "", "import pandas, pydrake.all\n"


def test_flights_do_not_depend_on_threads_simd_levels_and_the_order_of_imports():
    levels = _native.simd_levels()
    flown = []
    for settings, first in zip(SETTINGS, IMPORTS, strict=True):
        if settings["SPLATPILOT_SIMD"] not in levels:
            settings = {"OMP_NUM_THREADS": settings["OMP_NUM_THREADS"]}
        flown.append(
            subprocess.run(
                [sys.executable, "-c", first + _FLY],
                env=os.environ | settings,
                check=True,
                capture_output=True,
                text=True,
            ).stdout.splitlines()[-1]
        )
    assert flown[0] == flown[1] and "planner" in flown[0]
