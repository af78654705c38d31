"""`splatpilot library`: the environments of a folder of data."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands import options as cli
from splatpilot.systems.common.files import data_folder, require_existing, scenes_folder

_OUT = cli.out_option("folder of scenes (default: $SPLATPILOT_SCENES, or scenes)", required=False)


@cli.command(
    "library make",
    cli.Option("names", "hospital, cafe, ... (default: all)", nargs="*", metavar="NAME"),
    cli.Option("--data", "folder of captures, meshes and maps (default: $SPLATPILOT_DATA)", Path),
    cli.Option(
        "--split", "only environments of this split", choices=("train", "validation", "test")
    ),
    _OUT,
    cli.set_option(
        *("iterations=3000", "render.max_frames=100"),
        configuration="splatpilot.analysis.reconstruction.run:RenderedSceneConfig",
    ),
    cli.json_option("the records"),
    examples=("library make --data data", "library make hospital forest_splat --out scenes"),
)
def make(options: argparse.Namespace) -> Any:
    """Renders captures of meshes and generated worlds, reconstructs all captures, measures the
    scenes and OctoMaps, and records them in library.json. If interrupted, the same command
    resumes."""
    data, scenes = options.data or data_folder(), options.out or scenes_folder()
    if data is not None:
        require_existing(data, "the folder of captures and meshes")
    cli.announce(f"making {', '.join(options.names) or 'all environments'} in {scenes}")
    from splatpilot.analysis import environments
    from splatpilot.systems.common.progress import resumable

    with resumable(lambda: f"finished scenes are in {scenes}; the same command resumes"):
        split = options.split or ""
        return cli.call(environments.make, options, data=data, scenes=scenes, split=split)


@cli.command("library show", _OUT, cli.json_option("the records"), examples=("library show",))
def show(options: argparse.Namespace) -> Any:
    """Prints the table of a folder of scenes, and writes library.csv and the contact sheet
    library.png there."""
    from splatpilot.analysis import environments

    return environments.show(scenes=options.out or scenes_folder())


@cli.command(
    "library pack",
    cli.Option("names", "of recorded scenes", nargs="+", metavar="NAME"),
    cli.out_option("folder that a file server can offer"),
    examples=("library pack small_house --out out/packed",),
)
def pack(options: argparse.Namespace) -> None:
    """Writes recorded scenes as SPZ and distance fields, to be shared, with scenes.json, which
    `library get` reads. The scenes are those of $SPLATPILOT_SCENES, or of the folder scenes."""
    from splatpilot.analysis import scene_downloads

    packed = scene_downloads.pack(names=options.names, scenes=scenes_folder(), out=options.out)
    for name, scene in packed.items():
        size = sum(file.bytes for file in scene.files.values())
        print(f"Wrote {options.out / name}, {size / 1e6:.1f} MB; license: {scene.license}")


@cli.command(
    "library get",
    cli.Option("names", "of scenes", nargs="+", metavar="NAME"),
    cli.Option(
        "--from", "folder, or its URL, that `library pack` wrote", dest="source", required=True
    ),
    _OUT,
    examples=("library get small_house --from out/packed",),
)
def get(options: argparse.Namespace) -> None:
    """Copies packed scenes from a folder or a file server, and checks their digests."""
    from splatpilot.analysis import scene_downloads

    scene_downloads.get(
        names=options.names, source=options.source, scenes=options.out or scenes_folder()
    )
