"""Damaged files: each is refused by name in one line, or read as something that can be used."""

import functools
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drake import lcmt_header
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from fuzz import samples
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.scene_folder import read_scene
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.octomap import read_octomap
from splatpilot.systems.common.config import dump_config, load_config
from splatpilot.systems.messaging import codecs
from splatpilot.systems.messaging.lcm_ports import decode_message
from splatpilot.systems.sensing.time_of_flight import (
    FRAME_MAGIC,
    Stream,
    TimeOfFlight,
    after_packet,
)
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.splat_files import read_splats, write_ply
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.render import mesh_distance


def finite(*arrays: Any) -> bool:
    return all(np.isfinite(np.asarray(array, dtype=float)).all() for array in arrays)


def use_gaussians(scene: Any) -> None:
    assert finite(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)
    K = np.array([[10.0, 0, 8], [0, 10, 6], [0, 0, 1]])
    view = BakedScene(scene).render(K, 16, 12, RigidTransform([1.5, 1.5, -3.0]))
    assert finite(view.color, view.alpha) and not np.isnan(view.depth).any()


def use_esdf(esdf: Any) -> None:
    sample = esdf.query(((esdf.lower_W + esdf.upper_W) / 2)[None])
    assert finite(sample.distance, sample.gradient) and (esdf.upper_W > esdf.lower_W).all()


def use_world(world: Any) -> None:
    use_gaussians(world.gaussians)
    use_esdf(world.esdf)
    assert finite(world.p_WS, world.p_WG)


def use_capture(capture: Any) -> None:
    assert finite(capture.K, *(X_WC.GetAsMatrix4() for X_WC in capture.X_WCs))
    assert capture.K[0, 0] > 0 and capture.K[1, 1] > 0 and len(capture) >= 2
    for i in range(len(capture)):
        try:
            frame = capture.frame(i)
        except (ValueError, OSError) as error:
            assert capture.folder in str(error)
            continue
        assert frame.image.shape == (*frame.depth.shape, 3) and (frame.depth >= 0).all()
    if capture.points is not None:
        assert finite(capture.points.p_WQ, capture.points.colors)


def read_scenario(folder: Path) -> Scenario:
    scenario = load_config(Scenario(), folder / "scenario.yaml")
    scenario.validate()
    return scenario


def read_gaussians(folder: Path) -> Any:
    return read_splats(next(folder.glob("scene.*")))


GAUSSIANS = {
    "PLY": lambda folder: write_ply(samples.gaussians(), folder / "scene.ply"),
    "ASCII PLY": samples.write_ascii_ply,
    "compressed PLY": samples.write_compressed_ply,
    "SPZ by gzip": lambda folder: samples.write_spz(folder, 3),
    "SPZ by zstd": lambda folder: samples.write_spz(folder, 4),
    "splat": samples.write_splat,
}
CAPTURES = {
    "TartanAir": samples.write_tartanair,
    "TUM": samples.write_tum,
    "7-Scenes": samples.write_seven_scenes,
    "nerfstudio": samples.write_nerfstudio,
    "COLMAP": lambda folder: samples.write_colmap(folder, False),
    "COLMAP text": lambda folder: samples.write_colmap(folder, True),
}
READERS = {
    **{name: (write, read_gaussians, use_gaussians) for name, write in GAUSSIANS.items()},
    **{name: (write, read_capture, use_capture) for name, write in CAPTURES.items()},
    "scene folder": (samples.write_scene, lambda folder: read_scene(folder / "scene"), use_world),
    "distance field": (
        lambda folder: samples.esdf().save(folder / "esdf.npz"),
        lambda folder: Esdf.load(folder / "esdf.npz"),
        use_esdf,
    ),
    "OctoMap": (
        samples.write_octomap,
        lambda folder: read_octomap(folder / "map.bt").esdf(np.full(3, -2.0), np.full(3, 3.0)),
        use_esdf,
    ),
    "mesh": (
        samples.write_mesh,
        lambda folder: mesh_distance(folder / "mesh.glb", "y", 0.25),
        use_esdf,
    ),
    "scenario": (
        lambda folder: (folder / "scenario.yaml").write_text(dump_config(Scenario())),
        read_scenario,
        lambda scenario: None,
    ),
}


