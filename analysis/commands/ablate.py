"""`splatpilot ablate`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import add_overrides, add_overwrite, add_verb, find_place


def add_to(verbs: argparse._SubParsersAction) -> None:
    ablate = add_verb(
        verbs,
        "ablate",
        _ablate,
        help="reconstruct captures with more and more use of depth, as 3DGS and 2DGS, and compare",
        description="Extends the paper's ablation: reconstructs each capture as 3DGS and as 2DGS "
        "from points, from depth, with the surface and outline losses, and with the depth term, "
        "measures them, and writes a table and pictures. Interrupted, the same command resumes.",
        examples=(
            "ablate data/hospital --out out/ablation",
            "ablate data/hospital data/office --set iterations=500",
        ),
    )
    ablate.add_argument(
        "captures", type=Path, nargs="+", metavar="CAPTURE", help="folder of a capture, or a scene"
    )
    ablate.add_argument(
        "--out", type=Path, default=Path("out/ablation"), help="output folder (%(default)s)"
    )
    add_overwrite(ablate)
    add_overrides(ablate, ("iterations=3000", "image_width=320"), _defaults)


def _defaults(options: argparse.Namespace) -> Any:
    from splatpilot.training.reconstruction.config import ReconstructConfig

    return ReconstructConfig()


def _ablate(options: argparse.Namespace) -> None:
    options.captures = [find_place(path, "capture", "scene") for path in options.captures]
    from splatpilot.systems.common.progress import say

    say(f"reconstructing {len(options.captures)} captures in every arm in {options.out}")
    from splatpilot.analysis.reconstruction import ablation
    from splatpilot.systems.common.config import load_config

    config = load_config(_defaults(options), overrides=options.overrides)
    ablation.run(options.captures, options.out, config, options.overwrite)
