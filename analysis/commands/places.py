"""`splatpilot places`."""

import argparse
import logging
import os
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    places = verbs.add_parser(
        "places", help="make the scenes of the benchmark's photorealistic scenarios"
    )
    places.set_defaults(verb=_places)
    places.add_argument(
        "names", nargs="*", metavar="NAME", help="hospital, bookstore, ... (default: R13 to R17)"
    )
    places.add_argument(
        "--data", type=Path, help="folder of captures and meshes (default: $SPLATPILOT_DATA)"
    )
    places.add_argument(
        "--out", type=Path, help="folder of scenes (default: $SPLATPILOT_SCENES, or scenes)"
    )
    add_overrides(places, "reconstruct.iterations=3000")


def _places(options: argparse.Namespace) -> None:
    from splatpilot.analysis import places
    from splatpilot.diagrams.worlds.scene import SCENES

    logging.getLogger("drake").setLevel(logging.WARNING)
    data = options.data or (Path(os.environ[places.DATA]) if places.DATA in os.environ else None)
    places.run(
        names=options.names,
        data=data,
        scenes=options.out or Path(os.environ.get(SCENES, "scenes")),
        overrides=options.overrides,
    )
