import json

import numpy as np
import pytest
import trimesh

import splatpilot as sp
from splatpilot.analysis import environments
from splatpilot.analysis.environments import INDEX, known_entries, read_index
from splatpilot.diagrams.scenarios import benchmark_scenarios, other_scenarios
from splatpilot.diagrams.worlds.scene_folder import SceneSource, read_scene_metadata
from splatpilot.diagrams.worlds.splits import load_test_sources


def test_entries_are_valid_and_those_of_scenarios_are_of_the_test_split():
    entries = known_entries()
    for entry in entries.values():
        entry.config().validate()
    flown = set(load_test_sources())
    for file in (benchmark_scenarios() | other_scenarios()).values():
        world = sp.load_config(sp.Scenario(), file).world
        if isinstance(world, SceneSource):
            flown.add(world.path)
            assert f"splatpilot library make {world.path}" in world.source
    assert {entries[name].split for name in flown} == {"test"}


def test_folder_of_data_adds_entries(tmp_path):
    (tmp_path / "worlds").mkdir()
    (tmp_path / "worlds/barn.glb").touch()
    (tmp_path / "worlds/shed.glb").touch()
    (tmp_path / "worlds/notes.txt").touch()
    for name in ("hall", "walk_1.5m", ".hall.partial"):
        (tmp_path / "captures" / name).mkdir(parents=True)
    for name in (".DS_Store", "README"):
        (tmp_path / "captures" / name).touch()
    (tmp_path / "environments.yaml").write_text(
        "barn: {source: worlds/barn.glb, split: test, settings: [render.up=z]}\n"
    )
    entries = known_entries(tmp_path)
    assert entries["barn"].config().render.up == "z" and entries["barn"].split == "test"
    assert entries["shed"].source == "worlds/shed.glb" and "notes" not in entries
    assert entries.keys() - known_entries().keys() == {"barn", "shed", "hall", "walk_1.5m"}
    (tmp_path / "environments.yaml").write_text("barn: {sauce: worlds/barn.glb}\n")
    with pytest.raises(ValueError, match=r"environments.yaml: barn: .*sauce"):
        known_entries(tmp_path)


@pytest.fixture
def data(tmp_path):
    mesh = trimesh.creation.box((7.0, 5.0, 3.0))
    mesh.invert()
    (tmp_path / "data/worlds").mkdir(parents=True)
    mesh.export(tmp_path / "data/worlds/room.obj", include_normals=True)
    settings = (
        *("render.up=z", "render.width=64", "render.height=48", "image_width=0"),
        *("render.path=[[-2, 0, 0], [2, 0, 0]]", "render.yaws=[0, 90, 180, -90]"),
        "initial_gaussians=20000",
    )
    entry = {"source": "worlds/room.obj", "split": "test", "settings": settings}
    (tmp_path / "data/environments.yaml").write_text(json.dumps({"room": entry}))
    return tmp_path / "data"


def test_an_environment_is_made_measured_recorded_and_shown(opengl, data, tmp_path, capsys):
    scenes = tmp_path / "scenes"
    arguments = {"names": ["room"], "data": data, "scenes": scenes, "overrides": ["iterations=20"]}
    (record,) = environments.make(**arguments)
    assert read_index(scenes) == {"room": record}
    room = scenes / "room"
    assert (room / "metrics.json").is_file() and (scenes / "captures/room").is_dir()
    assert read_scene_metadata(room).split == record.split == "test"
    assert record.feasible_seeds == 20 and record.reason == ""
    assert record.psnr_db and record.fidelity_bound is not None
    assert record.flown_depth_mae_m is not None and record.flown_depth_mae_m < 0.5
    np.testing.assert_allclose(record.size, [7, 5, 3], atol=1.5)

    written = (room / "gaussians.ply").read_bytes()
    capsys.readouterr()
    environments.make(**arguments)
    assert "is recorded already" in capsys.readouterr().out
    (scenes / INDEX).unlink()
    environments.make(**arguments)
    assert "is reconstructed already" in capsys.readouterr().out
    assert (room / "gaussians.ply").read_bytes() == written

    environments.show(scenes=scenes)
    assert "room" in capsys.readouterr().out
    assert (scenes / "library.csv").is_file() and (scenes / "library.png").is_file()


def test_missing_inputs_are_reported_first(tmp_path):
    out = tmp_path / "scenes"
    for names, data, error, words in (
        (["nowhere"], tmp_path, ValueError, "no environment 'nowhere'; there are hospital"),
        (["hospital"], None, FileNotFoundError, "No such file.*DATA/tartanair/hospital"),
        ([], tmp_path / "empty", ValueError, "sources are in .*empty must be one or more"),
        (["bookstore"], tmp_path, FileNotFoundError, "No such file.*worlds/bookstore.gltf"),
    ):
        with pytest.raises(error, match=words):
            environments.make(names=names, data=data, scenes=out, split="validation" * (not names))
    with pytest.raises(ValueError, match=r"library\.json must be an index, got none"):
        environments.show(scenes=out)
    assert not out.exists()
    (tmp_path / INDEX).write_text('{"room": {"name": "room"}}')
    with pytest.raises(ValueError, match=r"library\.json: .*delete the file"):
        read_index(tmp_path)
