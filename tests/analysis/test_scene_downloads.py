import contextlib
import functools
import http.server
import json
import re
import threading
from dataclasses import asdict

import numpy as np
import pytest

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.environments import INDEX, Record
from splatpilot.diagrams.worlds.scene_folder import (
    read_scene,
    read_scene_metadata,
    write_scene_folder,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.scene import GaussianScene


@pytest.fixture
def world() -> World:
    rng = np.random.default_rng(0)
    gaussians = GaussianScene(
        rng.uniform(0, 3, (50, 3)).astype(np.float32),
        rng.normal(size=(50, 4)).astype(np.float32),
        rng.uniform(0.01, 0.3, (50, 3)).astype(np.float32),
        rng.uniform(0.1, 1.0, 50).astype(np.float32),
        rng.uniform(-1, 1, (50, 4, 3)).astype(np.float32),
    )
    distances = rng.uniform(0, 2, (6, 6, 6)).astype(np.float32)
    esdf = Esdf(distances, np.zeros((6, 6, 6), np.uint8), np.zeros(3), 0.5)
    sky = EnvironmentMap(np.full((8, 16, 3), 0.5, np.float32))
    return World("shed", gaussians, esdf, esdf, sky, np.ones(3), 2 * np.ones(3))


@pytest.fixture
def scenes(tmp_path, monkeypatch, world):
    """A folder of scenes with an index; `shed` is free, `lab` is not, and `wood` is an OctoMap."""
    folder = tmp_path / "scenes"
    capture = str(tmp_path / "captures/shed")
    made_of = f"TUM sequence {capture}, 9 frames"
    write_scene_folder(folder / "shed", world, provenance=made_of, capture=capture)
    known = {"split": "train", "digest": [], "made_of": "", "size": [3.0, 3.0, 3.0]}
    known |= {"free_volume": 27.0, "outdoor": False, "gaussians": 50, "source": "worlds/shed.glb"}
    records = [
        Record(name="shed", license="MIT-0", path="", **known),
        Record(name="lab", license="Research (non-commercial)", path="", **known),
        Record(name="wood", license="BSD-3-Clause", path="wood.bt", **known),
    ]
    index = {record.name: asdict(record) for record in records}
    (folder / INDEX).write_text(json.dumps(index))
    monkeypatch.setenv("SPLATPILOT_SCENES", str(folder))
    return folder


@contextlib.contextmanager
def served(folder):
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def run(line: str, *arguments: object) -> int:
    return main([*line.split(), *map(str, arguments)])


def test_packed_scene_is_got_from_a_server_and_is_the_same_scene(scenes, world, tmp_path, capsys):
    packed, got = tmp_path / "packed", tmp_path / "got"
    assert run("library pack shed --out", packed) == 0
    with served(packed) as url:
        assert run("library get shed --out", got, "--from", url) == 0
    assert "license: MIT-0" in capsys.readouterr().out
    found = read_scene(got / "shed")
    order = [int(np.abs(found.gaussians.means - p).sum(1).argmin()) for p in world.gaussians.means]
    assert len(set(order)) == 50
    np.testing.assert_allclose(found.gaussians.means[order], world.gaussians.means, atol=2e-4)
    np.testing.assert_allclose(found.gaussians.sh[order], world.gaussians.sh, atol=0.014)
    lower = world.esdf.distances - found.esdf.distances
    assert (lower >= 0).all() and lower.max() <= 1e-3
    assert isinstance(found.background, EnvironmentMap)
    metadata = read_scene_metadata(got / "shed")
    assert metadata.provenance == "TUM sequence worlds/shed.glb, 9 frames; license MIT-0"
    assert str(tmp_path) not in (got / "shed/scene.yaml").read_text()
    # Again, and from the folder itself: nothing is written.
    before = (got / "shed").stat().st_mtime_ns
    assert run("library get shed --out", got, "--from", packed) == 0
    assert "is there already" in capsys.readouterr().out
    assert (got / "shed").stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lab", "license of lab must be a free one"),
        ("wood", "wood must be a scene folder"),
        ("shack", "there is no scene in .* 'shack'"),
    ],
)
def test_scenes_that_cannot_be_shared_are_not_packed(scenes, tmp_path, capsys, name, message):
    assert run("library pack", name, "--out", tmp_path / "packed") != 0
    assert re.search(message, capsys.readouterr().err)


def test_damaged_and_foreign_scenes_are_refused(scenes, tmp_path, capsys):
    packed, got = tmp_path / "packed", tmp_path / "got"
    run("library pack shed --out", packed)
    command = ("library get shed --out", got, "--from", packed)
    content = (packed / "shed/esdf.npz").read_bytes()
    for damaged, message in (
        (content[:-1] + bytes([content[-1] ^ 1]), "digest of"),
        (content + b"x", "at most"),
    ):
        (packed / "shed/esdf.npz").write_bytes(damaged)
        assert run(*command) != 0 and message in capsys.readouterr().err
        assert not (got / "shed").exists()
    (packed / "shed/esdf.npz").unlink()
    assert run(*command) != 0 and "cannot read file:" in capsys.readouterr().err
    (got / "shed").mkdir()
    assert run(*command) != 0 and "choose another --out" in capsys.readouterr().err
    listed = (packed / "scenes.json").read_text()
    for changed in (listed.replace('"shed"', '"../shed"'), listed.replace("esdf.npz", "../x"), "["):
        (packed / "scenes.json").write_text(changed)
        assert run(*command) != 0 and "not a list of scenes" in capsys.readouterr().err
