"""`splatpilot fly`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import (
    FailureWithResultError,
    add_json,
    add_overwrite,
    add_scenario,
    add_verb,
    name_of_flight,
    read_scenario,
)
from splatpilot.systems.common.files import require_unused


def add_to(verbs: argparse._SubParsersAction) -> None:
    fly = add_verb(
        verbs,
        "fly",
        _fly,
        help="fly to a goal and leave a page, a video and a trajectory",
        description="Flies one scenario, or the default forest, and leaves a page to watch it in, "
        "the onboard video, the trajectory, its summary, and the scenario with every field.",
        examples=(
            "fly --seed 7",
            "fly --scenario P02 --policy diffaero --speed 3",
            "fly --scene scenes/hospital --policy reactive:margin=0.2 --no-video --json",
        ),
    )
    add_scenario(fly)
    fly.add_argument(
        "--out",
        type=Path,
        help="output folder (default: out/NAME, named by scenario, policy, speed and seed)",
    )
    add_overwrite(fly)
    fly.add_argument("--live", action="store_true", help="serve Meshcat while flying, in real time")
    fly.add_argument("--no-video", action="store_true", help="leave flight.mp4 out")
    fly.add_argument("--graphviz", type=Path, metavar="FILE", help="write the diagram as Graphviz")
    add_json(fly, "the summary")


def _fly(options: argparse.Namespace) -> Any:
    for path in (options.out, options.graphviz):
        if path is not None:
            require_unused(path, options.overwrite)
    scenario = read_scenario(options)

    from splatpilot.diagrams.flight import fly

    summary = fly.run(
        scenario=scenario,
        out=options.out or Path("out") / name_of_flight(options, scenario),
        live=options.live,
        video=not options.no_video,
        graphviz=options.graphviz,
        overwrite=options.overwrite,
    )
    if "reason" in summary:
        raise FailureWithResultError(f"the flight ended {summary['reason']}", summary)
    return summary
