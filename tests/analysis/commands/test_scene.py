import numpy as np
import pytest
import trimesh

from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.scene_folder import write_scene_folder
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.config import load_config

SMALL = ["world.length=9", "world.width=6"]


@pytest.fixture(scope="module")
def world():
    scenario = load_config(Scenario(), overrides=SMALL)
    return make_world(scenario.world, 0)


@pytest.mark.parametrize("kind", ["scene", "scenario"])
def test_a_scene_and_its_scenario_become_closed_meshes(kind, world, tmp_path, capsys):
    out = tmp_path / "out" / "world.obj"
    if kind == "scene":
        write_scene_folder(tmp_path / "scene", world, provenance="")
        words = [str(tmp_path / "scene")]
    else:
        (tmp_path / "small.yaml").write_text("world: {length: 9, width: 6}\n")
        words = [str(tmp_path / "small.yaml"), "--seed", "0"]
    assert main(["scene", "mesh", *words, "--out", str(out)]) == 0
    mesh = trimesh.load(out, force="mesh")
    assert mesh.is_watertight
    assert f"{len(mesh.faces)} triangles" in capsys.readouterr().out
    inside = np.all(
        (mesh.vertices > world.esdf.lower_W + 0.2) & (mesh.vertices < world.esdf.upper_W - 0.2),
        axis=1,
    )
    off = world.distance_field.distance(mesh.vertices[inside])
    assert inside.sum() > 100
    assert np.abs(off).max() < 0.5 * world.esdf.voxel_size
