import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from splatpilot.diagrams.worlds.scene_folder import SceneMetadata
from splatpilot.systems.common.config import load_config
from splatpilot.training.captures import capture_registry as module
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import (
    read_capture,
    read_scene_capture,
    register_capture,
)

_PACKAGE = """
import cv2
import numpy as np
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_registry import CaptureFormat


def read(path, config):
    f = config.intrinsics[0] if config.intrinsics else 20.0
    return Capture(
        name=path.name,
        source=f"pair {path}",
        K=np.array([[f, 0, 16], [0, f, 12], [0, 0, 1]]),
        width=32,
        height=24,
        X_WCs=[RigidTransform(), RigidTransform([0.1, 0, 0])],
        load_image=lambda i: cv2.imread(str(path / f"{i}.png")),
    )


PAIR = CaptureFormat(lambda path: (path / "pair.txt").exists(), read)
NUMBER = 3
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    packages = tmp_path / "packages"
    packages.mkdir()
    (packages / "pairs.py").write_text(_PACKAGE)
    monkeypatch.syspath_prepend(packages)
    # What a test registers is forgotten after it.
    monkeypatch.setattr(module.CAPTURES, "_entries", dict(module.CAPTURES._entries))
    capture = tmp_path / "capture"
    capture.mkdir()
    (capture / "pair.txt").touch()
    (capture / "0.png").touch()
    yield capture
    sys.modules.pop("pairs", None)


def test_format_of_another_package(folder, tmp_path):
    info = tmp_path / "packages" / "pairs-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: pairs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[splatpilot.captures]\npair = pairs:PAIR\n")
    config = CaptureConfig(intrinsics=[30.0, 30.0, 16.0, 12.0])
    capture = read_capture(folder, config)
    assert (capture.K[0, 0], len(capture), capture.folder) == (30, 2, str(folder))
    assert capture.config == config
    plain = read_capture(folder, CaptureConfig(kind="pair", cache="kept"))
    assert plain.K[0, 0] == 20 and plain.config.cache == str(Path("kept").absolute())
    assert read_capture(folder, CaptureConfig(kind="pairs:PAIR")).source == f"pair {folder}"
    for kind, message in {
        "pairs:NUMBER": "pairs:NUMBER must be a CaptureFormat",
        "pairs:NOWHERE": "'pairs:NOWHERE' is not at",
        "kinect": r"no capture format 'kinect'; there are tartanair_v1, .*photographs",
    }.items():
        with pytest.raises(ValueError, match=message):
            read_capture(folder, CaptureConfig(kind=kind))


def test_files_name_formats_of_imported_modules_alone(folder):
    (folder / "capture.yaml").write_text("kind: pairs:PAIR\n")
    scene = SceneMetadata(capture=str(folder), capture_settings=["kind=pairs:PAIR"])
    for read, file in (
        (lambda: read_capture(folder), "capture.yaml"),
        (lambda: read_scene_capture(folder, scene), "scene.yaml"),
    ):
        with pytest.raises(ValueError, match=f"{file}: kind must be .*; put --import pairs in"):
            read()
    assert "pairs" not in sys.modules
    importlib.import_module("pairs")
    assert len(read_capture(folder)) == len(read_scene_capture(folder, scene)) == 2


def test_registered_formats_are_listed(folder):
    register_capture("cubes", lambda path: False, None, description="cubes (*)")
    (folder / "0.png").unlink()
    known = "known are TartanAir V1 .*, photographs alone, a ROS bag, a video .*, cubes"
    with pytest.raises(ValueError, match=known):
        read_capture(folder)
    with pytest.raises(ValueError, match="there is a capture format 'tum' already"):
        register_capture("tum", lambda path: True, None)


def test_settings_are_the_fields_without_default_values(folder):
    config = CaptureConfig(depth_unit=1e-05, up="-y", p_DC=[0.0, 1e-7, np.pi])
    config.scale.between = ["a b.jpg@1,2", "c: #d.jpg"]
    config.scale.distance = 2.0
    settings = config.settings()
    assert [setting.partition("=")[0] for setting in settings] == [
        *("p_DC", "depth_unit", "up", "scale.between", "scale.distance")
    ]
    assert load_config(CaptureConfig(), overrides=settings) == config
    assert CaptureConfig().settings() == []
