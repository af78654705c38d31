"""`splatpilot scale`."""

import argparse
import re
from pathlib import Path

from splatpilot.analysis.commands.options import add_verb, check_kind
from splatpilot.systems.common.files import require_existing


def add_to(verbs: argparse._SubParsersAction) -> None:
    scale = add_verb(
        verbs,
        "scale",
        _scale,
        help="give a scene its size: by a factor, a measured length, or the cameras' height",
        description="Writes the scene anew with all its lengths times one factor. A scene of "
        "photographs alone, whose scale is unknown, can be flown in then. Of a file of "
        "Gaussians it writes a PLY in metres with z up.",
        examples=(
            "scale scenes/room --out scenes/room_metric --height 1.5",
            "scale scenes/room --out scenes/room_metric --between 0,0,1 2,0,1 --distance 3.2",
            "scale garden.ply --out level.ply --up -y --floor 0,1.1,2 1,1.2,2 0,0.9,3",
        ),
    )
    # Points and axes may begin with a minus sign, which argparse takes for an option unless it is a
    # number.
    scale._negative_number_matcher = re.compile(r"-([\d.]|[xyz]$)")  # pyright: ignore
    scale.add_argument("scene", type=Path, help="scene folder, or file of Gaussians")
    scale.add_argument("--out", type=Path, required=True, help="scene folder, or PLY, to write")
    scale.add_argument(
        "--up", choices=("x", "-x", "y", "-y", "z", "-z"), help="which way is up in a file (z)"
    )
    scale.add_argument(
        "--floor",
        nargs=3,
        metavar="X,Y,Z",
        help="three points of the floor in a file, which is tilted: it becomes level, at z = 0",
    )
    by = scale.add_mutually_exclusive_group()
    by.add_argument("--factor", type=float, help="what one unit of the scene becomes [m]")
    by.add_argument(
        "--between",
        nargs=2,
        metavar="X,Y,Z",
        help="two points of the scene, as the ruler of `splatpilot view` gives them",
    )
    by.add_argument(
        "--height", type=float, help="median height of the capture's cameras above the ground [m]"
    )
    scale.add_argument("--distance", type=float, help="true length between these points [m]")


def _scale(options: argparse.Namespace) -> None:
    if (options.between is None) != (options.distance is None):
        raise ValueError("--between and --distance belong together: two points and the metres")
    given = options.factor, options.between, options.height, options.up, options.floor
    if all(each is None for each in given):
        raise ValueError("what is its size? Give --factor, --between with --distance, or --height")
    points = [_point("--between", text) for text in options.between or ()]
    floor = [_point("--floor", text) for text in options.floor or ()]
    require_existing(options.scene, "a scene folder or a file of Gaussians")
    check_kind(options.scene, "scene", "gaussians")
    from splatpilot.analysis.reconstruction import rescale

    rescale.run(
        scene=options.scene,
        out=options.out,
        factor=options.factor,
        between=points,
        distance=options.distance,
        height=options.height,
        up=options.up,
        floor=floor,
    )


def _point(option: str, text: str) -> list[float]:
    try:
        x, y, z = (float(each) for each in text.split(","))
    except ValueError:
        raise ValueError(f"{option} {text!r}: a point X,Y,Z is needed") from None
    return [x, y, z]
