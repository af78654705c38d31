"""Damaged files and messages are refused in one line with their name, or read as valid values."""

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import cv2
import gsply
import numpy as np
import pycolmap
import pytest
import trimesh
from baked_scenes import random_scene
from drake import lcmt_header
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U
from room import write_room_capture

import splatpilot as sp
from splatpilot.diagrams.worlds.mesh import mesh_distance
from splatpilot.diagrams.worlds.scene_folder import read_scene, write_scene_folder
from splatpilot.systems.collision.octomap import read_octomap
from splatpilot.systems.messaging import codecs
from splatpilot.systems.messaging.lcm_ports import decode_message
from splatpilot.systems.sensing.time_of_flight import (
    FRAME_MAGIC,
    Stream,
    TimeOfFlight,
    after_packet,
)
from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.splat_files import read_splats, write_ply

WIDTH, HEIGHT, FRAMES, COUNT = 16, 12, 6, 20
R_WC = RotationMatrix(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]))
POSES = [RigidTransform(R_WC, [0.2 * i, 0.05 * i**2, 1.0]) for i in range(FRAMES)]
RNG = np.random.default_rng(0)
GAUSSIANS = random_scene(COUNT, sh_degree=1)
FOREIGN = gsply.GSData.from_arrays(
    GAUSSIANS.means,
    np.log(GAUSSIANS.scales),
    GAUSSIANS.quats,
    np.log(GAUSSIANS.opacities / (1 - GAUSSIANS.opacities)),
    GAUSSIANS.sh[:, 0],
    GAUSSIANS.sh[:, 1:],
    format="ply",
)
_STATES = RNG.integers(0, 3, (5, 4, 3), dtype=np.uint8)
ESDF = sp.Esdf(RNG.normal(size=(5, 4, 3)).astype(np.float32), _STATES, np.zeros(3), 0.5)


def write_splat(folder: Path) -> None:
    records = np.zeros(COUNT, [("p", "<f4", 3), ("s", "<f4", 3), ("bytes", "u1", 8)])
    records["p"], records["s"] = RNG.uniform(0, 3, (2, COUNT, 3))
    records["bytes"] = RNG.integers(0, 256, (COUNT, 8))
    records.tofile(folder / "scene.splat")


def write_scene(folder: Path) -> None:
    sky = EnvironmentMap(np.full((4, 8, 3), 0.5, np.float32))
    ends = np.array([0.5, 0.5, 0.5]), np.array([1.5, 1.0, 0.5])
    world = sp.World("a", GAUSSIANS, ESDF, ESDF, sky, *ends)
    write_scene_folder(folder / "scene", world, GAUSSIANS, provenance="by hand")


def write_octomap(folder: Path) -> None:
    """Writes a tree with an occupied voxel, free ones next to it and a free cube."""
    masks = [3 << 14] + [3] * 13 + [3 | 1 << 2] + [2 | 1 << 2 | 1 << 4 | 1 << 6]
    head = f"# Octomap OcTree binary file\nid OcTree\nsize {len(masks) + 5}\nres 0.5\ndata\n"
    (folder / "map.bt").write_bytes(head.encode() + np.array(masks, "<u2").tobytes())


def write_images(color: str, depth: str = "", unit: int = 1) -> None:
    """Writes the images of all frames to files by number; `unit` is that of depth per meter."""
    for i in range(FRAMES):
        pixels = np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        cv2.imwrite(color.format(i), pixels)
        if depth:
            cv2.imwrite(depth.format(i), np.full((HEIGHT, WIDTH), 2 * unit, np.uint16))


def write_tum(folder: Path) -> None:
    (folder / "rgb").mkdir()
    (folder / "depth").mkdir()
    write_images(f"{folder}/rgb/{{}}.png", f"{folder}/depth/{{}}.png", 5000)
    w, x, y, z = R_WC.ToQuaternion().wxyz()
    poses = [" ".join(map(str, (*X_WC.translation(), x, y, z, w))) for X_WC in POSES]
    images = ([f"{name}/{i}.png" for i in range(FRAMES)] for name in ("rgb", "depth"))
    for name, values in zip(("groundtruth", "rgb", "depth"), (poses, *images), strict=True):
        rows = [f"{100 + i / 30:.4f} {value}\n" for i, value in enumerate(values)]
        (folder / f"{name}.txt").write_text("# a list\n" + "".join(rows))


def write_seven_scenes(folder: Path) -> None:
    frame = f"{folder}/frame-{{:06d}}."
    write_images(frame + "color.png", frame + "depth.png", 1000)
    for i, X_WC in enumerate(POSES):
        np.savetxt(frame.format(i) + "pose.txt", X_WC.GetAsMatrix4())


