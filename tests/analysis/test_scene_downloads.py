import functools
import http.server
import json
import re
import threading
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from baked_scenes import random_scene

import splatpilot as sp
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.environments import INDEX, Record
from splatpilot.diagrams.worlds.scene_folder import (
    read_scene,
    read_scene_metadata,
    write_scene_folder,
)
from splatpilot.systems.splats.background import EnvironmentMap


@pytest.fixture
def world() -> sp.World:
    rng = np.random.default_rng(0)
    distances = rng.uniform(0, 2, (6, 6, 6)).astype(np.float32)
    esdf = sp.Esdf(distances, np.zeros((6, 6, 6), np.uint8), np.zeros(3), 0.5)
    sky = EnvironmentMap(np.full((8, 16, 3), 0.5, np.float32))
    gaussians, ends = random_scene(50, sh_degree=1), np.outer([1.0, 2.0], np.ones(3))
    return sp.World("shed", gaussians, esdf, esdf, sky, *ends)


@pytest.fixture
def run(tmp_path, monkeypatch, world):
    """Runs a command in a folder with scenes: `shed` is free, `lab` is not, `wood` is an OctoMap;
    returns its errors."""
    capture = str(tmp_path / "captures/shed")
    made_of = f"TUM sequence {capture}, 9 frames"
    write_scene_folder(tmp_path / "shed", world, provenance=made_of, capture=capture)
    known = {"split": "train", "digest": [], "made_of": "", "size": [3.0, 3.0, 3.0]}
    known |= {"free_volume": 27.0, "outdoor": False, "gaussians": 50, "source": "worlds/shed.glb"}
    licenses = {"shed": "MIT-0", "lab": "Research (non-commercial)", "wood": "BSD-3-Clause"}
    records = [
        Record(name=name, license=text, path="wood.bt" if name == "wood" else "", **known)
        for name, text in licenses.items()
    ]
    (tmp_path / INDEX).write_text(json.dumps({record.name: asdict(record) for record in records}))
    monkeypatch.setenv("SPLATPILOT_SCENES", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    return lambda line: main(line.split())


def test_packed_scene_is_got_from_a_server_and_is_the_same_scene(run, world, tmp_path, capsys):
    assert run("library pack shed --out packed") == 0
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory="packed")
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        assert run(f"library get shed --out got --from {url}") == 0
        server.shutdown()
    assert "license: MIT-0" in capsys.readouterr().out
    found, metadata = read_scene(Path("got/shed")), read_scene_metadata(Path("got/shed"))
    order = [int(np.abs(found.gaussians.means - p).sum(1).argmin()) for p in world.gaussians.means]
    assert len(set(order)) == 50
    np.testing.assert_allclose(found.gaussians.means[order], world.gaussians.means, atol=2e-4)
    np.testing.assert_allclose(found.gaussians.sh[order], world.gaussians.sh, atol=0.014)
    lower = world.esdf.distances - found.esdf.distances
    assert (lower >= 0).all() and lower.max() <= 1e-3
    assert isinstance(found.background, EnvironmentMap)
    assert metadata.provenance == "TUM sequence worlds/shed.glb, 9 frames; license MIT-0"
    assert str(tmp_path) not in Path("got/shed/scene.yaml").read_text()
    # Again, and from the folder itself: nothing is written.
    before = Path("got/shed").stat().st_mtime_ns
    assert run("library get shed --out got --from packed") == 0
    assert "is there already" in capsys.readouterr().out
    assert Path("got/shed").stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lab", "license of lab must be a free one"),
        ("wood", "wood must be a scene folder"),
        ("shack", "there is no scene in .* 'shack'"),
    ],
)
def test_scenes_that_cannot_be_shared_are_not_packed(run, capsys, name, message):
    assert run(f"library pack {name} --out packed") != 0
    assert re.search(message, capsys.readouterr().err)


@pytest.mark.parametrize("license", ["CC-BY-NC-4.0", "Non-Commercial use", "noncommercial"])
def test_scenes_of_other_licenses_are_not_packed(run, monkeypatch, capsys, license):
    index = json.loads(Path(INDEX).read_text())
    index["shed"]["license"] = license
    Path(INDEX).write_text(json.dumps(index))
    assert run("library pack shed --out packed") != 0
    assert "license of shed must be a free one" in capsys.readouterr().err


def test_damaged_and_foreign_scenes_are_refused(run, capsys):
    def refused(message: str) -> bool:
        status = run("library get shed --out got --from packed")
        return status != 0 and message in capsys.readouterr().err

    run("library pack shed --out packed")
    file, index = Path("packed/shed/esdf.npz"), Path("packed/scenes.json")
    content, listed = file.read_bytes(), index.read_text()
    file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert refused("digest of")
    file.write_bytes(content + b"x")
    assert refused("at most") and not Path("got/shed").exists()
    file.unlink()
    assert refused("cannot read file:")
    Path("got/shed").mkdir()
    assert refused("choose another --out")
    for changed in (listed.replace('"shed"', '"../shed"'), listed.replace("esdf.npz", "../x"), "["):
        index.write_text(changed)
        assert refused("not a list of scenes")
