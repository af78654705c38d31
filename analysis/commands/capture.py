"""`splatpilot reconstruct`, `capture` and `library`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands import options as cli
from splatpilot.analysis.commands.checks import SCENARIOS
from splatpilot.systems.common.files import data_folder, require_existing, scenes_folder

_RENDERED = {".gltf", ".glb", ".obj", ".yaml", ".yml"}


def _is_rendered(source: str) -> bool:
    return Path(source).suffix.lower() in _RENDERED or source in SCENARIOS


def _defaults(options: argparse.Namespace) -> Any:
    from splatpilot.analysis.reconstruction.measure_scene import RenderedSceneConfig
    from splatpilot.training.reconstruction.config import ReconstructConfig

    rendered = options.source and _is_rendered(options.source)
    return RenderedSceneConfig() if rendered else ReconstructConfig()


@cli.command(
    "reconstruct",
    cli.input_option("source", "capture", "mesh", "scenario"),
    cli.out_option("scene folder to write"),
    cli.UP,
    cli.SEED,
    cli.flag("--restart", "discard an interrupted run"),
    cli.OVERWRITE,
    cli.set_option(
        *("iterations=3000", "voxel_size=0.1", "image_width=640", "device=cuda"),
        configuration=_defaults,
    ),
    examples=(
        "reconstruct data/hospital --out scenes/hospital",
        "reconstruct photos --out scenes/room --set capture.scale.camera_height=1.5",
        "reconstruct warehouse.gltf --up z --out scenes/warehouse",
    ),
)
def reconstruct(options: argparse.Namespace) -> None:
    """Renders a mesh or a generated world to OUT/capture first. Then fits Gaussians to the images
    and depth of a capture, measures them on held-out frames, and writes a scene folder with its
    distance field. If interrupted, the same command resumes."""
    source, rendered = options.source, _is_rendered(options.source)
    for name in ("up", "seed"):
        if getattr(options, name) is not None and not rendered:
            raise ValueError(f"--{name} must be of a mesh or a scenario, got a capture, {source}")
    cli.announce(f"reconstructing {source} as {options.out}")
    from splatpilot.analysis.reconstruction import measure_scene

    config: Any = cli.read_config(options)
    if not rendered:
        cli.call(measure_scene.make_scene, options, capture=Path(source), config=config)
        return
    config.render.up = options.up or config.render.up
    given = {"world": Path(source), "config": config, "seed": options.seed or 0}
    cli.call(measure_scene.make_rendered_scene, options, **given)


@cli.command(
    "capture check",
    cli.input_option("capture", "capture"),
    cli.set_option(
        *("pairs=30", "capture.depth_unit=5000"),
        configuration="splatpilot.training.captures.check:CheckConfig",
    ),
    cli.json_option("the report"),
    examples=("capture check data/office --set capture.depth_unit=5000 --json",),
)
def check(options: argparse.Namespace) -> Any:
    """Projects depth from frame to frame and compares. If it disagrees, tests the usual errors,
    names the most likely one, and exits with status 1. Without depth, it compares features with
    their epipolar lines."""
    cli.announce(f"checking {options.capture}")
    from splatpilot.training.captures import check

    report = check.run(capture=Path(options.capture), config=cli.read_config(options))
    if report.problem:
        raise cli.FailureWithResultError(f"{options.capture}: {report.problem}", report)
    return report


def _points(text: str) -> list[list[float]]:
    try:
        return [[float(x) for x in point.split(",")] for point in text.split()]
    except ValueError:
        raise ValueError(f"--path must be points X,Y,Z with spaces between, got {text!r}") from None


@cli.command(
    "capture render",
    cli.input_option("world", "mesh", "scenario"),
    cli.out_option("capture folder to write"),
    cli.Option('--path "X,Y,Z X,Y,Z ..."', "points on the camera's path [m]", resolve=_points),
    cli.UP,
    cli.SEED,
    cli.set_option(
        *("spacing=0.8", "highest=2.0", "offsets=[-0.5,0.5]"),
        configuration="splatpilot.training.captures.render:RenderConfig",
    ),
    examples=(
        "capture render warehouse.gltf --up z --out out/capture",
        'capture render P09 --seed 3 --out out/alley --path "0,0,1.5 8,0,1.5 8,6,1.5"',
    ),
)
def render(options: argparse.Namespace) -> None:
    """Writes a TartanAir V1 sequence. Without --path, poses are planned that see each surface
    around the free space from several directions."""
    cli.announce(f"rendering {options.world} to {options.out}")
    from splatpilot.training.captures import render

    config = cli.read_config(options, up=options.up, path=options.path)
    world, seed = Path(options.world), options.seed or 0
    cli.call(render.run, options, world=world, config=config, seed=seed)


_OUT = cli.out_option("folder of scenes (default: $SPLATPILOT_SCENES, or scenes)", required=False)


@cli.command(
    "library make",
    cli.Option("names", "hospital, ... (default: all with sources)", nargs="*", metavar="NAME"),
    cli.Option("--data", "folder of captures, meshes and maps (default: $SPLATPILOT_DATA)", Path),
    cli.Option("--split", "only this split", choices=("train", "validation", "test"), default=""),
    _OUT,
    cli.set_option(
        *("iterations=3000", "render.max_frames=100"),
        configuration="splatpilot.analysis.reconstruction.measure_scene:RenderedSceneConfig",
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
        return cli.call(environments.make, options, data=data, scenes=scenes)


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

    packed = cli.call(scene_downloads.pack, options, scenes=scenes_folder())
    for name, scene in packed.items():
        size = sum(file.bytes for file in scene.files.values())
        print(f"Wrote {options.out / name}, {size / 1e6:.1f} MB; license: {scene.license}")


@cli.command(
    "library get",
    cli.Option("names", "of scenes", nargs="+", metavar="NAME"),
    cli.Option("--from", "folder or URL of `library pack`", dest="source", required=True),
    _OUT,
    examples=("library get small_house --from out/packed",),
)
def get(options: argparse.Namespace) -> None:
    """Copies packed scenes from a folder or a file server, and checks their digests."""
    from splatpilot.analysis import scene_downloads

    cli.call(scene_downloads.get, options, scenes=options.out or scenes_folder())
