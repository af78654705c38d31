import os
from dataclasses import replace
from pathlib import Path

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


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def image_digests(capture: Capture) -> set[str]:
    return part_digests(capture.load_image(i).tobytes() for i in range(len(capture)))


def test_room_end_to_end(tmp_path, write_room, room_in_W):
    room = write_room(tmp_path / "room", width=128, height=96)
    summary = reconstruct(read_capture(room), tmp_path / "scene", CONFIG)
    assert f"Gaussians          {summary.gaussians}\n" in str(summary)
    size = " x ".join(f"{length:.3g}" for length in summary.upper_W - summary.lower_W)
    assert f"size               {size} m, from (" in str(summary)
    world = read_scene(tmp_path / "scene")
    metadata = read_scene_metadata(tmp_path / "scene")
    assert (world.name, metadata.frontier) == ("room", True)
    of_scene = read_ply(tmp_path / "scene" / "gaussians.ply")
    assert len(of_scene) == summary.gaussians < len(world.gaussians)
    assert "TartanAir V1" in metadata.provenance and len(metadata.gains) == 12

    # It collides like the room: 6 x 3 x 2.5 m, of which not all was seen.
    lower, upper = room_in_W
    assert 30 < metadata.observed_free_volume <= 6 * 3 * 2.5 * 1.05
    p_WQ = np.array([[2.0, 0.0, 1.2], [4.0, 0.3, 1.4]])
    truth = np.minimum(p_WQ - lower, upper - p_WQ).min(axis=-1)
    np.testing.assert_allclose(world.esdf.distance(p_WQ), truth, atol=0.06)
    assert (world.esdf.query(p_WQ).state == FieldState.FREE).all()

    # Start and goal are far apart in it and free.
    assert summary.geodesic > 3
    ends = np.array([world.p_WS, world.p_WG])
    assert (np.minimum(ends - lower, upper - ends) > VEHICLE_RADIUS).all()
    assert (world.esdf.conservative().distance(ends) > VEHICLE_RADIUS).all()

    # It looks like the room.
    capture = read_capture(room)
    baked = world.baked
    photometry = Photometry(np.array(metadata.gains), metadata.vignetting)
    for i in range(len(capture)):
        frame = capture.frame(i)
        view = baked.render(frame.K, 128, 96, frame.X_WC, background=world.background)
        assert psnr(view.color * photometry.factor(i, 96, 128)[..., None], frame.image / 255) > 28
        assert np.median(np.abs(view.depth / frame.depth - 1)) < 0.04
        assert view.alpha.mean() > 0.98


