"""`splatpilot scene fetch`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import add_overrides, add_verb
from splatpilot.systems.common.files import data_folder, require_existing, scenes_folder


def add_to(verbs: argparse._SubParsersAction) -> None:
    places = add_verb(
        verbs,
        "places",
        _places,
        help="make the scenes of the benchmark's photorealistic scenarios",
        description="Renders what was not captured, reconstructs it, and leaves scene folders "
        "where scenarios look for them. Interrupted, the same command goes on.",
        examples=("places --data data", "places forest_splat --out scenes"),
    )
    places.add_argument(
        "names", nargs="*", metavar="NAME", help="hospital, bookstore, ... (default: R13 to R17)"
    )
    places.add_argument(
        "--data", type=Path, help="folder of captures and meshes (default: $SPLATPILOT_DATA)"
    )
    places.add_argument(
        "--out", type=Path, help="folder of scenes (default: $SPLATPILOT_SCENES, or scenes)"
    )
    add_overrides(places, ("iterations=3000", "render.spacing=1"), _defaults)


def _defaults(options: argparse.Namespace) -> Any:
    from splatpilot.analysis.scenes import default_config

    return default_config()


def _places(options: argparse.Namespace) -> None:
    data = options.data or data_folder()
    if data is not None:
        require_existing(data, "the folder of captures and meshes")
    from splatpilot.systems.common.progress import resumable, say

    scenes = options.out or scenes_folder()
    say(f"making {', '.join(options.names) or 'the scenes of the benchmark'} in {scenes}")
    from splatpilot.analysis import scenes as recipes

    with resumable(lambda: f"scenes that are finished are in {scenes}; the same command resumes"):
        recipes.run(
            names=options.names,
            data=data,
            scenes=scenes,
            overrides=options.overrides,
        )
