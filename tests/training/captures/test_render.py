import shutil

import numpy as np
import pytest
import trimesh
from room import wall_depth

from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.diagrams.worlds import splits
from splatpilot.diagrams.worlds.indoor import RoomConfig
from splatpilot.diagrams.worlds.mesh import mesh_digests
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.diagrams.worlds.splits import source_digest
from splatpilot.diagrams.worlds.world_registry import make_spec
from splatpilot.systems.common.config import load_config
from splatpilot.training.captures import render as render_capture
from splatpilot.training.captures.capture import pixel_rays
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.render import RenderConfig, rendered_world, run, true_camera
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.reconstruct import reconstruct

SIZE = np.array([6.0, 4.0, 3.0])  # [m] of a room about the origin, seen from inside


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    path = tmp_path_factory.mktemp("room") / "room.obj"
    mesh = trimesh.creation.box(SIZE)
    mesh.invert()
    mesh.export(path, include_normals=True)
    return path


def small(**fields) -> RenderConfig:
    path = [[-1.5, 0.0, 0.2], [1.5, 0.5, 0.2]]
    return RenderConfig(width=64, height=48, up="z", path=path, spacing=1.0, **fields)


def depth_of_room(frame) -> np.ndarray:
    rays = pixel_rays(frame.K, 64, 48) @ frame.X_WC.rotation().matrix().T
    return wall_depth(frame.X_WC.translation(), rays, -SIZE / 2, SIZE / 2)


def test_a_world_may_be_named_as_in_the_benchmark(tmp_path, monkeypatch, capsys):
    planned = []

    def plan(config, seed):
        planned.append((config, seed))
        raise ValueError("planned")

    monkeypatch.setattr(render_capture, "make_spec", plan)
    words = ["--out", str(tmp_path / "capture"), "--seed", "3"]
    assert main(["capture", "render", "P02", *words]) == 1
    assert "planned" in capsys.readouterr().err
    assert planned == [(load_config(Scenario(), benchmark_scenarios()["P02"]).world, 3)]
    assert main(["capture", "render", "P99", *words]) == 1
    assert "No such file or folder: P99" in capsys.readouterr().err


def test_capture_has_exact_depth_where_its_poses_say(opengl, room, tmp_path):
    out = tmp_path / "capture"
    config = small(yaws=[0.0], offsets=[0.5], clearance=0.3)
    run(world=room, out=out, config=config)
    capture, beside = (read_capture(path) for path in (out, out / "offset_+0.50"))
    assert len(capture) == len(beside) == 4 and not capture.dropped
    for X_WC, X_WD in zip(capture.X_WCs, beside.X_WCs, strict=True):
        moved = (X_WC.inverse() @ X_WD).translation()
        np.testing.assert_allclose(moved, [-0.5, 0, 0], atol=1e-9)
    for frame in (*capture.frames(), *beside.frames()):
        np.testing.assert_allclose(frame.depth, depth_of_room(frame), rtol=1e-4)
    camera = true_camera(out)
    assert camera is not None
    again = camera(capture.X_WCs[3])
    np.testing.assert_array_equal(again.image, capture.load_image(3))
    np.testing.assert_allclose(again.depth, capture.load_depth(3), atol=1e-5)
    np.testing.assert_array_equal(again.K, capture.K)
    with pytest.raises(ValueError, match="holds something other"):
        run(world=room, out=out, config=small())
    assert len(read_capture(out)) == 4
    assert true_camera(tmp_path) is None
    (out / "world.yaml").write_text("mesh: room.obj\n")
    with pytest.raises(ValueError, match=r"world\.yaml: version must be 4, got 1; render it again"):
        true_camera(out)


def test_interrupted_rendering_resumes(opengl, room, tmp_path):
    whole, part, partial = (tmp_path / name for name in ("whole", "part", ".part.partial"))
    run(world=room, out=whole, config=small(yaws=[0.0]))
    shutil.copytree(whole, partial)
    (partial / "pose_left.txt").unlink()
    (partial / "image_left/000003_left.png").unlink()
    kept = partial / "image_left/000002_left.png"
    kept.touch()
    before = kept.stat().st_mtime_ns
    run(world=room, out=part, config=small(yaws=[0.0]))
    assert not partial.exists()
    assert (part / "image_left/000002_left.png").stat().st_mtime_ns == before
    for file in sorted(whole.rglob("*.*")):
        assert (part / file.relative_to(whole)).read_bytes() == file.read_bytes()