@st.composite
def damages(draw: st.DrawFn, content: bytes) -> bytes:
    """The content truncated, or with up to eight bytes overwritten."""
    if draw(st.booleans()):
        return content[: draw(st.integers(0, len(content) - 1))]
    start = draw(st.integers(0, len(content) - 1))
    return content[:start] + draw(st.binary(min_size=1, max_size=8)) + content[start + 8 :]


@pytest.mark.parametrize("name", READERS)
def test_damaged_file_is_refused_by_name_or_usable(name, tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATPILOT_READ_LIMIT", "0.5")
    write, read, use = READERS[name]
    (tmp_path / "valid").mkdir()
    write(tmp_path / "valid")
    use(read(tmp_path / "valid"))
    files = [file for file in sorted((tmp_path / "valid").rglob("*")) if file.is_file()]

    @settings(max_examples=25, database=None, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def check(data: st.DataObject) -> None:
        file = data.draw(st.sampled_from(files))
        content = data.draw(damages(file.read_bytes()))
        folder = tmp_path / "damaged"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(tmp_path / "valid", folder)
        (folder / file.relative_to(tmp_path / "valid")).write_bytes(content)
        try:
            value = read(folder)
        except (ValueError, OSError) as error:
            message = str(error)
            assert "\n" not in message and len(message) < 800
            assert str(folder) in message or name == "scenario"  # which may name a field alone
            return
        use(value)

    check()


STATE = np.array([1.0, 2, 3, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0])
CODECS = [
    (codecs.StateCodec(), STATE),
    (codecs.CommandCodec(), np.array([9.0, 0, 0, 0])),
    (codecs.MotionCaptureCodec("drone"), STATE[[0, 1, 2, 6, 7, 8, 9]]),
    (codecs.DepthGridCodec(4, 3, 5.0, "tof"), np.full(12, 0.5)),
    (codecs.DepthImageCodec(ImageDepth32F(8, 6), "camera"), np.ones((6, 8, 1), np.float32)),
    (codecs.ColorImageCodec(ImageRgba8U(8, 6), "camera"), np.ones((6, 8, 4), np.uint8)),
]


@functools.cache
def packet(number: int) -> bytes:
    codec, value = CODECS[number]
    header = lcmt_header()
    header.seq, header.utime, header.frame_name = 1, 1_800_000_000_000_000, codec.frame
    return codec.pack(value, header, 0.0).encode()


@settings(max_examples=100)
@given(st.data(), st.sampled_from(range(len(CODECS))))
def test_damaged_message_is_refused_or_finite(data, number):
    codec, _ = CODECS[number]
    try:
        value = codec.unpack(decode_message(codec, data.draw(damages(packet(number)))), 0.0)
    except (ValueError, struct.error):
        return
    if codec.image is None:
        assert value.shape == (codec.size,) and finite(value)


@settings(max_examples=100)
@given(st.data())
def test_damaged_time_of_flight_packet_is_refused_or_a_proximity(data):
    sensor = TimeOfFlight()
    grid = struct.pack("<IIQ", 0x544F4632, 1, 10**9)
    grid += np.full(sensor.rows * sensor.columns, 0.5, "<f4").tobytes()
    size = sensor.width, sensor.height
    image = struct.pack("<IIIHHQHH", FRAME_MAGIC, 2, 7, 0, 1, 2 * 10**9, *size)
    image += np.full(sensor.width * sensor.height, 1.5, "<f4").tobytes()
    packets = [grid, image]
    number = data.draw(st.sampled_from([0, 1]))
    packets[number] = data.draw(damages(packets[number]))
    stream = Stream()
    for each in packets:
        try:
            stream = after_packet(stream, each, sensor)
        except (ValueError, struct.error):
            continue
    if stream.grid is not None:
        assert (stream.grid >= 0).all() and (stream.grid <= 1).all()
