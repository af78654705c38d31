import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from room import tiled_flight

from splatpilot.training.captures import frames as image_files
from splatpilot.training.captures import photographs
from splatpilot.training.captures.capture import Capture, pixel_rays, project_points
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.photographs import likely_pairs, similarity, triangulate


@pytest.mark.parametrize("partners", [4, 8])
def test_likely_pairs(partners):
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 0.1, (40, 40))
    similarity = noise + noise.T
    for a in range(20):  # The second half repeats the path of the first.
        similarity[a, a + 20] = similarity[a + 20, a] = 1.0
    pairs = likely_pairs(similarity, partners)
    assert pairs == sorted(set(pairs)) and all(a < b for a, b in pairs)
    assert {(a, a + 1) for a in range(39)} <= set(pairs)
    assert {(a, a + 20) for a in range(20)} <= set(pairs)
    assert 40 * partners / 2 - partners**2 <= len(pairs) <= 40 * partners


@pytest.mark.parametrize("partners", [1, 2])
def test_few_partners_are_neighbors(partners):
    assert likely_pairs(np.ones((9, 9)), partners) == [(a, a + 1) for a in range(8)]


def test_features_of_a_database(tmp_path):
    rng = np.random.default_rng(2)
    scenes = [
        cv2.resize(rng.integers(0, 255, (60, 80), dtype=np.uint8), (320, 240)) for _ in range(2)
    ]
    names = [f"{i}.png" for i in range(5)]
    images = [p[:, s : s + 280] for p in scenes for s in (0, 40)] + [np.zeros((240, 280), np.uint8)]
    for name, image in zip(names, images, strict=True):
        cv2.imwrite(str(tmp_path / name), image)
    file = tmp_path / "features.db"
    pycolmap.Database.open(file).close()
    pycolmap.import_images(file, tmp_path, pycolmap.CameraMode.SINGLE, names)
    options = pycolmap.FeatureExtractionOptions(use_gpu=False)
    pycolmap.extract_features(file, tmp_path, names, extraction_options=options)
    database = pycolmap.Database.open(file)
    found = similarity(database, names)
    database.close()
    assert min(found[0, 1], found[2, 3]) > found[:2, 2:].max() + 0.2
    np.testing.assert_allclose(found, found.T, atol=1e-12)
    np.testing.assert_allclose(np.diag(found), [1, 1, 1, 1, 0], atol=1e-6)


def test_features_of_many_photographs_fit_into_memory(monkeypatch):
    rng = np.random.default_rng(0)
    content = [rng.integers(0, 255, (4096, 128), dtype=np.uint8) for _ in range(16)]
    database = SimpleNamespace(
        read_all_images=lambda: [SimpleNamespace(name=str(i), image_id=i) for i in range(16)],
        read_descriptors=lambda i: SimpleNamespace(data=content[i]),
    )
    monkeypatch.setattr(photographs, "_SAMPLE", 1000)
    tracemalloc.start()
    similarity(database, [str(i) for i in range(16)])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 * sum(each.nbytes for each in content)


def write_video(path, count: int, sharp: set[int]) -> list[np.ndarray]:
    """Writes a video of 30 Hz that brightens; returns its frames, blurred except for `sharp`."""
    rng = np.random.default_rng(0)
    pattern = cv2.resize(rng.integers(0, 80, (30, 40), dtype=np.uint8), (160, 120), interpolation=0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (160, 120))
    made = []
    for i in range(count):
        image = np.stack([pattern + 2 * i] * 3, axis=-1).astype(np.uint8)
        made.append(image if i in sharp else cv2.GaussianBlur(image, (0, 0), 4))
        writer.write(made[i])
    writer.release()
    return made


def test_the_sharpest_frame_of_each_interval_is_taken(tmp_path, monkeypatch):
    registered = {}

    def read(path, config):
        registered.update({file.name: file for file in sorted(path.iterdir())})
        raise ValueError(f"{path}: enough")

    monkeypatch.setattr(photographs, "read_photographs", read)
    made = write_video(tmp_path / "flight.mp4", 60, sharp={3, 29, 30, 50})
    config = CaptureConfig(cache=str(tmp_path / "cache"))
    for _ in range(2):  # at the default rate of 2 Hz
        with pytest.raises(ValueError, match=r"cache/videos/\w+/frames: enough"):
            read_capture(tmp_path / "flight.mp4", config)
        assert list(registered) == [f"{i:05d}.jpg" for i in range(4)]
        brightness = [image_files.read_image(file).mean() for file in registered.values()]
        # 15 frames an interval: 0 to 14, 15 to 29, 30 to 44, 45 to 59.
        np.testing.assert_allclose(brightness, [made[i].mean() for i in (3, 29, 30, 50)], atol=3)
    config.video_rate = 10
    with pytest.raises(ValueError, match="enough"):
        read_capture(tmp_path / "flight.mp4", config)
    assert len(registered) == 20


def test_frames_that_cannot_be_written_are_not_kept(tmp_path, monkeypatch):
    write_video(tmp_path / "flight.mp4", 60, sharp=set())
    monkeypatch.setattr(cv2, "imwrite", lambda *_: False)  # as on a full disk
    with pytest.raises(OSError, match=r"frames: cannot be written .*; make room"):
        read_capture(tmp_path / "flight.mp4", CaptureConfig(cache=str(tmp_path / "cache")))
    assert not any(path.is_file() for path in (tmp_path / "cache").rglob("*"))


