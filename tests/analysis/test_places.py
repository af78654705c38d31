"""The places of the photorealistic scenarios."""

import pytest
import trimesh

from splatpilot.analysis import places
from splatpilot.analysis.places import BENCHMARK_PLACES, PLACES, Place, PlaceConfig
from splatpilot.diagrams.flight.scenario import Scenario, benchmark_scenarios, other_scenarios
from splatpilot.diagrams.worlds.scene_folder import SceneSource, read_scene_metadata
from splatpilot.systems.common.config import load_config


def scenes_of(files):
    worlds = [load_config(Scenario(), file).world for file in files.values()]
    return {world.path for world in worlds if isinstance(world, SceneSource)}


def test_scenarios_fly_in_the_places():
    """The benchmark's scenes are the benchmark's places, the others' are places too, and what a
    scenario says of an absent one names the command that makes it."""
    assert scenes_of(benchmark_scenarios()) == set(BENCHMARK_PLACES)
    assert scenes_of(other_scenarios()) <= set(PLACES)
    for place in PLACES.values():
        load_config(PlaceConfig(), overrides=list(place.settings)).reconstruct.validate()
    for file in (benchmark_scenarios() | other_scenarios()).values():
        world = load_config(Scenario(), file).world
        if isinstance(world, SceneSource):
            assert f"splatpilot places {world.path}" in world.source


def test_a_place_is_made_and_then_left_as_it_is(opengl, tmp_path, capsys, monkeypatch):
    """From a mesh in the folder of data comes a measured scene; run again, it stays, and without
    its measures it is measured again."""
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
        "reconstruct.image_width=0",
        "reconstruct.initial_gaussians=2000",
    )
    monkeypatch.setitem(PLACES, "room", Place("worlds/room.obj", settings))
    arguments = {
        "names": ["room"],
        "data": tmp_path / "data",
        "scenes": tmp_path / "scenes",
        "overrides": ["reconstruct.iterations=20"],
    }
    places.run(**arguments)
    room = tmp_path / "scenes/room"
    written = (room / "gaussians.ply").read_bytes()
    assert (room / "metrics.json").is_file() and (tmp_path / "scenes/captures/room").is_dir()
    assert read_scene_metadata(room).split == "test"

    (room / "metrics.json").unlink()
    capsys.readouterr()
    places.run(**arguments)
    assert "is rendered already" in capsys.readouterr().out
    assert (room / "metrics.json").is_file()
    places.run(**arguments)
    assert "is reconstructed already" in capsys.readouterr().out
    assert (room / "gaussians.ply").read_bytes() == written


def test_what_is_missing_is_named_before_anything_is_made(tmp_path):
    """An unknown place, no folder of data, and a file that is not there are told first."""
    scenes = tmp_path / "scenes"
    for names, data, error, words in (
        (["nowhere"], tmp_path, ValueError, "no place 'nowhere'; there are hospital"),
        (["forest_splat", "hospital"], None, ValueError, "tartanair/hospital is needed; name"),
        (["bookstore"], tmp_path, FileNotFoundError, "worlds/bookstore.gltf: does not exist"),
    ):
        with pytest.raises(error, match=words):
            places.run(names=names, data=data, scenes=scenes)
    assert not scenes.exists()
