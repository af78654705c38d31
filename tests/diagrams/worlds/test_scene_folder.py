from dataclasses import replace

import numpy as np
import pytest

from splatpilot.diagrams.worlds import scene_folder
from splatpilot.diagrams.worlds.scene_folder import (
    check_scene_target,
    read_scene,
    read_scene_folder,
    read_scene_metadata,
    write_scene_folder,
    write_scene_metadata,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.systems.splats.background import EnvironmentMap, mean_color
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_files import read_ply, write_ply


def box_of_gaussians(size=(6.0, 3.0, 3.0), step=0.1) -> GaussianScene:
    """The walls of a box with its lower corner in the origin, as round Gaussians."""
    axes = [np.arange(step / 2, length, step) for length in size]
    sides = []
    for axis, length in enumerate(size):
        for at in (0, length):
            grids = [np.array([at]) if a == axis else axes[a] for a in range(3)]
            sides.append(np.stack(np.meshgrid(*grids, indexing="ij"), -1).reshape(-1, 3))
    means = np.concatenate(sides)
    N = len(means)
    return GaussianScene.from_colors(
        means,
        np.tile([1, 0, 0, 0], (N, 1)),
        np.full((N, 3), step),
        np.full(N, 0.99),
        np.full((N, 3), 0.3),
    )


@pytest.fixture
def world() -> World:
    occupied = np.zeros((20, 10, 10), bool)
    occupied[0] = True
    unknown = np.zeros_like(occupied)
    unknown[15:] = True
    esdf = esdf_from_occupancy(occupied, unknown, np.array([1.0, 2.0, 3.0]), 0.2)
    return World(
        name="box",
        gaussians=box_of_gaussians(step=0.5),
        distance_field=esdf,
        esdf=esdf,
        background=(0.1, 0.2, 0.3),
        p_WS=np.array([2.0, 3.0, 4.0]),
        p_WG=np.array([3.0, 3.0, 4.0]),
    )


def test_round_trip(tmp_path, world):
    folder = tmp_path / "scene"
    written = write_scene_folder(
        folder, world, provenance="a test", gains=[1.0, 1.25], vignetting=-0.5
    )
    assert {file.name for file in folder.iterdir()} == {"gaussians.ply", "esdf.npz", "scene.yaml"}
    back = read_scene(folder)
    assert (back.name, back.background) == ("box", (0.1, 0.2, 0.3))
    np.testing.assert_array_equal(back.p_WS, world.p_WS)
    np.testing.assert_array_equal(back.p_WG, world.p_WG)
    np.testing.assert_array_equal(back.gaussians.means, world.gaussians.means)
    np.testing.assert_array_equal(back.esdf.distances, world.esdf.distances)
    np.testing.assert_array_equal(back.esdf.states, world.esdf.states)
    assert back.distance_field is back.esdf
    metadata = read_scene_metadata(folder)
    assert metadata == written
    assert (metadata.provenance, metadata.metric) == ("a test", True)
    assert (metadata.gains, metadata.vignetting) == ([1.0, 1.25], -0.5)
    np.testing.assert_allclose(metadata.lower_W, [1, 2, 3])
    np.testing.assert_allclose(metadata.upper_W, [5, 4, 5])
    assert metadata.observed_free_volume == pytest.approx(14 * 10 * 10 * 0.2**3)


def test_frontier_is_seen_in_flight_and_kept_apart(tmp_path, world):
    folder, frontier = tmp_path / "scene", box_of_gaussians(step=1.0)
    written = write_scene_folder(folder, world, frontier, provenance="")
    assert written.frontier and len(read_ply(folder / "gaussians.ply")) == len(world.gaussians)
    means = np.concatenate([world.gaussians.means, frontier.means])
    np.testing.assert_array_equal(read_scene(folder).gaussians.means, means)
    (folder / "frontier.ply").unlink()
    with pytest.raises(FileNotFoundError, match=r"frontier\.ply"):
        read_scene(folder)


def test_how_it_was_made_is_kept(tmp_path, world):
    folder = tmp_path / "scene"
    written = write_scene_folder(
        folder,
        world,
        provenance="",
        representation="2dgs",
        capture="/captures/hall",
        capture_settings=["depth_unit=500.0"],
        held_out=[0, 8],
        image_width=320,
    )
    assert (written.representation, written.capture) == ("2dgs", "/captures/hall")
    assert written.capture_settings == ["depth_unit=500.0"]
    assert (written.held_out, written.image_width) == ([0, 8], 320)
    assert (written.perturbation_bound, written.pose_perturbation_bounds) == (None, [])
    assert read_scene_metadata(folder) == written
    measured = replace(written, perturbation_bound=0.4, pose_perturbation_bounds=[0.3, 0.5])
    write_scene_metadata(folder, measured)
    assert read_scene_metadata(folder) == measured
    assert read_scene(folder).name == world.name


def test_an_environment_is_kept(tmp_path, world):
    folder = tmp_path / "scene"
    texels = np.random.default_rng(0).random((8, 16, 3), np.float32)
    sky = replace(world, background=EnvironmentMap(texels))
    metadata = write_scene_folder(folder, sky, provenance="")
    back = read_scene(folder).background
    assert isinstance(back, EnvironmentMap)
    np.testing.assert_allclose(back.texels, texels, atol=0.5 / 255 + 1e-6)
    assert metadata.background == pytest.approx(mean_color(sky.background))
    (folder / "environment.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"No such file: .*environment\.png"):
        read_scene(folder)
    write_scene_folder(folder, world, provenance="")
    assert read_scene(folder).background == world.background


def test_scene_from_before_these_fields(tmp_path, world):
    folder = tmp_path / "scene"
    write_scene_folder(folder, world, provenance="")
    later = ("representation", "capture", "held_out", "image_width", "perturb", "pose_perturb")
    lines = (folder / "scene.yaml").read_text().splitlines(keepends=True)
    kept = [line for line in lines if not line.startswith(later)]
    assert len(kept) < len(lines) - 3
    (folder / "scene.yaml").write_text("".join(kept))
    metadata = read_scene_metadata(folder)
    assert (metadata.representation, metadata.capture, metadata.held_out) == ("3dgs", "", [])
    assert (metadata.image_width, metadata.perturbation_bound) == (0, None)
    assert metadata.capture_settings == []


def test_a_scene_is_replaced_whole(tmp_path, world):
    folder = tmp_path / "scene"
    write_scene_folder(folder, world, provenance="first")
    (folder / "metrics.json").write_text("{}")
    write_scene_folder(folder, world, provenance="second")
    assert read_scene_metadata(folder).provenance == "second"
    assert not (folder / "metrics.json").exists()
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.parametrize("failing", ["write_ply", "write_scene_metadata"])
def test_failed_write_keeps_the_old_scene(tmp_path, world, monkeypatch, failing):
    folder = tmp_path / "scene"
    write_scene_folder(folder, world, provenance="first")

    def fail(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(scene_folder, failing, fail)
    with pytest.raises(OSError, match="No space left"):
        write_scene_folder(folder, world, provenance="second")
    assert read_scene_metadata(folder).provenance == "first"
    assert list(tmp_path.iterdir()) == [folder]


def test_other_folders_are_not_overwritten(tmp_path, world):
    folder = tmp_path / "holiday"
    folder.mkdir()
    (folder / "photo.jpg").write_bytes(b"x")
    for target in (folder, folder / "photo.jpg"):
        with pytest.raises(ValueError, match="scene folder must be new, empty or a scene"):
            write_scene_folder(target, world, provenance="")
    assert (folder / "photo.jpg").read_bytes() == b"x"
    empty = tmp_path / "empty"
    empty.mkdir()
    check_scene_target(empty)


def test_unwritable_place(tmp_path, world):
    write_scene_folder(tmp_path / "new" / "folder" / "scene", world, provenance="")
    assert read_scene(tmp_path / "new" / "folder" / "scene").name == world.name
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError, match="file: is a file"):
        check_scene_target(tmp_path / "file" / "scene")
    with pytest.raises(OSError, match="cannot write to the output folder /proc"):
        check_scene_target("/proc/scene")


@pytest.mark.parametrize("missing", ["gaussians.ply", "esdf.npz", "scene.yaml"])
def test_missing_file(tmp_path, world, missing):
    folder = tmp_path / "scene"
    write_scene_folder(folder, world, provenance="")
    (folder / missing).unlink()
    with pytest.raises(FileNotFoundError, match=rf"No such file: .*{missing}"):
        read_scene(folder)


def test_missing_scene(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_scene(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"No such file: .*nowhere"):
        read_scene_folder(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("metric: true", "metric: false", "metric must be true to fly, got false"),
        ("metric: true", "metrik: true", "metrik"),
        ("format_version: 2", "format_version: 3", "format_version must be 2, got 3"),
        ("format_version: 2", "format_version: 1", "format_version must be 2, got 1; reconstruct"),
        ("p_WS: [2.0, 3.0, 4.0]", "p_WS: [2.0, 3.0]", "p_WS must be three finite numbers, got"),
        ("p_WG: [3.0, 3.0, 4.0]", "p_WG: [3.0, .nan, 4.0]", "p_WG must be in .* got .*nan"),
        ("p_WS: [2.0, 3.0, 4.0]", "", r"p_WS must be .* got \[\]"),
        ("vignetting: 0.0", "vignetting: dark", "dark"),
        ("metric: true", "metric: [", r"line 9: expected"),
        ("representation: 3dgs", "representation: nerf", "representation must be .* got nerf"),
        ("held_out: []", "held_out: [-1]", r"held_out must be .* got \[-1\]"),
        ("image_width: 0", "perturbation_bound: -0.5", r"perturbation_bound must be .* got -0\.5"),
    ],
)
def test_bad_metadata(tmp_path, world, old, new, message):
    folder = tmp_path / "scene"
    write_scene_folder(folder, world, provenance="")
    text = (folder / "scene.yaml").read_text()
    assert old in text
    (folder / "scene.yaml").write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=rf"(?s)scene\.yaml: .*{message}"):
        read_scene(folder)


def test_bare_ply(tmp_path):
    path = tmp_path / "hall.ply"
    write_ply(box_of_gaussians(), path)
    world = read_scene(path)
    assert world.name == "hall"
    assert len(world.gaussians) > 1000
    assert world.distance_field is world.esdf
    # In the middle the walls are 1.5 m away, less their thickness.
    assert world.esdf.distance(np.array([3.0, 1.5, 1.5])) == pytest.approx(1.3, abs=0.2)
    assert world.esdf.distance(np.array([0.0, 1.5, 1.5])) < 0
    for p in (world.p_WS, world.p_WG):
        assert (p > 0.354).all() and (p < np.array([6.0, 3.0, 3.0]) - 0.354).all()
    assert np.linalg.norm(world.p_WS - world.p_WG) > 4


def test_stray_gaussians_do_not_stretch_a_bare_ply(tmp_path):
    scene = box_of_gaussians()
    stray = GaussianScene.from_colors(
        [[1000, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.9], [[1, 1, 1]]
    )
    write_ply(scene.merged_with(stray), tmp_path / "hall.ply")
    assert (read_scene(tmp_path / "hall.ply").esdf.upper_W < 10).all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("world_frame: z up", "world_frame: y up", "world_frame must be in {z up}, got y up"),
        ("background: [", "background: [7.0, -1.0, 0.5] #", "background must be in .* got"),
        ("lower_W: [", "lower_W: [-99.0, -99.0, -99.0] #", "files are of different scenes"),
    ],
)
def test_metadata_is_believed_or_refused(tmp_path, world, old, new, message):
    folder = tmp_path / "scene"
    write_scene_folder(folder, world, provenance="")
    file = folder / "scene.yaml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_scene(folder)


def test_space_beside_a_bare_ply_is_not_flown_through(tmp_path):
    y, z = (grid.ravel() for grid in np.meshgrid(np.arange(0, 10, 0.1), np.arange(0, 8, 0.1)))
    walls = [np.column_stack([np.full(y.size, x), y, z]) for x in (0.0, 3.0, 6.0)]
    means = np.concatenate(walls)
    count = len(means)
    scene = GaussianScene.from_colors(
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), 0.08),
        np.full(count, 0.95),
        np.full((count, 3), 0.5),
    )
    write_ply(scene, tmp_path / "walls.ply")
    walled = read_scene(tmp_path / "walls.ply")
    times = time_of_arrival(walled.esdf.conservative(), np.array([1.5, 5.0, 4.0]))
    assert times.is_reachable(np.array([1.5, 2.0, 2.0]))
    assert not times.is_reachable(np.array([4.5, 5.0, 4.0]))
