import numpy as np
import trimesh

import splatpilot as sp
from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.worlds.scene_folder import write_scene_folder


def test_a_scene_and_its_scenario_become_closed_meshes(tmp_path, capsys):
    file, scene, out = tmp_path / "small.yaml", tmp_path / "scene", tmp_path / "out/world.obj"
    file.write_text("world: {length: 9, width: 6}\n")
    world = sp.make_world(sp.load_config(sp.Scenario(), file).world, 0)
    write_scene_folder(scene, world, provenance="")
    for words in ([str(scene)], [str(file), "--seed", "0", "--overwrite"]):
        assert main(["scene", "mesh", *words, "--out", str(out)]) == 0
        mesh = trimesh.load(out, force="mesh")
        assert mesh.is_watertight
        assert f"{len(mesh.faces)} triangles" in capsys.readouterr().out
        lower, upper = world.esdf.lower_W + 0.2, world.esdf.upper_W - 0.2
        inside = ((mesh.vertices > lower) & (mesh.vertices < upper)).all(axis=1)
        off = world.distance_field.distance(mesh.vertices[inside])
        assert inside.sum() > 100
        assert np.abs(off).max() < 0.5 * world.esdf.voxel_size
