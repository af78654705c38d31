"""`splatpilot fly`."""

import argparse
import logging
from pathlib import Path

from splatpilot.analysis.commands.scenario_options import add_scenario, read_scenario


def add_to(verbs: argparse._SubParsersAction) -> None:
    fly = verbs.add_parser("fly", help="fly to a goal and leave a page, a video and a trajectory")
    fly.set_defaults(verb=_fly)
    add_scenario(fly)
    fly.add_argument(
        "--out", type=Path, default=Path("out/fly"), help="output folder (%(default)s)"
    )
    fly.add_argument("--live", action="store_true", help="serve Meshcat while flying, in real time")
    fly.add_argument("--no-video", action="store_true", help="leave flight.mp4 out")
    fly.add_argument("--graphviz", type=Path, metavar="FILE", help="write the diagram as Graphviz")


def _fly(options: argparse.Namespace) -> None:
    from splatpilot.diagrams import fly

    logging.getLogger("drake").setLevel(logging.WARNING)
    fly.run(
        scenario=read_scenario(options),
        out=options.out,
        live=options.live,
        video=not options.no_video,
        graphviz=options.graphviz,
    )