def write_nerfstudio(folder: Path) -> None:
    write_images(f"{folder}/{{}}.png", f"{folder}/{{}}.depth.png", 1000)
    frames = []
    for i, X_WC in enumerate(POSES):
        matrix = (X_WC.GetAsMatrix4() @ np.diag([1, -1, -1, 1])).tolist()
        files = {"file_path": f"{i}.png", "depth_file_path": f"{i}.depth.png"}
        frames.append(files | {"transform_matrix": matrix})
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": 10.0, "cx": 8.0, "cy": 6.0, "k1": 0.01}
    (folder / "transforms.json").write_text(json.dumps(content | {"frames": frames}))


def write_colmap(folder: Path) -> None:
    (folder / "images").mkdir()
    write_images(f"{folder}/images/{{}}.png")
    model, size = pycolmap.Reconstruction(), {"width": WIDTH, "height": HEIGHT}
    lens = {"model": "PINHOLE", "params": [10.0, 10.0, 8.0, 6.0]}
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **size, **lens))
    for i, X_WC in enumerate(POSES):
        points = [pycolmap.Point2D([5.0, 5.0]), pycolmap.Point2D([9.0, 3.0])]
        image = pycolmap.Image(name=f"{i}.png", points2D=points, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(X_WC.inverse().GetAsMatrix34()))
    for k in range(2):
        track = pycolmap.Track([pycolmap.TrackElement(1, k), pycolmap.TrackElement(2, k)])
        model.add_point3D([2.0, 0.1 * k, 1.0], track, [10, 20, 30])
    (folder / "sparse/0").mkdir(parents=True)
    model.write(folder / "sparse/0")


def write_grids(folder: Path) -> None:
    """Writes the packets of a time-of-flight sensor: a grid, and an image."""
    grid = struct.pack("<IIQ", 0x544F4632, 1, 10**9)
    grid += np.full(SENSOR.rows * SENSOR.columns, 0.5, "<f4").tobytes()
    size = SENSOR.width, SENSOR.height
    image = struct.pack("<IIIHHQHH", FRAME_MAGIC, 2, 7, 0, 1, 2 * 10**9, *size)
    image += np.full(SENSOR.width * SENSOR.height, 1.5, "<f4").tobytes()
    (folder / "1").write_bytes(grid)
    (folder / "2").write_bytes(image)


def read_grids(folder: Path) -> Any:
    stream = Stream()
    for file in sorted(folder.iterdir()):
        stream = after_packet(stream, file.read_bytes(), SENSOR)
    return stream.grid


def is_finite(*arrays: Any) -> bool:
    return all(np.isfinite(np.asarray(array, dtype=float)).all() for array in arrays)


def use_gaussians(scene: Any) -> None:
    assert is_finite(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)
    K = np.array([[10.0, 0, 8], [0, 10, 6], [0, 0, 1]])
    view = sp.BakedScene(scene).render(K, 16, 12, RigidTransform([1.5, 1.5, -3.0]))
    assert is_finite(view.color, view.alpha) and not np.isnan(view.depth).any()


def use_esdf(esdf: Any) -> None:
    sample = esdf.query(((esdf.lower_W + esdf.upper_W) / 2)[None])
    assert is_finite(sample.distance, sample.gradient) and (esdf.upper_W > esdf.lower_W).all()


def use_world(world: Any) -> None:
    use_gaussians(world.gaussians)
    use_esdf(world.esdf)
    assert is_finite(world.p_WS, world.p_WG)


def use_capture(capture: Any) -> None:
    assert is_finite(capture.K, *(X_WC.GetAsMatrix4() for X_WC in capture.X_WCs))
    assert capture.K[0, 0] > 0 and capture.K[1, 1] > 0 and len(capture) >= 2
    for i in range(len(capture)):
        try:
            frame = capture.frame(i)
        except (ValueError, OSError) as error:
            assert capture.folder in str(error)
            continue
        assert frame.image.shape == (*frame.depth.shape, 3) and (frame.depth >= 0).all()
    if capture.points is not None:
        assert is_finite(capture.points.p_WQ, capture.points.colors)


def use_grid(grid: Any) -> None:
    assert grid is None or ((grid >= 0) & (grid <= 1)).all()


def read_scenario(folder: Path) -> sp.Scenario:
    scenario = sp.load_config(sp.Scenario(), folder / "scenario.yaml")
    scenario.validate()
    return scenario


def message_reader(codec: Any, value: np.ndarray) -> tuple[Any, Any, Any]:
    header = lcmt_header()
    header.seq, header.utime, header.frame_name = 1, 1_800_000_000_000_000, codec.frame
    packet = codec.pack(value, header, 0.0).encode()

    def read(folder: Path) -> Any:
        return codec.unpack(decode_message(codec, (folder / "message").read_bytes()), 0.0)

    def use(value: Any) -> None:
        assert codec.image is not None or (value.shape == (codec.size,) and is_finite(value))

    return lambda folder: (folder / "message").write_bytes(packet), read, use