def test_generated_world_has_its_shapes_and_the_split_of_its_seed(opengl, tmp_path, monkeypatch):
    scenario = tmp_path / "room.yaml"
    scenario.write_text("world: !RoomConfig {length: 6, width: 4, height: 2.6, items: 1}\n")
    monkeypatch.setattr(render_capture, "benchmark_scenarios", lambda: {"P13": scenario})
    # A grid of another size shows the same.
    finer = tmp_path / "finer.yaml"
    finer.write_text(scenario.read_text().replace("items: 1", "items: 1, voxel_size: 0.07"))
    world = load_config(Scenario(), finer).world
    found = [render_capture._generated_split(world, seed) for seed in (4, 1_000_004, 2_000_004)]
    assert found == ["test", "train", "validation"]
    config = RenderConfig(width=64, height=48, path=[[1.5, 0.4, 1.5]], yaws=[0.0, 120.0])
    run(world="P13", out=tmp_path / "capture", config=config, seed=4)
    recipe = rendered_world(tmp_path / "capture")
    assert recipe is not None and recipe.split == "test"
    spec = make_spec(RoomConfig(length=6, width=4, height=2.6, items=1), 4)
    for frame in read_capture(tmp_path / "capture").frames():
        p_CQ = pixel_rays(frame.K, 64, 48) * frame.depth[..., None]
        p_CQ = p_CQ[np.isfinite(frame.depth)]
        distance = spec.distance_field.distance(frame.X_WC.multiply(p_CQ.T).T)
        inside = np.isfinite(distance)
        assert inside.sum() > 500
        assert np.abs(distance[inside]).max() < 0.01


def test_renamed_copy_of_a_test_mesh_is_of_split_test(opengl, room, tmp_path, monkeypatch):
    tested = {"warehouse": source_digest(mesh_digests(room))}
    monkeypatch.setattr(splits, "load_test_sources", lambda: tested)
    copy = shutil.copyfile(room, tmp_path / "capture.obj")
    with pytest.raises(ValueError, match=r"capture.obj must be test, got train; it shows ware"):
        run(world=copy, out=tmp_path / "out", config=small(split="train"))
    run(world=copy, out=tmp_path / "out", config=small(yaws=[0.0]))
    scene = ReconstructConfig(iterations=0, voxel_size=0.4)
    reconstruct(read_capture(tmp_path / "out"), tmp_path / "scene", scene)
    assert read_scene_metadata(tmp_path / "scene").split == "test"


@pytest.mark.parametrize("offsets", [[0.0], [0.101, 0.104]])
def test_offsets_have_folders_of_their_own(offsets):
    with pytest.raises(ValueError, match=r"offsets must be other than 0, and different"):
        RenderConfig(offsets=offsets).validate()


def test_bad_input_is_named(room, tmp_path, capsys):
    (tmp_path / "world.stl").write_bytes(b"x")
    (tmp_path / "damaged.glb").write_bytes(b"x")
    (tmp_path / "damaged.gltf").write_text("{")
    out = tmp_path / "capture"
    for world, options, message in (
        (tmp_path / "no.gltf", [], "no.gltf"),
        (tmp_path / "world.stl", [], "the suffix must be one of .gltf, .glb, .obj, got .stl"),
        (tmp_path / "damaged.glb", [], "damaged.glb: not a readable mesh"),
        (tmp_path / "damaged.gltf", [], "damaged.gltf"),
        (room, ["--path", "1,2"], "finite points"),
        (room, ["--path", "a b"], "with spaces between"),
        (room, ["--up", "z", "--path", "0,0,0 5,0,0"], "touches something"),
        (room, ["--set", "spacing=0"], "spacing must be in [0.01, inf) m, got 0"),
        (room, ["--set", "yaws=[]"], "yaws"),
        (room, ["--set", "split=fresh"], "split must be one of train, validation, test, got 'fr"),
        (room, ["--set", "lowest=3"], "lowest must be below highest, 2.2, got 3"),
    ):
        assert main(["capture", "render", str(world), "--out", str(out), *options]) == 1, world
        assert message in capsys.readouterr().err
        assert not [path for path in tmp_path.iterdir() if "capture" in path.name]
