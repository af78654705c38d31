"""`splatpilot measure`."""

import argparse
from pathlib import Path

from splatpilot.analysis.commands.options import add_overwrite, add_verb, check_kind
from splatpilot.systems.common.files import require_existing


def add_to(verbs: argparse._SubParsersAction) -> None:
    measure = add_verb(
        verbs,
        "measure",
        _measure,
        help="compare a scene with the frames of its capture that were held out",
        description="Writes metrics.json (PSNR, SSIM, LPIPS, depth errors, floaters) and views.png "
        "into a scene folder. One that `splatpilot reconstruct` has finished has them already.",
        examples=("measure scenes/room_metric", "measure scenes/hospital --overwrite"),
    )
    measure.add_argument("scene", type=Path, help="scene folder")
    add_overwrite(measure)


def _measure(options: argparse.Namespace) -> None:
    require_existing(options.scene, "a scene folder")
    from splatpilot.systems.common.progress import say

    say(f"measuring {options.scene}")
    check_kind(options.scene, "scene")
    from splatpilot.analysis.reconstruction import measure_scene

    measure_scene.run(options.scene, options.overwrite)
