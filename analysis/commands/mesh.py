"""`splatpilot mesh`."""

import argparse
from pathlib import Path

from splatpilot.analysis.commands.options import add_overrides, add_overwrite, add_verb, find_place
from splatpilot.analysis.commands.view import scenario_defaults
from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.common.files import require_unused


def add_to(verbs: argparse._SubParsersAction) -> None:
    mesh = add_verb(
        verbs,
        "mesh",
        _mesh,
        help="write the surfaces of a scene, a map or a generated world as a mesh that collides",
        description="Writes what the distance field of a place calls solid as a closed mesh, for "
        "contact and distances in Drake (OBJ) and in other simulators and viewers (glTF, OBJ).",
        examples=(
            "mesh scenes/hospital --out hospital.obj",
            "mesh forest.bt --out forest.gltf",
            "mesh P04 --seed 3 --conservative --out rooms.obj",
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
