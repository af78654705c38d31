"""The same flight on every machine: what is promised in docs/accuracy.md."""

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from splatpilot.systems.common.provenance import program

# Flies in a process of its own: what numpy computes with is decided when it is imported.
_FLY = """
import json
from splatpilot.analysis.benchmark.rollout import digest
from splatpilot.diagrams.flight.flight import fly
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
    diagram = BuildFlightDiagram(scenario, world, camera=False)
    digests[name] = digest(fly(diagram, scenario, world))
print(json.dumps(digests))
"""

SETTINGS = [
    {"OMP_NUM_THREADS": "1", "SPLATPILOT_SIMD": "v4"},
    {"OMP_NUM_THREADS": "2", "SPLATPILOT_SIMD": "v3", "OPENBLAS_CORETYPE": "Haswell"},
    {"OMP_NUM_THREADS": "1", "OPENBLAS_CORETYPE": "SkylakeX", "NPY_DISABLE_CPU_FEATURES": ""},
]

LIBRARIES = {"drake": "1.58.0", "numpy": "2.5.5", "scipy": "1.18.1", "scikit-fmm": "2025.6.23"}
LIBC = ("glibc", "2.36")
"""With which the flights of `DIGESTS` were flown; others may round otherwise."""

DIGESTS = {"planner": "ddeb995989185fd8", "diffaero": "8951f2e9ac5ab56f"}


def _digests(settings: dict[str, str]) -> dict[str, str]:
    from splatpilot import _native

    if settings.get("SPLATPILOT_SIMD", "v3") not in _native.simd_levels():
        settings = settings | {"SPLATPILOT_SIMD": "v3"}
    ended = subprocess.run(
        [sys.executable, "-c", _FLY],
        env=os.environ | settings,
        check=True,
        capture_output=True,
        text=True,
    )
    return json.loads(ended.stdout.splitlines()[-1])


@pytest.mark.skipif(
    " avx2 " not in Path("/proc/cpuinfo").read_text(), reason="the processor has no AVX2"
)
def test_flights_are_the_same_on_every_machine():
    """A flight has the same bits for any number of threads, with AVX2 and AVX-512, whatever kernels
    the environment asks numpy's BLAS for; and, with the same libraries, those recorded here."""
    first, *others = map(_digests, SETTINGS)
    assert others == [first] * len(others)
    versions = program()
    if {n: versions[n] for n in LIBRARIES} == LIBRARIES and platform.libc_ver() == LIBC:
        assert first == DIGESTS
