"""`splatpilot fidelity`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import add_overrides, add_overwrite, add_verb, check_kind
from splatpilot.systems.common.files import require_existing


def add_to(verbs: argparse._SubParsersAction) -> None:
    fidelity = add_verb(
        verbs,
        "fidelity",
        _fidelity,
        help="measure how far from its capture's path a scene can be trusted",
        description="Renders scenes from beside their captures' paths, compares with the truth "
        "where there is one and with other frames elsewhere, and writes how far a camera may "
        "leave the path into each scene.yaml.",
        examples=(
            "fidelity scenes/hospital",
            "fidelity scenes/hospital scenes/warehouse --out out/fidelity",
        ),
    )
    fidelity.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="scene folder")
    fidelity.add_argument(
        "--out", type=Path, default=Path("out/fidelity"), help="output folder (%(default)s)"
    )
    add_overwrite(fidelity)
    add_overrides(fidelity, ("max_depth_error=0.03",), _defaults)


def _defaults(options: argparse.Namespace) -> Any:
    from splatpilot.analysis.fidelity.fidelity import FidelityConfig

    return FidelityConfig()


def _fidelity(options: argparse.Namespace) -> None:
    for scene in options.scenes:
        require_existing(scene, "a scene folder")
    from splatpilot.systems.common.progress import say

    say(f"comparing views off the path of {len(options.scenes)} scenes in {options.out}")
    for scene in options.scenes:
        check_kind(scene, "scene")
    from splatpilot.analysis.fidelity import fidelity as fidelity
    from splatpilot.systems.common.config import load_config

    config = load_config(_defaults(options), overrides=options.overrides)
    fidelity.run(options.scenes, options.out, config, overwrite=options.overwrite)
