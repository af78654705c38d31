import dataclasses
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from room import rotation_from_yaw_pitch, tiled_color, trace_room

from splatpilot.analysis.commands.main import main
from splatpilot.systems.common.config import load_config
from splatpilot.training.captures.capture import (
    OPENGL_AXES,
    OPTICAL_AXES,
    Capture,
    DepthCamera,
    FileAxes,
    no_depth,
)
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.check import check_capture, doubts

WIDTH, HEIGHT = 160, 120
K = np.array([[110.0, 0, 78.0], [0, 110.0, 61.0], [0, 0, 1]])
NED = RotationMatrix(np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]))


@pytest.fixture
def room(room_views):
    views = room_views(K, WIDTH, HEIGHT)

    def room(**changes) -> Capture:
        capture = Capture(
            name="room",
            source="the room",
            K=K,
            width=WIDTH,
            height=HEIGHT,
            X_WCs=[view.X_WC for view in views],
            load_image=lambda i: views[i].image,
            load_depth=lambda i: views[i].depth.astype(np.float32),
            axes=FileAxes("north-east-down", RotationMatrix(np.diag([1.0, -1, -1])), NED),
        )
        return dataclasses.replace(capture, **changes)

    return room


@pytest.fixture
def masked_room(room) -> Capture:
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[40:90, 50:120] = False
    plain = room()

    def load_image(i: int) -> np.ndarray:
        return np.where(valid[..., None], plain.load_image(i), np.uint8([255, 0, 0]))

    def load_depth(i: int) -> np.ndarray:
        return np.where(valid, plain.load_depth(i), np.float32(1))

    return room(load_image=load_image, load_depth=load_depth, load_valid=lambda i: valid)


def as_files(capture, change):
    R_WF, R_BC = RigidTransform(capture.axes.R_WF), RigidTransform(capture.axes.R_BC)
    return [R_WF @ change(R_WF.inverse() @ X @ R_BC.inverse()) @ R_BC for X in capture.X_WCs]


def misread_quaternion(X: RigidTransform) -> RigidTransform:
    x, y, z, w = X.rotation().ToQuaternion().wxyz()
    return RigidTransform(Quaternion(np.array([w, x, y, z])), X.translation())


def test_ideal_capture_agrees(room):
    report = check_capture(room())
    assert report.agrees and report.agreement is not None
    assert report.agreement.error < 0.005 and report.agreement.inside > 0.5
    assert report.color is not None and report.color.cost < 0.1
    assert str(report).endswith("agrees") and "as it was read" in str(report)


FLU = RotationMatrix(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda X: X.inverse(), "poses are world to camera, read as camera to world"),
        (lambda X: X @ RigidTransform(NED @ FLU.inverse()),
         "poses are those of an east-north-up body .* read as a north-east-down body"),
        (lambda X: X @ RigidTransform(NED), "poses are those of optical axes"),
        (misread_quaternion, "quaternions are w x y z, read as x y z w"),
        (lambda X: RigidTransform(X.rotation().inverse(), X.translation()),
         "rotations are stored column by column, read row by row"),
        (lambda X: RigidTransform(X.rotation(), X.translation() * [1, -1, -1]),
         "different worlds: up and down differ"),
        (lambda X: RigidTransform(X.rotation(), 10 * X.translation()),
         "depth is 10 times too small, or positions too large"),
        (lambda X: RigidTransform(X.rotation(), X.translation() / 1000),
         "depth is 1000 times too large, or positions too small"),
    ],
)  # fmt: skip
def test_wrong_poses_are_named(room, change, problem):
    capture = room()
    report = check_capture(room(X_WCs=as_files(capture, change)))
    assert not report.agrees
    assert re.search(problem, report.problem), str(report)


def scaled(factor):
    return lambda room: {"load_depth": lambda i: (factor * room().load_depth(i)).astype(np.float32)}


