"""`splatpilot scene mesh`: a place as a mesh that bodies collide with."""

from collections.abc import Sequence
from pathlib import Path

from splatpilot.analysis.view import generated_scenario
from splatpilot.diagrams.worlds.scene_folder import read_scene_folder
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.field_mesh import field_mesh, require_mesh_name, write_mesh


def run(
    *, what: str, out: Path, conservative: bool, seed: int | None, overrides: Sequence[str]
) -> None:
    """
    Writes the surfaces of a place and prints how many triangles they take.

    Args:
        what: a scene folder, an OctoMap or a scenario.
        out: file to write, `.obj` or `.gltf`.
        conservative: see `field_mesh`.
        seed: of a generated world; that of its scenario if None.
        overrides: FIELD=VALUE of the scenario.

    Raises:
        ValueError: for another kind of file or place, or a place without surfaces.
        OSError: if the place cannot be read or the mesh not be written.
    """
    require_mesh_name(out)
    esdf = _field(what, seed, overrides)
    mesh = field_mesh(esdf, conservative)
    write_mesh(out, mesh)
    size = " x ".join(f"{extent:.1f}" for extent in mesh.extents)
    print(f"Wrote {out}: {len(mesh.faces)} triangles, {size} m, within {esdf.voxel_size / 2:g} m")


def _field(what: str, seed: int | None, overrides: Sequence[str]) -> Esdf:
    path = Path(what)
    if not (path / "scene.yaml").is_file():
        scenario = None if path.is_dir() else generated_scenario(path, seed, overrides)
        if scenario is None:
            raise ValueError(
                f"{what}: what is no scene folder, OctoMap or scenario has no distances; "
                "reconstruct it first"
            )
        scenario.validate()
        return make_world(scenario.world, scenario.seed).esdf
    if seed is not None or overrides:
        raise ValueError(
            f"{what}: a finished scene has neither a seed nor settings; leave them out"
        )
    return read_scene_folder(path).esdf
