"""`splatpilot capture`: work on captures before they become scenes."""

import argparse
from pathlib import Path

from splatpilot.analysis.commands.overrides import add_overrides


def add_to(verbs: argparse._SubParsersAction) -> None:
    capture = verbs.add_parser("capture", help="render a capture, or check one")
    actions = capture.add_subparsers(required=True, metavar="ACTION")
    _add_check(actions)
    _add_render(actions)


def _add_check(actions: argparse._SubParsersAction) -> None:
    check = actions.add_parser(
        "check",
        help="tell whether poses, intrinsics and depth of a capture agree",
        description="Carries depth from frame to frame and compares. Where it does not agree, "
        "tries the usual mistakes, names the most likely one, and ends with status 1.",
    )
    check.set_defaults(verb=_check)
    check.add_argument("capture", type=Path, help="folder of a capture")
    add_overrides(check, "capture.depth_unit=5000")


def _check(options: argparse.Namespace) -> None:
    from splatpilot.systems.configuration import load_config
    from splatpilot.training.captures import check

    config = load_config(check.CheckConfig(), overrides=options.overrides)
    check.run(capture=options.capture, config=config)


def _add_render(actions: argparse._SubParsersAction) -> None:
    render = actions.add_parser(
        "render",
        help="render a capture of a mesh or a generated world, with exact depth",
        description="Writes a TartanAir V1 sequence. Without --path the camera visits all the "
        "free space between the heights.",
    )
    render.set_defaults(verb=_render)
    render.add_argument(
        "world", type=Path, help=".gltf or .obj, or a scenario of a generated world: P01 or a file"
    )
    render.add_argument("--out", type=Path, required=True, help="capture folder to write")
    render.add_argument(
        "--path", metavar='"X,Y,Z X,Y,Z ..."', help="points the camera goes through [m]"
    )
    render.add_argument("--up", choices=("y", "z"), help="axis of the mesh file that points up")
    render.add_argument("--seed", type=int, default=0, help="seed of a generated world")
    add_overrides(render, "offsets=[-0.5,0.5]")


def _render(options: argparse.Namespace) -> None:
    from splatpilot.systems.configuration import load_config
    from splatpilot.training.captures import render_capture
    from splatpilot.training.captures.render_config import RenderConfig

    config = RenderConfig()
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