def ranged(room):
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    length = np.sqrt(1 + ((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2)
    return {"load_depth": lambda i: (length * room().load_depth(i)).astype(np.float32)}


def intrinsics(change):
    return lambda room: {"K": np.array(change) * K}


def noisy_poses(room):
    rng = np.random.default_rng(0)
    return {"X_WCs": [X @ RigidTransform(rng.normal(0, 0.3, 3)) for X in room().X_WCs]}


def noisy_colors(room):
    noise = np.random.default_rng(0).integers(0, 256, (10, HEIGHT, WIDTH, 3), dtype=np.uint8)
    return {"load_image": lambda i: noise[i]}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (ranged, "distance from the camera, read as depth along its axis"),
        (scaled(5), "depth is 5 times too large"),
        (scaled(0.001), "depth is 1000 times too small"),
        (intrinsics([[2], [2], [1]]), "intrinsics belong to images 2 times as large"),
        (
            intrinsics([[1.1, 0, 1], [0, 1.1, 1], [1, 1, 1]]),
            "the focal length is wrong: 1(09|10|11)",
        ),
        (intrinsics([[1, 0, 0.8], [0, 1, 1], [1, 1, 1]]), r"principal point is wrong: \(7[789]"),
        (noisy_poses, "no other reading explains it"),
        (noisy_colors, "colors do not follow depth"),
        (lambda room: {"X_WCs": [room().X_WCs[0]] * 10}, "all 10 poses are the same"),
    ],
)
def test_other_errors_are_named(room, change, problem):
    report = check_capture(room(**change(room)))
    assert not report.agrees
    assert re.search(problem, report.problem), str(report)


def test_color_and_depth_that_are_not_registered(room, room_views, room_poses):
    p_DC = np.array([0.06, 0.02, 0.0])
    K_D = np.array([[125.0, 0, 80.0], [0, 125.0, 60.0], [0, 0, 1]])
    K_C = np.array([[110.0, 0, 80.0], [0, 110.0, 60.0], [0, 0, 1]])
    X_DC = RigidTransform(p_DC)
    colors = room_views(K_C, WIDTH, HEIGHT)
    depths = room_views(K_D, WIDTH, HEIGHT, [X_WC @ X_DC.inverse() for X_WC in room_poses])
    capture = room(
        K=K_D,
        X_WCs=[view.X_WC for view in depths],
        load_image=lambda i: colors[i].image,
        load_depth=lambda i: depths[i].depth.astype(np.float32),
    )
    report = check_capture(capture)
    assert "color and depth are not registered" in report.problem
    assert report.color is not None
    assert report.color.focal_length == pytest.approx(110, rel=0.02)
    np.testing.assert_allclose(report.color.p_DC, p_DC[:2], atol=0.015)
    told = room(
        K=K_C,
        X_WCs=[view.X_WC for view in colors],
        load_image=capture.load_image,
        load_depth=capture.load_depth,
        depth_camera=DepthCamera(K_D, WIDTH, HEIGHT, X_DC.inverse()),
    )
    assert check_capture(told).agrees


def test_masked_pixels_are_not_compared(room, masked_room):
    report = check_capture(masked_room)
    assert report.agrees
    assert report.color is not None and report.color.cost < 0.01
    assert report.agreement is not None and report.agreement.error < 0.005


def test_doubts(room):
    assert doubts(room()) == () == doubts(room(load_depth=no_depth))
    [doubt] = doubts(room(**scaled(5)(room)))
    assert "does not agree with itself, most likely depth is 5 times too large" in doubt
    [doubt] = doubts(room(load_depth=lambda i: np.zeros((HEIGHT, WIDTH), np.float32)))
    assert "not checked" in doubt and "too few pixels have depth" in doubt


def test_without_depth_and_features_nothing_is_compared(room):
    report = check_capture(
        room(
            load_depth=no_depth,
            load_image=lambda i: np.full((HEIGHT, WIDTH, 3), 128, np.uint8),
            metric=False,
            notes=["11 of 11 images"],
        )
    )
    assert not report.agrees and not report.problem
    lines = str(report).splitlines()
    assert "11 of 11 images" in lines and "not compared" in lines[-1]
    assert any("scale is unknown" in line for line in lines)


