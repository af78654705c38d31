"""`splatpilot view`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import (
    SCENARIOS,
    add_overrides,
    add_overwrite,
    add_verb,
    find_place,
)
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.systems.common.files import require_unused


def add_to(verbs: argparse._SubParsersAction) -> None:
    view = add_verb(
        verbs,
        "view",
        _view,
        help="look at a scene, a map, a capture or a generated world, and measure in it",
        description="Writes a page that any browser opens, without a server or a network: the "
        "Gaussians, distances to surfaces, the captured images where they were taken, a ruler.",
        examples=(
            "view scenes/hospital",
            "view P02 --seed 3 --set world.spacing=2.4",
        ),
    )
    view.add_argument(
        "what",
        help="scene folder, file of Gaussians (PLY, SPZ, .splat), OctoMap (.bt), folder of a "
        "capture, or a scenario: P02 or a file",
    )
    view.add_argument("--out", type=Path, help="page to write (default: out/view/NAME.html)")
    view.add_argument("--seed", type=int, help="seed of a generated world")
    add_overwrite(view)
    add_overrides(view, ("world.spacing=2.4", "world.height=8"), scenario_defaults)


def scenario_defaults(options: argparse.Namespace) -> Any:
    """Of the scenario that is named; of a capture other fields are set."""
    from splatpilot.diagrams.flight.scenario import Scenario
    from splatpilot.systems.common.config import load_config

    what = getattr(options, "what", None)
    return load_config(Scenario(), scenario_file(what) if what in SCENARIOS else None)


def _view(options: argparse.Namespace) -> None:
    kinds = "scene", "gaussians", "map", "capture", "scenario"
    options.what = str(find_place(Path(options.what), *kinds))
    if options.out is not None:
        require_unused(options.out, options.overwrite)
    from splatpilot.analysis import view

    view.run(
        what=options.what,
        out=options.out,
        seed=options.seed,
        overrides=list(options.overrides),
        overwrite=options.overwrite,
    )
