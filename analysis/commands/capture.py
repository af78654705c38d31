"""`splatpilot capture`: work on captures before they become scenes."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import (
    FailureWithResultError,
    add_json,
    add_overrides,
    add_verb,
    find_place,
)


def add_to(verbs: argparse._SubParsersAction) -> None:
    capture = add_verb(
        verbs,
        "capture",
        None,
        help="render a capture, or check one",
        description="Work on captures before they become scenes.",
        examples=(
            "capture check data/hospital",
            "capture render warehouse.gltf --up z --out out/capture",
        ),
    )
    actions = capture.add_subparsers(required=True, metavar="ACTION")
    _add_check(actions)
    _add_render(actions)


def _add_check(actions: argparse._SubParsersAction) -> None:
    check = add_verb(
        actions,
        "check",
        _check,
        help="tell whether poses, intrinsics and depth of a capture agree",
        description="Carries depth from frame to frame and compares. If it does not agree, tries "
        "the usual mistakes, names the most likely one, and ends with status 1. Without depth, "
        "tells what was read or registered.",
        examples=(
            "capture check data/hospital",
            "capture check data/office --set capture.depth_unit=5000 --json",
        ),
    )
    check.add_argument("capture", type=Path, help="folder of a capture")
    add_overrides(check, ("pairs=30", "capture.depth_unit=5000"), _check_defaults)
    add_json(check, "what was found")


def _check_defaults(options: argparse.Namespace) -> Any:
    from splatpilot.training.captures.check import CheckConfig

    return CheckConfig()


def _check(options: argparse.Namespace) -> Any:
    options.capture = find_place(options.capture, "capture")
    from splatpilot.systems.common.progress import say

    say(f"checking {options.capture}")
    from splatpilot.systems.common.config import load_config
    from splatpilot.training.captures import check

    config = load_config(_check_defaults(options), overrides=options.overrides)
    report = check.run(capture=options.capture, config=config)
    if report.problem:
        raise FailureWithResultError(f"{options.capture}: {report.problem}", report)
    return report


def _add_render(actions: argparse._SubParsersAction) -> None:
    render = add_verb(
        actions,
        "render",
        _render,
        help="render a capture of a mesh or a generated world, with exact depth",
        description="Writes a TartanAir V1 sequence. Without --path the camera visits all the "
        "free space between the heights.",
        examples=(
            "capture render warehouse.gltf --up z --out out/capture",
            'capture render P09 --seed 3 --out out/alley --path "0,0,1.5 8,0,1.5 8,6,1.5"',
        ),
    )
    render.add_argument(
        "world",
        type=Path,
        help=".glb, .gltf or .obj, or a scenario of a generated world: P01 or a file",
    )
    render.add_argument("--out", type=Path, required=True, help="capture folder to write")
    render.add_argument(
        "--path", metavar='"X,Y,Z X,Y,Z ..."', help="points the camera goes through [m]"
    )
    render.add_argument("--up", choices=("y", "z"), help="axis of the mesh file that points up")
    render.add_argument("--seed", type=int, default=0, help="seed of a generated world")
    add_overrides(render, ("spacing=0.8", "highest=2.0", "offsets=[-0.5,0.5]"), _render_defaults)


def _render_defaults(options: argparse.Namespace) -> Any:
    from splatpilot.training.captures.render import RenderConfig

    return RenderConfig()


def _render(options: argparse.Namespace) -> None:
    options.world = find_place(options.world, "mesh", "scenario")
    from splatpilot.systems.common.progress import say

    say(f"rendering {options.world} to {options.out}")
    from splatpilot.systems.common.config import load_config
    from splatpilot.training.captures import render as render_capture

    config = _render_defaults(options)
    if options.up is not None:
        config.up = options.up
    if options.path is not None:
        try:
            config.path = [[float(x) for x in p.split(",")] for p in options.path.split()]
        except ValueError:
            raise ValueError(
                f"--path {options.path!r}: points X,Y,Z separated by spaces are needed"
            ) from None
    config = load_config(config, overrides=options.overrides)
    render_capture.run(world=options.world, out=options.out, config=config, seed=options.seed)