@pytest.fixture(scope="module")
def flight() -> Capture:
    """A flight along a tiled room, in images of 320x240 px without depth."""
    K, poses, images = np.array([[160.0, 0, 160], [0, 160, 120], [0, 0, 1]]), [], []
    R_WN = RotationMatrix(np.diag([1.0, -1, -1]))
    for i in range(8):
        R_NB, _ = rotation_from_yaw_pitch(0.3 * np.sin(i), 0.1 * np.cos(2 * i))
        p_N = np.array([0.5 + 0.15 * i, 0.4 * np.sin(1.3 * i), -1.2 + 0.2 * np.cos(i)])
        images.append((255 * trace_room(p_N, R_NB, 320, 240, tiled_color)[1]).astype(np.uint8))
        R_WC = R_WN @ RotationMatrix(R_NB) @ NED
        poses.append(RigidTransform(R_WC, R_WN.multiply(p_N)))
    return Capture("flight", "a flight", K, 320, 240, poses, lambda i: images[i], axes=OPTICAL_AXES)


def distorted(image: np.ndarray, K: np.ndarray, k1: float) -> np.ndarray:
    v, u = np.mgrid[:240, :320] + 0.5
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    factor = 1 / (1 + k1 * (x**2 + y**2))
    maps = x * factor * K[0, 0] + K[0, 2] - 0.5, y * factor * K[1, 1] + K[1, 2] - 0.5
    return cv2.remap(image, *(m.astype(np.float32) for m in maps), cv2.INTER_LINEAR)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda c: {}, ""),
        (
            lambda c: {"X_WCs": [X @ RigidTransform(OPENGL_AXES.R_BC) for X in c.X_WCs]},
            "most likely poses are those of OpenGL axes .*, read as optical axes",
        ),
        (lambda c: {"X_WCs": [X.inverse() for X in c.X_WCs]}, "most likely poses are world to cam"),
        (
            lambda c: {"K": np.diag([1.4, 1.4, 1]) @ c.K - [[0, 0, 64], [0, 0, 48], [0, 0, 0]]},
            r"most likely the focal length is wrong: 1(5|6)\d\.\d px",
        ),
        (
            lambda c: {"load_image": lambda i: distorted(c.load_image(i), c.K, 0.25)},
            r"most likely the images are still distorted: k1 = -?0\.\d+ fits best",
        ),
    ],
)
def test_features_without_depth_tell_errors_apart(flight, change, problem):
    report = check_capture(dataclasses.replace(flight, **change(flight)))
    assert report.agreement is not None and report.agrees == (not problem), report
    assert re.match(problem, report.problem), report.problem


def test_command(tmp_path, write_room, capsys):
    poses = [((0.8 + 0.3 * i, 0.1 * i, -1.2), 0.1 * i - 0.3, -0.05 * i) for i in range(8)]
    path = write_room(tmp_path / "room", width=160, height=120, poses=poses)
    assert main(["capture", "check", str(path)]) == 0
    assert capsys.readouterr().out.rstrip().endswith("agrees")
    lines = [line.split() for line in (path / "pose_left.txt").read_text().splitlines()]
    wrong = [" ".join([*line[:3], line[6], *line[3:6]]) for line in lines]
    (path / "pose_left.txt").write_text("\n".join(wrong))
    assert main(["capture", "check", str(path)]) == 1
    captured = capsys.readouterr()
    assert "quaternions are w x y z, read as x y z w" in captured.err
    assert captured.out.rstrip().endswith("does not agree")
    assert main(["capture", "check", str(path), "--set", "pairs=0"]) == 1
    assert "pairs must be in [1, 1000], got 0" in capsys.readouterr().err


@pytest.mark.skipif("SPLATPILOT_DATA" not in os.environ, reason="SPLATPILOT_DATA is not set")
@pytest.mark.parametrize(
    ("name", "overrides", "error", "problem"),
    [
        ("tartanair/hospital", [], (0.0005, 0.001), ""),
        ("redkitchen", [], (0.002, 0.01), ""),
        ("redkitchen", ["intrinsics=[585, 585, 320, 240]", "p_DC=[0, 0, 0]"], (0.002, 0.01),
         r"not registered: a color camera of focal length 52\d px at \(\+0\.0[12]"),
    ],
)  # fmt: skip
def test_real_captures(name, overrides, error, problem):
    config = load_config(CaptureConfig(), overrides=overrides)
    report = check_capture(read_capture(Path(os.environ["SPLATPILOT_DATA"]) / name, config))
    assert report.agreement is not None and error[0] < report.agreement.error < error[1]
    assert re.search(problem, report.problem) if problem else report.agrees
