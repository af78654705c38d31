"""`splatpilot scene mesh`: surfaces of environments as meshes for collisions."""

from collections.abc import Sequence
from pathlib import Path

from splatpilot.analysis.view import generated_scenario
from splatpilot.diagrams.worlds.scene_folder import read_scene_folder
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.field_mesh import field_mesh, require_mesh_name, write_mesh


def run(
    *, what: str, out: Path, conservative: bool, seed: int | None, overrides: Sequence[str]
) -> None:
    """Writes the surfaces of an environment and prints their number of triangles.

    Args:
        what: a scene folder, an OctoMap or a scenario.
        out: file to write, `.obj` or `.gltf`.
        conservative: see `field_mesh`.
        seed: of a generated world; that of its scenario if None.
        overrides: FIELD=VALUE of the scenario.
    """
    require_mesh_name(out)
    scenario = generated_scenario(Path(what), seed, overrides)
    if scenario is not None:
        scenario.validate()
        esdf = make_world(scenario.world, scenario.seed).esdf
    elif not (Path(what) / "scene.yaml").is_file():
        raise ValueError(
            f"{what} must be a scene folder, OctoMap or scenario, which have distances; "
            "reconstruct it first"
        )
    elif overrides:
        raise ValueError(f"--set must be of a scenario, got {overrides[0]}; leave it out")
    else:
        esdf = read_scene_folder(Path(what)).esdf
    mesh = field_mesh(esdf, conservative)
    write_mesh(out, mesh)
    size = " x ".join(f"{extent:.1f}" for extent in mesh.extents)
    print(f"Wrote {out}: {len(mesh.faces)} triangles, {size} m, within {esdf.voxel_size / 2:g} m")
