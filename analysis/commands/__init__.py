"""The verbs of the command line, one module each, or one of two that belong together.

A module has `add_to(verbs)`, which adds the verb's parser and sets its default `verb` to the
function that runs it. That function imports what it needs when it runs: torch and pydrake take
seconds to load.
"""

from splatpilot.analysis.commands import (
    ablate,
    benchmark,
    capture,
    corpus,
    difficulty,
    doctor,
    faults,
    fidelity,
    fly,
    hardware,
    measure,
    mesh,
    places,
    reconstruct,
    recover,
    replay,
    scale,
    train,
    view,
)

COMMANDS = (
    fly,
    hardware,
    faults,
    benchmark,
    replay,
    difficulty,
    view,
    mesh,
    reconstruct,
    scale,
    measure,
    ablate,
    fidelity,
    capture,
    places,
    corpus,
    train,
    recover,
    doctor,
)
