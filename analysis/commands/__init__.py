"""The commands, one module each.

A module's `add_to(verbs)` adds the parser of its command and the function that runs it. That
function imports what it needs when it runs, as torch and pydrake take seconds to import.
"""

from splatpilot.analysis.commands import (
    benchmark,
    capture,
    corpus,
    difficulty,
    doctor,
    fly,
    hardware,
    reconstruct,
    recover,
    replay,
    scene,
    train,
    view,
)

COMMANDS = (
    fly,
    view,
    benchmark,
    replay,
    difficulty,
    reconstruct,
    capture,
    scene,
    train,
    recover,
    corpus,
    hardware,
    doctor,
)

MOVED = {
    "tour": "reconstruct",
    "merge": "benchmark --cluster",
    "places": "scene fetch",
    **{name: f"scene {name}" for name in ("scale", "measure", "mesh", "ablate", "fidelity")},
    **{name: f"hardware {name}" for name in ("vehicle", "bridge", "px4", "faults")},
}
"""Names of commands that have moved."""
