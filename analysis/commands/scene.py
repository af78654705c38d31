"""`splatpilot scene`: work on finished scenes."""

import argparse
import re
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import (
    add_overrides,
    add_overwrite,
    add_verb,
    check_kind,
    find_place,
)
from splatpilot.analysis.commands.view import scenario_defaults
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import (
    data_folder,
    require_existing,
    require_unused,
    scenes_folder,
)


def add_to(verbs: argparse._SubParsersAction) -> None:
    scene = add_verb(
        verbs,
        "scene",
        None,
        help="scale, measure, export, compare or fetch scenes",
        description="Works on scenes that `splatpilot reconstruct` has made.",
        examples=("scene fetch hospital", "scene scale scenes/a --out scenes/b --height 1.5"),
    )
    actions = scene.add_subparsers(required=True, metavar="ACTION")
    for add in (_add_scale, _add_measure, _add_mesh, _add_ablate, _add_fidelity, _add_fetch):
        add(actions)


def _add_scale(verbs: argparse._SubParsersAction) -> None:
    scale = add_verb(
        verbs,
        "scale",
        _scale,
        help="give a scene its size: by a factor, a measured length, or the cameras' height",
        description="Writes the scene anew with all its lengths times one factor. A scene of "
        "photographs alone, whose scale is unknown, can be flown in then. Of a file of "
        "Gaussians it writes a PLY in meters with z up.",
        examples=(
            "scene scale scenes/room --out scenes/room_metric --height 1.5",
            "scene scale scenes/room --out scenes/room_metric --between 0,0,1 2,0,1 --distance 3.2",
            "scene scale garden.ply --out level.ply --up -y --floor 0,1.1,2 1,1.2,2 0,0.9,3",
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
        raise ValueError("--between and --distance belong together: two points and the meters")
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


def _add_measure(verbs: argparse._SubParsersAction) -> None:
    measure = add_verb(
        verbs,
        "measure",
        _measure,
        help="compare a scene with the frames of its capture that were held out",
        description="Writes metrics.json (PSNR, SSIM, LPIPS, depth errors, floaters) and views.png "
        "into a scene folder. One that `splatpilot reconstruct` has finished has them already.",
        examples=("scene measure scenes/room_metric", "scene measure scenes/hospital --overwrite"),
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


def _add_mesh(verbs: argparse._SubParsersAction) -> None:
    mesh = add_verb(
        verbs,
        "mesh",
        _mesh,
        help="write the surfaces of a scene, a map or a generated world as a mesh that collides",
        description="Writes what the distance field of a place calls solid as a closed mesh, for "
        "contact and distances in Drake (OBJ) and in other simulators and viewers (glTF, OBJ).",
        examples=(
            "scene mesh scenes/hospital --out hospital.obj",
            "scene mesh forest.bt --out forest.gltf",
            "scene mesh P04 --seed 3 --conservative --out rooms.obj",
        ),
    )
    mesh.add_argument("what", help="scene folder, OctoMap (.bt), or a scenario: P02 or a file")
    mesh.add_argument("--out", type=Path, required=True, help="file to write: .obj or .gltf")
    mesh.add_argument(
        "--conservative",
        action="store_true",
        help="unknown space and all outside the bounds are solid too, as they are for vehicles",
    )
    mesh.add_argument("--seed", type=int, help="seed of a generated world")
    add_overwrite(mesh)
    add_overrides(mesh, ("world.spacing=2.4", "world.height=8"), scenario_defaults)


def _mesh(options: argparse.Namespace) -> None:
    options.what = str(find_place(Path(options.what), "scene", "map", "scenario"))
    require_unused(options.out, options.overwrite)
    import_extra("manifold3d", "mesh")
    from splatpilot.analysis import mesh

    mesh.run(
        what=options.what,
        out=options.out,
        conservative=options.conservative,
        seed=options.seed,
        overrides=list(options.overrides),
    )


def _add_ablate(verbs: argparse._SubParsersAction) -> None:
    ablate = add_verb(
        verbs,
        "ablate",
        _ablate,
        help="reconstruct captures with more and more use of depth, as 3DGS and 2DGS, and compare",
        description="Extends the paper's ablation: reconstructs each capture as 3DGS and as 2DGS "
        "from points, from depth, with the surface and outline losses, and with the depth term, "
        "measures them, and writes a table and pictures. Interrupted, the same command resumes.",
        examples=(
            "scene ablate data/hospital --out out/ablation",
            "scene ablate data/hospital data/office --set iterations=500",
        ),
    )
    ablate.add_argument(
        "captures", type=Path, nargs="+", metavar="CAPTURE", help="folder of a capture, or a scene"
    )
    ablate.add_argument(
        "--out", type=Path, default=Path("out/ablation"), help="output folder (%(default)s)"
    )
    add_overwrite(ablate)
    add_overrides(ablate, ("iterations=3000", "image_width=320"), _ablate_defaults)


def _ablate_defaults(options: argparse.Namespace) -> Any:
    from splatpilot.training.reconstruction.config import ReconstructConfig

    return ReconstructConfig()


def _ablate(options: argparse.Namespace) -> None:
    options.captures = [find_place(path, "capture", "scene") for path in options.captures]
    from splatpilot.systems.common.progress import say

    say(f"reconstructing {len(options.captures)} captures in every arm in {options.out}")
    from splatpilot.analysis.reconstruction import ablation
    from splatpilot.systems.common.config import load_config

    config = load_config(_ablate_defaults(options), overrides=options.overrides)
    ablation.run(options.captures, options.out, config, options.overwrite)


def _add_fidelity(verbs: argparse._SubParsersAction) -> None:
    fidelity = add_verb(
        verbs,
        "fidelity",
        _fidelity,
        help="measure how far from its capture's path a scene can be trusted",
        description="Renders scenes from beside their captures' paths, compares with the truth "
        "where there is one and with other frames elsewhere, and writes how far a camera may "
        "leave the path into each scene.yaml.",
        examples=(
            "scene fidelity scenes/hospital",
            "scene fidelity scenes/hospital scenes/warehouse --out out/fidelity",
        ),
    )
    fidelity.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="scene folder")
    fidelity.add_argument(
        "--out", type=Path, default=Path("out/fidelity"), help="output folder (%(default)s)"
    )
    add_overwrite(fidelity)
    add_overrides(fidelity, ("max_depth_error=0.03",), _fidelity_defaults)


def _fidelity_defaults(options: argparse.Namespace) -> Any:
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

    config = load_config(_fidelity_defaults(options), overrides=options.overrides)
    fidelity.run(options.scenes, options.out, config, overwrite=options.overwrite)


def _add_fetch(verbs: argparse._SubParsersAction) -> None:
    fetch = add_verb(
        verbs,
        "fetch",
        _fetch,
        help="make the scenes of the benchmark's photorealistic scenarios",
        description="Renders what was not captured, reconstructs it, and leaves scene folders "
        "where scenarios look for them. Interrupted, the same command goes on.",
        examples=("scene fetch --data data", "scene fetch forest_splat --out scenes"),
    )
    fetch.add_argument(
        "names", nargs="*", metavar="NAME", help="hospital, bookstore, ... (default: R13 to R17)"
    )
    fetch.add_argument(
        "--data", type=Path, help="folder of captures and meshes (default: $SPLATPILOT_DATA)"
    )
    fetch.add_argument(
        "--out", type=Path, help="folder of scenes (default: $SPLATPILOT_SCENES, or scenes)"
    )
    add_overrides(fetch, ("iterations=3000", "render.spacing=1"), _fetch_defaults)


def _fetch_defaults(options: argparse.Namespace) -> Any:
    from splatpilot.analysis.scenes import default_config

    return default_config()


def _fetch(options: argparse.Namespace) -> None:
    data = options.data or data_folder()
    if data is not None:
        require_existing(data, "the folder of captures and meshes")
    from splatpilot.systems.common.progress import resumable, say

    scenes = options.out or scenes_folder()
    say(f"making {', '.join(options.names) or 'the scenes of the benchmark'} in {scenes}")
    from splatpilot.analysis import scenes as recipes

    with resumable(lambda: f"scenes that are finished are in {scenes}; the same command resumes"):
        recipes.run(
            names=options.names,
            data=data,
            scenes=scenes,
            overrides=options.overrides,
        )
