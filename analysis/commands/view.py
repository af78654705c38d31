"""`splatpilot view`."""

import argparse
import logging
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    view = verbs.add_parser(
        "view",
        help="look at a scene, a PLY, a capture or a generated world, and measure in it",
        description="Writes a page that any browser opens, without a server or a network: the "
        "Gaussians, distances to surfaces, the captured images where they were taken, a ruler.",
    )
    view.set_defaults(verb=_view)
    view.add_argument(
        "what", help="scene folder, PLY, folder of a capture, or a scenario: P02 or a file"
    )
    view.add_argument("--out", type=Path, help="page to write (default: out/view/NAME.html)")
    view.add_argument("--seed", type=int, help="seed of a generated world")
    add_overrides(view, "world.spacing=2.4")


def _view(options: argparse.Namespace) -> None:
    from splatpilot.analysis import view

    logging.getLogger("drake").setLevel(logging.WARNING)
    view.run(
        what=options.what, out=options.out, seed=options.seed, overrides=list(options.overrides)
    )
