import pytest
import trimesh

from splatpilot.analysis import scenes
from splatpilot.analysis.scenes import BENCHMARK_SCENES, RECIPES, default_config
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios, other_scenarios
from splatpilot.diagrams.worlds.scene_folder import SceneSource, read_scene_metadata
from splatpilot.systems.common.config import load_config


def scenes_of(files):
    worlds = [load_config(Scenario(), file).world for file in files.values()]
    return {world.path for world in worlds if isinstance(world, SceneSource)}


def test_every_scene_of_a_scenario_has_a_recipe():
    assert scenes_of(benchmark_scenarios()) == set(BENCHMARK_SCENES)
    assert scenes_of(other_scenarios()) <= set(RECIPES)
    for _, *settings in RECIPES.values():
        load_config(default_config(), overrides=settings).validate()
    for file in (benchmark_scenarios() | other_scenarios()).values():
        world = load_config(Scenario(), file).world
        if isinstance(world, SceneSource):
            assert f"splatpilot scene fetch {world.path}" in world.source


def test_a_scene_is_made_once_and_measured_again(opengl, tmp_path, capsys, monkeypatch):
    mesh = trimesh.creation.box((7.0, 5.0, 3.0))
    mesh.invert()
    (tmp_path / "data/worlds").mkdir(parents=True)
    mesh.export(tmp_path / "data/worlds/room.obj", include_normals=True)
    settings = (
        "render.up=z",
        "render.width=64",
        "render.height=48",
        "render.path=[[-2, 0, 0], [2, 0, 0]]",
        "render.yaws=[0, 90, 180, -90]",
        "image_width=0",
        "initial_gaussians=2000",
    )
    monkeypatch.setitem(RECIPES, "room", ("worlds/room.obj", *settings))
    arguments = {
        "names": ["room"],
        "data": tmp_path / "data",
        "scenes": tmp_path / "scenes",
        "overrides": ["iterations=20"],
    }
    scenes.run(**arguments)
    room = tmp_path / "scenes/room"
    written = (room / "gaussians.ply").read_bytes()
    assert (room / "metrics.json").is_file() and (tmp_path / "scenes/captures/room").is_dir()
    assert read_scene_metadata(room).split == "test"

    (room / "metrics.json").unlink()
    capsys.readouterr()
    scenes.run(**arguments)
    assert "is complete already" in capsys.readouterr().out
    assert (room / "metrics.json").is_file()
    scenes.run(**arguments)
    assert "is reconstructed already" in capsys.readouterr().out
    assert (room / "gaussians.ply").read_bytes() == written


def test_missing_inputs_are_reported_first(tmp_path):
    out = tmp_path / "scenes"
    for names, data, error, words in (
        (["nowhere"], tmp_path, ValueError, "no scene 'nowhere'; there are hospital"),
        (["forest_splat", "hospital"], None, ValueError, "No folder with tartanair/hospital; give"),
        (["bookstore"], tmp_path, FileNotFoundError, "No such file.*worlds/bookstore.gltf"),
    ):
        with pytest.raises(error, match=words):
            scenes.run(names=names, data=data, scenes=out)
    assert not out.exists()
