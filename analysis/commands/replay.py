"""`splatpilot replay`."""

import argparse
from pathlib import Path

from splatpilot.analysis.commands.options import add_overwrite, add_verb
from splatpilot.systems.common.files import require_existing


def add_to(verbs: argparse._SubParsersAction) -> None:
    replay = add_verb(
        verbs,
        "replay",
        _replay,
        help="fly one flight of a study again, and check it",
        description="Flies one flight of a study again, from the study's folder alone, and "
        "compares it with its record, ending with status 1 where they differ; of several flights "
        "it draws one page.",
        examples=(
            "replay out/study P08-reactive-2-003 --meshcat --video",
            "replay out/study P08-planner-2-003 P08-reactive-2-003 --overwrite",
        ),
    )
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
    add_overwrite(replay)


def _replay(options: argparse.Namespace) -> None:
    require_existing(options.study, "the folder of a study")
    from splatpilot.analysis.benchmark import replay

    if len(options.ids) > 1:
        replay.overlay(
            study=options.study, ids=options.ids, out=options.out, overwrite=options.overwrite
        )
        return
    agreement = replay.run(
        study=options.study,
        id=options.ids[0],
        out=options.out,
        meshcat=options.meshcat,
        video=options.video,
        overwrite=options.overwrite,
    )
    if not agreement.exact:
        raise ValueError(f"{options.ids[0]}: the replay differs from the recorded flight")
