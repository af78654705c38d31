"""`splatpilot scene`: work on finished scenes."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands import options as cli
from splatpilot.analysis.commands.flight import WORLD_FIELDS
from splatpilot.systems.common.extras import import_extra

_AXES = "x", "-x", "y", "-y", "z", "-z"


def _point(text: str) -> list[float]:
    try:
        x, y, z = (float(each) for each in text.split(","))
    except ValueError:
        raise ValueError(f"points must be X,Y,Z, got {text!r}") from None
    return [x, y, z]


@cli.command(
    "scene scale",
    cli.path_option("scene", "a scene folder or a file of Gaussians", "scene", "gaussians"),
    cli.out_option("scene folder, or PLY, SPZ, glTF or USD file, to write"),
    cli.Option("--up", "axis of a file that points up (z)", choices=_AXES),
    cli.Option(
        "--floor X,Y,Z",
        "points of the floor in a file, to level it at z = 0",
        nargs=3,
        resolve=_point,
        default=[],
    ),
    cli.Option("--factor", "length of a unit of the scene [m]", float, exclusive=True),
    cli.Option(
        "--between X,Y,Z",
        "two points of the scene, as the ruler of `splatpilot view` gives them",
        nargs=2,
        resolve=_point,
        exclusive=True,
        default=[],
    ),
    cli.Option("--height", "of the capture's cameras, median [m]", float, exclusive=True),
    cli.Option("--distance", "true length between these points [m]", float),
    examples=(
        "scene scale scenes/room --out scenes/room_metric --between 0,0,1 2,0,1 --distance 3.2",
        "scene scale garden.ply --out level.ply --up -y --floor 0,1.1,2 1,1.2,2 0,0.9,3",
    ),
)
def scale(options: argparse.Namespace) -> None:
    """Writes a scene again with all lengths times one factor, so that scenes of photographs, whose
    scale is unknown, can be flown in. Of a file of Gaussians it writes a PLY, SPZ, glTF or USD
    file in meters with z up (of glTF: y)."""
    if bool(options.between) == (options.distance is None):
        raise ValueError("--between and --distance belong together: two points and the meters")
    given = options.factor, options.height, options.up
    if not options.between and not options.floor and given == (None, None, None):
        raise ValueError("what is its size? Give --factor, --between with --distance, or --height")
    from splatpilot.analysis.reconstruction import rescale

    cli.call(rescale.run, options)


@cli.command(
    "scene measure",
    cli.path_option("scene", "a scene folder", "scene"),
    cli.OVERWRITE,
    examples=("scene measure scenes/room_metric",),
)
def measure(options: argparse.Namespace) -> None:
    """Writes metrics.json (PSNR, SSIM, LPIPS, depth errors, floaters) and views.png into a scene
    folder. `splatpilot reconstruct` has written them already."""
    cli.announce(f"measuring {options.scene}")
    from splatpilot.analysis.reconstruction import measure_scene

    cli.call(measure_scene.run, options)


@cli.command(
    "scene mesh",
    cli.input_option("what", "scene", "map", "scenario"),
    cli.out_option("file to write: .obj or .gltf", unused=True),
    cli.flag("--conservative", "unknown space and outside of the bounds are solid"),
    cli.SEED,
    cli.OVERWRITE,
    WORLD_FIELDS,
    examples=(
        "scene mesh scenes/hospital --out hospital.obj",
        "scene mesh P04 --seed 3 --conservative --out rooms.gltf",
    ),
)
def mesh(options: argparse.Namespace) -> None:
    """Writes the zero level of a distance field as a closed mesh, for contact and distances in
    Drake (OBJ) and in other simulators and viewers (glTF, OBJ)."""
    import_extra("manifold3d", "mesh")
    from splatpilot.analysis.view import generated_scenario
    from splatpilot.diagrams.worlds.scene_folder import read_scene_folder
    from splatpilot.diagrams.worlds.world_registry import make_world
    from splatpilot.systems.collision.field_mesh import field_mesh, require_mesh_name, write_mesh

    require_mesh_name(options.out)
    what = Path(options.what)
    scenario = generated_scenario(what, options.seed, options.overrides)
    if scenario is not None:
        scenario.validate()
        esdf = make_world(scenario.world, scenario.seed).esdf
    elif not (what / "scene.yaml").is_file():
        raise ValueError(
            f"{what} must be a scene folder, OctoMap or scenario, which have distances; "
            "reconstruct it first"
        )
    elif options.overrides:
        raise ValueError(f"--set must be of a scenario, got {options.overrides[0]}; leave it out")
    else:
        esdf = read_scene_folder(what).esdf
    made = field_mesh(esdf, options.conservative)
    write_mesh(options.out, made)
    size = " x ".join(f"{extent:.1f}" for extent in made.extents)
    print(
        f"Wrote {options.out}: {len(made.faces)} triangles, {size} m, within "
        f"{esdf.voxel_size / 2:g} m"
    )


@cli.command(
    "scene ablate",
    cli.input_option("captures", "capture", "scene", nargs="+", metavar="CAPTURE"),
    cli.out_option("output folder", "out/ablation"),
    cli.OVERWRITE,
    cli.set_option(
        *("iterations=3000", "image_width=320"),
        configuration="splatpilot.training.reconstruction.config:ReconstructConfig",
    ),
    examples=("scene ablate data/hospital data/office --set iterations=500",),
)
def ablate(options: argparse.Namespace) -> None:
    """Extends the paper's ablation: reconstructs each capture as 3DGS and as 2DGS from points, from
    depth, with the surface and outline losses, and with the depth term, measures them, and writes a
    table and pictures. If interrupted, the same command resumes."""
    cli.announce(f"reconstructing {len(options.captures)} captures in every arm in {options.out}")
    from splatpilot.analysis.reconstruction import ablation

    captures = [Path(capture) for capture in options.captures]
    cli.call(ablation.run, options, captures=captures, config=cli.read_config(options))


@cli.command(
    "scene fidelity",
    cli.path_option("scenes", "a scene folder", "scene", nargs="+", metavar="SCENE"),
    cli.out_option("output folder", "out/fidelity"),
    cli.OVERWRITE,
    cli.set_option(
        "max_depth_error=0.03",
        configuration="splatpilot.analysis.reconstruction.fidelity:FidelityConfig",
    ),
    examples=("scene fidelity scenes/hospital scenes/warehouse --out out/fidelity",),
)
def fidelity(options: argparse.Namespace) -> None:
    """Renders scenes from poses off their captures' paths, compares with the truth or, without it,
    with other frames, and writes the trusted distance from the path into each scene.yaml."""
    cli.announce(f"comparing views off the path of {len(options.scenes)} scenes in {options.out}")
    from splatpilot.analysis.reconstruction import fidelity

    cli.call(fidelity.run, options, config=cli.read_config(options))


@cli.command(
    "scene twin",
    cli.path_option(
        "scenes", "a scene folder of a rendered capture", "scene", nargs="+", metavar="SCENE"
    ),
    cli.out_option("output folder", "out/twin"),
    cli.JOBS,
    cli.set_option(
        *("routes=10", "repeat_radius=0.05"),
        configuration="splatpilot.analysis.twin:TwinConfig",
    ),
    examples=("scene twin scenes/small_house scenes/cafe", "scene twin scenes/cafe --set routes=5"),
)
def twin(options: argparse.Namespace) -> None:
    """Flies policies in scenes and, from the same starts to the same goals, in the meshes that
    their captures were rendered of, and writes how well success in the one predicts success in the
    other. If interrupted, the same command resumes."""
    cli.announce(f"flying in {len(options.scenes)} scenes and their meshes in {options.out}")
    from splatpilot.analysis import twin as twins

    cli.call(twins.run, options, config=cli.read_config(options))


@cli.command(
    "gap",
    cli.path_option(
        "scenes", "a scene folder with its capture", "scene", nargs="+", metavar="SCENE"
    ),
    cli.out_option("output folder", "out/gap"),
    cli.OVERWRITE,
    cli.set_option(
        *("'policies=[distilled_rgb, mine.npz]'", "viewpoints=60"),
        configuration="splatpilot.analysis.gap:GapConfig",
    ),
    cli.json_option("the table"),
    examples=("gap scenes/redkitchen scenes/hospital",),
)
def gap(options: argparse.Namespace) -> Any:
    """Asks policies for plans by the real images of captures and by renderings from the same poses,
    and in generated worlds, and compares how many plans are clear of obstacles."""
    cli.announce(f"comparing plans in {len(options.scenes)} scenes in {options.out}")
    from splatpilot.analysis import gap as gaps

    return cli.call(gaps.run, options, config=cli.read_config(options))
