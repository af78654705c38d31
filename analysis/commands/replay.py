"""`splatpilot replay`."""

import argparse
import logging
from pathlib import Path


def add_to(verbs: argparse._SubParsersAction) -> None:
    replay = verbs.add_parser("replay", help="fly one flight of a study again, and check it")
    replay.set_defaults(verb=_replay)
    replay.add_argument("study", type=Path, help="folder that `splatpilot benchmark` has written")
    replay.add_argument(
        "ids",
        nargs="+",
        metavar="id",
        help="of the flight, as in rollouts.csv; of several through one world, a page of all",
    )
    replay.add_argument("--meshcat", action="store_true", help="write flight.html, to watch it in")
    replay.add_argument("--video", action="store_true", help="write flight.mp4, the onboard view")
    replay.add_argument("--out", type=Path, help="folder for these (STUDY/replays/ID)")


def _replay(options: argparse.Namespace) -> None:
    from splatpilot.analysis.benchmark import replay

    logging.getLogger("drake").setLevel(logging.WARNING)
    if len(options.ids) > 1:
        replay.overlay(study=options.study, ids=options.ids, out=options.out)
        return
    replay.run(
        study=options.study,
        id=options.ids[0],
        out=options.out,
        meshcat=options.meshcat,
        video=options.video,
    )