def test_same_capture_same_scene(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    for name in ("a", "b"):
        reconstruct(read_capture(room), tmp_path / name, CONFIG)
    for file in ("gaussians.ply", "scene.yaml"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_torch_computes_on_one_thread(tmp_path, write_room):
    capture = read_capture(write_room(tmp_path / "room"))
    threads, used = torch.get_num_threads(), set()

    def load_image(i: int) -> np.ndarray:
        used.add(torch.get_num_threads())
        return capture.load_image(i)

    torch.set_num_threads(2)
    try:
        reconstruct(replace(capture, load_image=load_image), tmp_path / "scene", CONFIG)
        assert (used, torch.get_num_threads()) == ({1}, 2)
    finally:
        torch.set_num_threads(threads)


def test_number_of_gaussians_is_kept(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    free = reconstruct(read_capture(room), tmp_path / "a", CONFIG).gaussians
    limited = reconstruct(
        read_capture(room), tmp_path / "b", replace(CONFIG, max_gaussians=free // 3)
    ).gaussians
    assert 0 < limited <= free // 3
    with pytest.raises(ValueError, match="10 Gaussians are too few for 12 frames"):
        reconstruct(read_capture(room), tmp_path / "c", replace(CONFIG, max_gaussians=10))
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize("iterations", [0, 2])
def test_a_capture_without_any_depth_leaves_nothing(tmp_path, write_room, iterations):
    room = write_room(tmp_path / "room")
    for file in (room / "depth_left").iterdir():
        np.save(file, np.zeros_like(np.load(file)))
    config = replace(CONFIG, iterations=iterations)
    with pytest.raises(ValueError, match=r"no pixel of \d+ frames has a depth that a"):
        reconstruct(read_capture(room), tmp_path / "scene", config)
    assert list(tmp_path.iterdir()) == [room]


def test_frames_without_depth_are_named(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    files = sorted((room / "depth_left").iterdir())
    for file in files[3:5]:
        np.save(file, np.zeros_like(np.load(file)))
    summary = reconstruct(read_capture(room), tmp_path / "scene", CONFIG)
    names = "000003_left.png, 000004_left.png"
    assert f"2 of 12 frames have no pixel with depth: {names}" in summary.warnings


@pytest.mark.parametrize("iterations", [0, 2])
def test_images_are_read_once(tmp_path, write_room, iterations):
    capture = read_capture(write_room(tmp_path / "room"))
    read: list[int] = []

    def load_image(i: int) -> np.ndarray:
        read.append(i)
        return capture.load_image(i)

    counted = replace(capture, load_image=load_image)
    reconstruct(counted, tmp_path / "scene", replace(CONFIG, iterations=iterations))
    assert sorted(read) == list(range(len(capture)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"iterations": -2}, "iterations must be .* got -2"),
        ({"max_gaussians": 0}, "max_gaussians must be .* got 0"),
        ({"representation": "nerf"}, "representation must be .* got nerf"),
        ({"hold_out": 1}, "hold_out must be 0 or at least 2, got 1"),
        ({"voxel_size": 0.001}, r"voxel_size must be 0 or at least 0\.005 m, got 0\.001"),
        ({"voxel_size": float("nan")}, "voxel_size must be .* got nan"),
        ({"max_range": 0.2, "voxel_size": 0.2}, r"max_range must be above voxel_size 0\.2 m"),
        ({"contrast": -1.0}, r"contrast must be .* got -1\.0"),
    ],
)
def test_bad_config(tmp_path, write_room, change, message):
    room = write_room(tmp_path / "room")
    with pytest.raises(ValueError, match=message):
        reconstruct(read_capture(room), tmp_path / "scene", replace(CONFIG, **change))
    assert not (tmp_path / "scene").exists()


def test_bad_capture_leaves_nothing(tmp_path, write_room):
    room = write_room(tmp_path / "room")
    for i in (4, 5, 6):
        (room / "image_left" / f"{i:06d}_left.png").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"000004_left\.png: not a readable image"):
        reconstruct(read_capture(room), tmp_path / "scene", CONFIG)
    assert list(tmp_path.iterdir()) == [room]


@pytest.mark.parametrize("asked", ["", "train", "validation"])
def test_scene_has_the_split_and_digest_of_its_capture(tmp_path, write_room, asked):
    room = write_room(tmp_path / "hospital")
    reconstruct(read_capture(room), tmp_path / "scene", replace(CONFIG, split=asked))
    metadata = read_scene_metadata(tmp_path / "scene")
    assert metadata.split == (asked or "train") and len(metadata.source_digest) == 8
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
    with pytest.raises(ValueError, match="must be test, got train: it shows hospital"):
        reconstruct(room, tmp_path / "scene", replace(CONFIG, split="train"))


@pytest.mark.skipif("SPLATPILOT_DATA" not in os.environ, reason="SPLATPILOT_DATA is not set")
def test_hospital(tmp_path):
    capture = Path(os.environ["SPLATPILOT_DATA"]) / "tartanair" / "hospital"
    part = tmp_path / "part"
    numbers = range(8, 36, 2)
    for folder, name in (
        ("image_left", "{:06d}_left.png"),
        ("depth_left", "{:06d}_left_depth.npy"),
    ):
        (part / folder).mkdir(parents=True)
        files = sorted((capture / folder).iterdir())
        for new, number in enumerate(numbers):
            (part / folder / name.format(new)).symlink_to(files[number])
    poses = (capture / "pose_left.txt").read_text().splitlines()
    (part / "pose_left.txt").write_text("\n".join(poses[number] for number in numbers))

    config = ReconstructConfig(iterations=0, max_gaussians=100_000, voxel_size=0.1)
    summary = reconstruct(read_capture(part), tmp_path / "scene", config)
    assert summary.geodesic > 6
    assert -0.4 < summary.vignetting < -0.2
    world, sequence = read_scene(tmp_path / "scene"), read_capture(part)
    baked = world.baked
    photometry = Photometry(
        np.array(read_scene_metadata(tmp_path / "scene").gains), summary.vignetting
    )
    for i in (0, 5, 10):
        frame = sequence.frame(i)
        view = baked.render(frame.K, 640, 480, frame.X_WC, background=world.background)
        color = view.color * photometry.factor(i, 480, 640)[..., None]
        assert psnr(np.clip(color, 0, 1), frame.image / 255) > 23
        assert np.median(np.abs(view.depth / frame.depth - 1)) < 0.01
