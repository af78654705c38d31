from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from splatpilot.diagrams.worlds import splits
from splatpilot.diagrams.worlds.scene_folder import read_scene, read_scene_metadata
from splatpilot.diagrams.worlds.splits import part_digests, source_digest
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.splats.splat_files import read_ply
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.photometry import Photometry
from splatpilot.training.reconstruction.reconstruct import reconstruct

CONFIG = ReconstructConfig(iterations=0, voxel_size=0.1)


def image_digests(capture: Capture) -> set[str]:
    return part_digests(capture.load_image(i).tobytes() for i in range(len(capture)))


def test_room_end_to_end(tmp_path, write_room, room_in_W):
    room = write_room(tmp_path / "room", width=128, height=96)
    summary = reconstruct(read_capture(room), tmp_path / "scene", CONFIG)
    assert f"Gaussians          {summary.gaussians}\n" in str(summary)
    size = " x ".join(f"{length:.3g}" for length in summary.field.upper_W - summary.field.lower_W)
    assert f"size               {size} m, from (" in str(summary)
    world = read_scene(tmp_path / "scene")
    metadata = read_scene_metadata(tmp_path / "scene")
    assert (world.name, metadata.frontier) == ("room", True)
    of_scene = read_ply(tmp_path / "scene" / "gaussians.ply")
    assert len(of_scene) == summary.gaussians < len(world.gaussians)
    assert "TartanAir V1" in metadata.provenance and len(metadata.gains) == 12

    # It collides like the room: 6 x 3 x 2.5 m, not all of it seen.
    lower, upper = room_in_W
    assert 30 < metadata.observed_free_volume <= 6 * 3 * 2.5 * 1.05
    p_WQ = np.array([[2.0, 0.0, 1.2], [4.0, 0.3, 1.4]])
    truth = np.minimum(p_WQ - lower, upper - p_WQ).min(axis=-1)
    np.testing.assert_allclose(world.esdf.distance(p_WQ), truth, atol=0.06)
    assert (world.esdf.query(p_WQ).state == FieldState.FREE).all()

    # Start and goal are far apart in it and free.
    assert summary.route.length > 3
    ends = np.array([world.p_WS, world.p_WG])
    assert (np.minimum(ends - lower, upper - ends) > VEHICLE_RADIUS).all()
    assert (world.esdf.conservative().distance(ends) > VEHICLE_RADIUS).all()

    assert_renders_like(tmp_path / "scene", room, range(12), min_psnr=28, max_error=0.04)


@pytest.mark.parametrize("iterations", [0, 2])
def test_images_are_read_once_on_one_thread(tmp_path, write_room, iterations):
    capture = read_capture(write_room(tmp_path / "room"))
    threads, read = torch.get_num_threads(), []

    def load_image(i: int) -> np.ndarray:
        read.append((i, torch.get_num_threads()))
        return capture.load_image(i)

    torch.set_num_threads(2)
    try:
        config = replace(CONFIG, iterations=iterations)
        reconstruct(replace(capture, load_image=load_image), tmp_path / "scene", config)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert sorted(read) == [(i, 1) for i in range(len(capture))]


def test_number_of_gaussians_is_limited(tmp_path, write_room):
    capture = read_capture(write_room(tmp_path / "room"))
    free = reconstruct(capture, tmp_path / "a", CONFIG).gaussians
    limit = replace(CONFIG, max_gaussians=free // 3)
    assert 0 < reconstruct(capture, tmp_path / "b", limit).gaussians <= free // 3


def remove_depth(room, indices) -> None:
    files = sorted((room / "depth_left").iterdir())
    for i in indices:
        np.save(files[i], np.zeros_like(np.load(files[i])))


@pytest.mark.parametrize("iterations", [0, 2])
def test_a_capture_without_any_depth_leaves_nothing(tmp_path, write_room, iterations):
    room = write_room(tmp_path / "room")
    remove_depth(room, range(12))
    config = replace(CONFIG, iterations=iterations)
    with pytest.raises(ValueError, match=r"no pixel of \d+ frames has a depth that a"):
        reconstruct(read_capture(room), tmp_path / "scene", config)
    assert list(tmp_path.iterdir()) == [room]


def test_frames_without_depth_are_named(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    remove_depth(room, (3, 4))
    summary = reconstruct(read_capture(room), tmp_path / "scene", CONFIG)
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
def test_invalid_config(tmp_path, write_room, change, message):
    room = write_room(tmp_path / "room")
    with pytest.raises(ValueError, match=message):
        reconstruct(read_capture(room), tmp_path / "scene", replace(CONFIG, **change))
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize("split", ["", "validation"])
def test_scene_has_the_split_and_digest_of_its_capture(tmp_path, write_room, split):
    room = write_room(tmp_path / "hospital")
    reconstruct(read_capture(room), tmp_path / "scene", replace(CONFIG, split=split))
    metadata = read_scene_metadata(tmp_path / "scene")
    assert metadata.split == (split or "train") and len(metadata.source_digest) == 8
    for image in (room / "image_left").iterdir():  # the same pixels in another file format
        pixels = cv2.imread(str(image))
        image.unlink()
        cv2.imwrite(str(image), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 0])
    renamed = read_capture(room.rename(tmp_path / "P001"))
    assert set(metadata.source_digest) <= image_digests(renamed)


def test_renamed_copy_of_a_test_capture_is_of_split_test(tmp_path, write_room, monkeypatch):
    room = read_capture(write_room(tmp_path / "P001"))
    tested = {"hospital": source_digest(image_digests(room))}
    monkeypatch.setattr(splits, "load_test_sources", lambda: tested)
    reconstruct(room, tmp_path / "scene", CONFIG)
    assert read_scene_metadata(tmp_path / "scene").split == "test"
    with pytest.raises(ValueError, match="must be test, got train; it shows hospital"):
        reconstruct(room, tmp_path / "scene", replace(CONFIG, split="train"))


def assert_renders_like(scene, capture, frames, min_psnr: float, max_error: float) -> None:
    world, metadata = read_scene(scene), read_scene_metadata(scene)
    photometry = Photometry(np.array(metadata.gains), metadata.vignetting)
    for i in frames:
        frame = read_capture(capture).frame(i)
        height, width = frame.depth.shape
        view = world.baked.render(frame.K, width, height, frame.X_WC, background=world.background)
        color = view.color * photometry.factor(i, height, width)[..., None]
        psnr = -10 * np.log10(np.mean((color.clip(0, 1) - frame.image / 255) ** 2))
        assert psnr > min_psnr
        assert np.median(np.abs(view.depth / frame.depth - 1)) < max_error
        assert view.alpha.mean() > 0.98