def test_invalid_videos_are_refused(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"something else")
    write_video(tmp_path / "b.mp4", 20, sharp=set())
    (tmp_path / "c.txt").write_text("a text")
    for name, fields, message in (
        ("a.mp4", {}, r"a\.mp4: not a readable video"),
        ("b.mp4", {}, r"b\.mp4: 20 frames in 0\.7 s give 2 of 2 a second"),
        ("b.mp4", {"video_rate": 0}, r"video_rate must be in \(0, 100\] Hz, got 0"),
        ("b.mp4", {"partners": -1}, r"partners must be in \[0, inf\), got -1"),
        ("c.txt", {}, r"c\.txt: unknown capture format.*a video"),
    ):
        with pytest.raises(ValueError, match=message):
            read_capture(tmp_path / name, CaptureConfig(cache=str(tmp_path / "cache"), **fields))
    assert not any(path.is_file() for path in (tmp_path / "cache").rglob("*"))


@pytest.fixture
def in_this_process(monkeypatch):
    """Saves the start of another process."""
    monkeypatch.setattr(photographs, "run_in_subprocess", lambda _, function, work: function(work))


def test_images_that_are_not_photographs_are_named(tmp_path, in_this_process):
    (tmp_path / "gray").mkdir()
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"gray/{i}.png"), np.full((48, 64, 3), 100, np.uint8))
    with pytest.raises(ValueError, match="3 photographs could not be registered"):
        read_capture(tmp_path / "gray", CaptureConfig(cache=str(tmp_path / "cache")))
    assert not any(path.is_file() for path in (tmp_path / "cache").rglob("*"))
    (tmp_path / "gray/1.png").rename(tmp_path / "gray/photo 1.png")
    with pytest.raises(ValueError, match=r"names must be without spaces, got 'photo 1\.png'"):
        read_capture(tmp_path / "gray")
    path = tmp_path / "photos"
    path.mkdir()
    cv2.imwrite(str(path / "depth0.png"), np.ones((8, 8), np.uint16))
    with pytest.raises(ValueError, match=r"got 0; .*depth0\.png must be a photograph, got depth"):
        read_capture(path)
    for name, message in (
        ("a.HEIC", "1 HEIC images cannot be read; convert them to JPEG"),
        ("poses_bounds.npy", r"its poses in poses_bounds\.npy are not read"),
        ("means_l.webp", "unknown capture format"),
    ):
        (path / name).write_bytes(b"ftypheic")
        with pytest.raises(ValueError, match=message):
            read_capture(path)


def test_registration_keeps_given_intrinsics_and_is_cached(tmp_path, monkeypatch):
    flight = tiled_flight()
    for i in range(5):
        cv2.imwrite(str(tmp_path / f"{i}.png"), flight.load_image(i)[..., ::-1])
    config = CaptureConfig(cache=str(tmp_path / "cache"), intrinsics=[150.0, 155.0, 160.0, 120.0])
    capture = read_capture(tmp_path, config)
    assert np.diag(capture.K).tolist() == [150.0, 155.0, 1.0] and len(capture) == 5
    model = next((tmp_path / "cache").rglob("cameras.bin")).parent
    [camera] = pycolmap.Reconstruction(model).cameras.values()
    assert camera.params.tolist() == config.intrinsics
    monkeypatch.setattr(photographs, "_register", None)
    assert len(read_capture(tmp_path, config)) == 5


POSTER_K = np.array([[140.0, 0, 80], [0, 140.0, 60], [0, 0, 1]])


def posters() -> Capture:
    """Four views of a textured plane at z = 2 m, from cameras that slide along it."""
    rng = np.random.default_rng(0)
    texture = rng.uniform(0, 255, (120, 160, 3)).astype(np.float32)  # 2.5 cm a texel
    R_WCs = [RotationMatrix.MakeYRotation(-0.05 * i) for i in range(4)]
    X_WCs = [RigidTransform(R, [0.12 * i, 0.03 * i, 0.0]) for i, R in enumerate(R_WCs)]

    def load_image(i: int) -> np.ndarray:
        rays = pixel_rays(POSTER_K, 160, 120) @ R_WCs[i].matrix().T
        p_WQ = X_WCs[i].translation() + 2.0 * rays / rays[..., 2:]
        u, v = np.moveaxis(((p_WQ[..., :2] + [1.6, 1.4]) / 0.025).astype(np.float32), -1, 0)
        return cv2.remap(texture, u, v, cv2.INTER_LINEAR).astype(np.uint8)

    return Capture("posters", "four posters", POSTER_K, 160, 120, X_WCs, load_image)


def test_triangulated_points_lie_on_the_plane(in_this_process, monkeypatch):
    capture, loaded = posters(), []

    def load_image(i: int) -> np.ndarray:
        loaded.append(i)
        return capture.load_image(i)

    watched = replace(capture, load_image=load_image)
    points, again = (triangulate(watched, [0, 1, 3]) for _ in "ab")
    np.testing.assert_array_equal(points.p_WQ, again.p_WQ)
    assert loaded == [0, 1, 3] * 2
    x, y, z = points.p_WQ.T
    assert len(z) >= 100
    assert np.median(np.abs(z - 2.0)) < 0.01
    assert np.ptp(x) > 1.5 and np.ptp(y) > 1.0
    inside, v, u = project_points(POSTER_K, points.p_WQ, 160, 120)
    difference = np.abs(points.colors[inside] - capture.load_image(0)[v, u] / 255)
    assert np.median(difference) < 0.1
    few = np.zeros((99, 3)), np.zeros((99, 3))
    monkeypatch.setattr(photographs, "run_in_subprocess", lambda *_: few)
    with pytest.raises(ValueError, match="points between its images must be at least 100, got 99"):
        triangulate(capture, [0, 1])
