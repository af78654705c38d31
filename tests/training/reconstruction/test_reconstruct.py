import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from room import LOWER_W, UPPER_W, write_room_capture

from splatpilot.diagrams.worlds import splits
from splatpilot.diagrams.worlds.scene_folder import read_scene, read_scene_metadata
from splatpilot.diagrams.worlds.splits import part_digests, source_digest
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.common.config import load_config
from splatpilot.systems.splats.splat_files import read_ply
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.photometry import Photometry
from splatpilot.training.reconstruction.reconstruct import reconstruct

CONFIG = ReconstructConfig(iterations=0, voxel_size=0.2)


def test_room_end_to_end(tmp_path):
    room = write_room_capture(tmp_path / "room", width=128, height=96)
    fine = replace(CONFIG, voxel_size=0.1)
    summary = reconstruct(read_capture(room), tmp_path / "scene", fine)
    assert f"Gaussians          {summary.gaussians}\n" in str(summary)
    lengths = np.subtract(summary.metadata.upper_W, summary.metadata.lower_W)
    size = " x ".join(f"{length:.3g}" for length in lengths)
    assert f"size               {size} m, from (" in str(summary)
    world, metadata = read_scene(tmp_path / "scene"), read_scene_metadata(tmp_path / "scene")
    assert (world.name, metadata.frontier) == ("room", True)
    of_scene = read_ply(tmp_path / "scene" / "gaussians.ply")
    assert len(of_scene) == summary.gaussians < len(world.gaussians)
    assert "TartanAir V1" in metadata.provenance and len(metadata.gains) == 12
    assert metadata.split == "train"
    settings = load_config(ReconstructConfig(), tmp_path / "scene" / "reconstruct.yaml")
    assert (settings.iterations, settings.voxel_size) == (0, 0.1)

    # It collides like the room: 6 x 3 x 2.5 m, not all of it seen.
    assert 30 < metadata.observed_free_volume <= 6 * 3 * 2.5 * 1.05
    p_WQ = np.array([[2.0, 0.0, 1.2], [4.0, 0.3, 1.4]])
    truth = np.minimum(p_WQ - LOWER_W, UPPER_W - p_WQ).min(axis=-1)
    np.testing.assert_allclose(world.esdf.distance(p_WQ), truth, atol=0.06)
    assert (world.esdf.query(p_WQ).state == FieldState.FREE).all()

    # Start and goal are far apart in it and free.
    assert summary.route.length > 3
    ends = np.array([world.p_WS, world.p_WG])
    assert (np.minimum(ends - LOWER_W, UPPER_W - ends) > VEHICLE_RADIUS).all()
    assert (world.esdf.conservative().distance(ends) > VEHICLE_RADIUS).all()

    photometry = Photometry(np.array(metadata.gains), metadata.vignetting)
    for i, frame in enumerate(read_capture(room).frames()):
        view = world.baked.render(frame.K, 128, 96, frame.X_WC, background=world.background)
        color = view.color * photometry.factor(i, 96, 128)[..., None]
        psnr = -10 * np.log10(np.mean((color.clip(0, 1) - frame.image / 255) ** 2))
        assert psnr > 28
        assert np.median(np.abs(view.depth / frame.depth - 1)) < 0.04
        assert view.alpha.mean() > 0.98


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return write_room_capture(tmp_path_factory.mktemp("room") / "P001")


@pytest.fixture
def capture(room) -> Capture:
    return read_capture(room)


@pytest.mark.parametrize(("iterations", "limit"), [(0, 5_000), (2, 100_000)])
def test_images_are_read_once_on_one_thread(tmp_path, capture, iterations, limit):
    threads, read = torch.get_num_threads(), []

    def load_image(i: int) -> np.ndarray:
        read.append((i, torch.get_num_threads()))
        return capture.load_image(i)

    torch.set_num_threads(2)
    try:
        config = replace(CONFIG, iterations=iterations, max_gaussians=limit)
        watched = replace(capture, load_image=load_image)
        assert 0 < reconstruct(watched, tmp_path / "scene", config).gaussians <= limit
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert sorted(read) == [(i, 1) for i in range(len(capture))]


def test_frames_without_depth_are_named_and_a_capture_without_any_leaves_nothing(tmp_path, capture):
    def without_depth(*frames: int) -> Capture:
        return replace(capture, load_depth=lambda i: (i not in frames) * capture.load_depth(i))

    for iterations in (0, 2):
        config = replace(CONFIG, iterations=iterations)
        with pytest.raises(ValueError, match=r"no pixel of \d+ frames has a depth that a"):
            reconstruct(without_depth(*range(12)), tmp_path / "scene", config)
        assert not list(tmp_path.iterdir())
    summary = reconstruct(without_depth(3, 4), tmp_path / "scene", CONFIG)
    names = "000003_left.png, 000004_left.png"
    assert f"2 of 12 frames have no pixel with depth: {names}" in summary.warnings


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"iterations": -2}, "iterations must be .* got -2"),
        ({"hold_out": 1}, "hold_out must be 0 or at least 2, got 1"),
        ({"voxel_size": 0.001}, r"voxel_size must be 0 or at least 0\.005 m, got 0\.001"),
        ({"max_range": 0.2, "voxel_size": 0.2}, r"max_range must be above voxel_size 0\.2 m"),
    ],
)
def test_invalid_config(tmp_path, capture, change, message):
    with pytest.raises(ValueError, match=message):
        reconstruct(capture, tmp_path / "scene", replace(CONFIG, **change))
    assert not (tmp_path / "scene").exists()


def test_scene_has_the_split_and_digest_of_its_capture(tmp_path, room, capture, monkeypatch):
    given = replace(CONFIG, split="validation")
    reconstruct(capture, tmp_path / "scene", given)
    metadata = read_scene_metadata(tmp_path / "scene")
    assert metadata.split == "validation" and len(metadata.source_digest) == 8
    copy = shutil.copytree(room, tmp_path / "renamed")
    for image in (copy / "image_left").iterdir():  # the same pixels in another file format
        cv2.imwrite(str(image), cv2.imread(str(image)), [cv2.IMWRITE_PNG_COMPRESSION, 0])
    renamed = read_capture(copy)
    digests = part_digests(renamed.load_image(i).tobytes() for i in range(12))
    assert set(metadata.source_digest) <= digests

    monkeypatch.setattr(splits, "load_test_sources", lambda: {"hospital": source_digest(digests)})
    with pytest.raises(ValueError, match="must be test, got validation; it shows hospital"):
        reconstruct(renamed, tmp_path / "other", given)
    reconstruct(renamed, tmp_path / "other", CONFIG)
    assert read_scene_metadata(tmp_path / "other").split == "test"