SENSOR = TimeOfFlight()
STATE = np.array([1.0, 2, 3, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0])
MESSAGES = {
    "state": (codecs.StateCodec(), STATE),
    "command": (codecs.CommandCodec(), np.array([9.0, 0, 0, 0])),
    "motion capture": (codecs.MotionCaptureCodec("drone"), STATE[[0, 1, 2, 6, 7, 8, 9]]),
    "depth grid": (codecs.DepthGridCodec(4, 3, 5.0, "tof"), np.full(12, 0.5)),
    "depth": (codecs.DepthImageCodec(ImageDepth32F(8, 6), "c"), np.ones((6, 8, 1), np.float32)),
    "color": (codecs.ColorImageCodec(ImageRgba8U(8, 6), "c"), np.ones((6, 8, 4), np.uint8)),
}
UNNAMED = {"scenario", "packets", *MESSAGES}  # errors name a field, or a caller adds the sender
SPLATS = {
    "PLY": lambda folder: write_ply(GAUSSIANS, folder / "scene.ply"),
    "compressed PLY": lambda folder: gsply.plywrite(folder / "scene.ply", FOREIGN, compressed=True),
    "SPZ by gzip": lambda folder: gsply.write_spz(folder / "scene.spz", FOREIGN, version=3),
    "SPZ by zstd": lambda folder: gsply.write_spz(folder / "scene.spz", FOREIGN, version=4),
    "splat": write_splat,
}
CAPTURES = {
    "TartanAir": lambda folder: write_room_capture(folder, width=16, height=12),
    "TUM": write_tum,
    "7-Scenes": write_seven_scenes,
    "nerfstudio": write_nerfstudio,
    "COLMAP": write_colmap,
}
READERS = {
    **{
        name: (write, lambda folder: read_splats(next(folder.glob("scene.*"))), use_gaussians)
        for name, write in SPLATS.items()
    },
    **{name: (write, sp.read_capture, use_capture) for name, write in CAPTURES.items()},
    **{name: message_reader(*message) for name, message in MESSAGES.items()},
    "packets": (write_grids, read_grids, use_grid),
    "scene folder": (write_scene, lambda folder: read_scene(folder / "scene"), use_world),
    "distance field": (
        lambda folder: ESDF.save(folder / "esdf.npz"),
        lambda folder: sp.Esdf.load(folder / "esdf.npz"),
        use_esdf,
    ),
    "OctoMap": (
        write_octomap,
        lambda folder: read_octomap(folder / "map.bt").esdf(np.full(3, -2.0), np.full(3, 3.0)),
        use_esdf,
    ),
    "mesh": (
        lambda folder: trimesh.creation.box((2.0, 2.0, 2.0)).export(folder / "m.glb"),
        lambda folder: mesh_distance(folder / "m.glb", "y", 0.25),
        use_esdf,
    ),
    "scenario": (
        lambda folder: (folder / "scenario.yaml").write_text(sp.dump_config(sp.Scenario())),
        read_scenario,
        lambda scenario: None,
    ),
}
"""By kind: writes valid files into a folder, reads them, uses the result."""


@st.composite
def damage(draw: st.DrawFn, content: bytes) -> bytes:
    """Truncates the content, or overwrites up to eight bytes."""
    if draw(st.booleans()):
        return content[: draw(st.integers(0, len(content) - 1))]
    start = draw(st.integers(0, len(content) - 1))
    return content[:start] + draw(st.binary(min_size=1, max_size=8)) + content[start + 8 :]


@pytest.mark.parametrize("kind", READERS)
def test_damaged_files_are_refused_by_name_or_read_as_valid(kind, tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATPILOT_READ_LIMIT", "0.5")
    write, read, use = READERS[kind]
    valid, damaged = tmp_path / "valid", tmp_path / "damaged"
    valid.mkdir()
    write(valid)
    use(read(valid))
    files = [file for file in sorted(valid.rglob("*")) if file.is_file()]

    @settings(max_examples=25, database=None, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def check(data: st.DataObject) -> None:
        file = data.draw(st.sampled_from(files))
        content = data.draw(damage(file.read_bytes()))
        shutil.rmtree(damaged, ignore_errors=True)
        shutil.copytree(valid, damaged)
        (damaged / file.relative_to(valid)).write_bytes(content)
        try:
            value = read(damaged)
        except (ValueError, OSError, struct.error) as error:
            message = str(error)
            assert "\n" not in message and len(message) < 800
            assert str(damaged) in message or kind in UNNAMED
            return
        use(value)

    check()
