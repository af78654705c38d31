"""`splatpilot measure`."""

import argparse
from pathlib import Path


def add_to(verbs: argparse._SubParsersAction) -> None:
    measure = verbs.add_parser(
        "measure", help="compare a scene with the frames of its capture that were held out"
    )
    measure.set_defaults(verb=_measure)
    measure.add_argument("scene", type=Path, help="scene folder")


def _measure(options: argparse.Namespace) -> None:
    from splatpilot.analysis.reconstruction import measure_scene

    measure_scene.run(options.scene)
