import os
import re
from dataclasses import replace
from operator import matmul
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from room import CAMERA_POSES, room_views, tiled_flight, write_room_capture

from splatpilot.analysis.commands.main import main
from splatpilot.training.captures.capture import (
    OPENGL_AXES,
    Capture,
    DepthCamera,
    FileAxes,
    no_depth,
    pinhole,
)
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.captures.check import check_capture, doubts

WIDTH, HEIGHT = 160, 120
K = pinhole(110.0, 110.0, 78.0, 61.0)
NED = RotationMatrix(np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]))


@pytest.fixture(scope="module")
def room():
    views = room_views(K, WIDTH, HEIGHT)
    capture = Capture(
        *("room", "the room", K, WIDTH, HEIGHT, [view.X_WC for view in views]),
        load_image=lambda i: views[i].image,
        load_depth=lambda i: views[i].depth.astype(np.float32),
        axes=FileAxes("north-east-down", RotationMatrix(np.diag([1.0, -1, -1])), NED),
    )
    return lambda **changes: replace(capture, **changes)


def test_masked_pixels_are_not_compared(room):
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[40:90, 50:120] = False
    plain = room()
    masked = room(
        load_image=lambda i: np.where(valid[..., None], plain.load_image(i), np.uint8([255, 0, 0])),
        load_depth=lambda i: np.where(valid, plain.load_depth(i), np.float32(1)),
        load_valid=lambda i: valid,
    )
    report = check_capture(masked)
    assert report.agrees
    assert str(report).endswith("agrees") and "as it was read" in str(report)
    assert report.agreement.error < 0.005 and report.agreement.inside > 0.4
    assert report.color.cost < 0.01


def misread_quaternion(X: RigidTransform) -> RigidTransform:
    x, y, z, w = X.rotation().ToQuaternion().wxyz()
    return RigidTransform(Quaternion(np.array([w, x, y, z])), X.translation())


def posed(change):
    """Changes the poses that the files give."""

    def changed(c):
        R_WF, R_BC = RigidTransform(c.axes.R_WF), RigidTransform(c.axes.R_BC)
        X_FBs = [R_WF.inverse() @ X @ R_BC.inverse() for X in c.X_WCs]
        return {"X_WCs": [R_WF @ change(X) @ R_BC for X in X_FBs]}

    return changed


def moved(factor):
    return posed(lambda X: RigidTransform(X.rotation(), factor * X.translation()))


FLU = RotationMatrix(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]))
V, U = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
LENGTHS = np.sqrt(1 + ((U - K[0, 2]) / K[0, 0]) ** 2 + ((V - K[1, 2]) / K[1, 1]) ** 2)
NOISE = np.random.default_rng(0).integers(0, 256, (10, HEIGHT, WIDTH, 3), dtype=np.uint8)
OFFSETS = [RigidTransform(p) for p in np.random.default_rng(0).normal(0, 0.3, (10, 3))]


def scaled(factor):
    return lambda c: {"load_depth": lambda i: (factor * c.load_depth(i)).astype(np.float32)}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (posed(lambda X: X.inverse()), "poses are world to camera, read as camera to world"),
        (posed(lambda X: X @ RigidTransform(NED @ FLU.inverse())),
         "poses are those of an east-north-up body .* read as a north-east-down body"),
        (posed(lambda X: X @ RigidTransform(NED)), "poses are those of optical axes"),
        (posed(misread_quaternion), "quaternions are w x y z, read as x y z w"),
        (posed(lambda X: RigidTransform(X.rotation().inverse(), X.translation())),
         "rotations are stored column by column, read row by row"),
        (moved(np.array([1, -1, -1])), "different worlds: up and down differ"),
        (moved(10), "depth is 10 times too small, or positions too large"),
        (moved(1e-3), "depth is 1000 times too large, or positions too small"),
        (scaled(LENGTHS), "distance from the camera, read as depth along its axis"),
        (scaled(5), "depth is 5 times too large"),
        (scaled(0.001), "depth is 1000 times too small"),
        (lambda c: {"K": np.diag([2, 2, 1]) @ K}, "intrinsics belong to images 2 times as large"),
        (lambda c: {"K": np.array([[1.1, 0, 1], [0, 1.1, 1], [1, 1, 1]]) * K},
         "the focal length is wrong: 1(09|10|11)"),
        (lambda c: {"K": np.array([[1, 0, 0.8], [0, 1, 1], [1, 1, 1]]) * K},
         r"principal point is wrong: \(7[789]"),
        (lambda c: {"X_WCs": [*map(matmul, c.X_WCs, OFFSETS)]},
         "no other reading explains it"),
        (lambda c: {"load_image": lambda i: NOISE[i]}, "colors do not follow depth"),
        (lambda c: {"X_WCs": c.X_WCs[:1] * 10}, "all 10 poses are the same"),
    ],
)  # fmt: skip
def test_errors_are_named(room, change, problem):
    report = check_capture(room(**change(room())))
    assert not report.agrees
    assert re.search(problem, report.problem), str(report)


def test_color_and_depth_that_are_not_registered(room):
    X_DC = RigidTransform([0.06, 0.02, 0.0])
    K_D, K_C = pinhole(125, 125, 80, 60), pinhole(110, 110, 80, 60)
    colors = room_views(K_C, WIDTH, HEIGHT)
    depths = room_views(K_D, WIDTH, HEIGHT, [X_WC @ X_DC.inverse() for X_WC in CAMERA_POSES])
    capture = room(
        K=K_D,
        X_WCs=[view.X_WC for view in depths],
        load_image=lambda i: colors[i].image,
        load_depth=lambda i: depths[i].depth.astype(np.float32),
    )
    report = check_capture(capture)
    assert "color and depth are not registered" in report.problem
    assert report.color.focal_length == pytest.approx(110, rel=0.02)
    np.testing.assert_allclose(report.color.p_DC, X_DC.translation()[:2], atol=0.015)
    camera, X_WCs = DepthCamera(K_D, WIDTH, HEIGHT, X_DC.inverse()), [view.X_WC for view in colors]
    assert check_capture(replace(capture, K=K_C, X_WCs=X_WCs, depth_camera=camera)).agrees


def test_doubts(room):
    assert doubts(room()) == () == doubts(room(load_depth=no_depth))
    [doubt] = doubts(room(**scaled(5)(room())))
    assert "does not agree with itself, most likely depth is 5 times too large" in doubt
    [doubt] = doubts(room(load_depth=lambda i: np.zeros((HEIGHT, WIDTH), np.float32)))
    assert "not checked" in doubt and "too few pixels have depth" in doubt


def test_without_depth_and_features_nothing_is_compared(room):
    gray, notes = np.full((HEIGHT, WIDTH, 3), 128, np.uint8), ["11 of 11 images"]
    blind = room(load_depth=no_depth, load_image=lambda i: gray, metric=False, notes=notes)
    report = check_capture(blind)
    assert not report.agrees and not report.problem
    lines = str(report).splitlines()
    assert "11 of 11 images" in lines and "not compared" in lines[-1]
    assert any("scale is unknown" in line for line in lines)


@pytest.fixture(scope="module")
def flight() -> Capture:
    return tiled_flight()


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
        (lambda c: {"X_WCs": [X @ RigidTransform(OPENGL_AXES.R_BC) for X in c.X_WCs]},
         "most likely poses are those of OpenGL axes .*, read as optical axes"),
        (lambda c: {"X_WCs": [X.inverse() for X in c.X_WCs]}, "most likely poses are world to cam"),
        (lambda c: {"K": pinhole(224, 224, 160, 120)},
         r"most likely the focal length is wrong: 1(5|6)\d\.\d px"),
        (lambda c: {"load_image": lambda i: distorted(c.load_image(i), c.K, 0.25)},
         r"most likely the images are still distorted: k1 = -?0\.\d+ fits best"),
    ],
)  # fmt: skip
def test_features_without_depth_tell_errors_apart(flight, change, problem):
    report = check_capture(replace(flight, **change(flight)))
    assert report.agreement is not None and report.agrees == (not problem), report
    assert re.match(problem, report.problem), report.problem
    assert not report.undetermined


def test_flight_along_the_optical_axis_leaves_the_focal_length_open(tmp_path):
    forward = tiled_flight(turn=0.0, aside=0.0)
    for focal, angle in ((160, 90), (960, 19)):
        report = check_capture(replace(forward, K=pinhole(focal, focal, 160, 120)), pairs=4)
        message = f"px fits about as well as {focal} px, a field of view of {angle} degrees"
        assert report.agrees and message in report.undetermined and message in str(report)
    [doubt] = doubts(forward)
    assert doubt.endswith("or set capture.intrinsics")
    given = CaptureConfig(intrinsics=[160.0, 160.0, 160.0, 120.0])
    assert not check_capture(replace(forward, config=given), pairs=4).undetermined
    (tmp_path / "capture.yaml").write_text("intrinsics: [160, 160, 160, 120]\n")
    assert not check_capture(replace(forward, folder=str(tmp_path)), pairs=4).undetermined


def test_command(tmp_path, capsys):
    poses = [((0.8 + 0.3 * i, 0.1 * i, -1.2), 0.1 * i - 0.3, -0.05 * i) for i in range(8)]
    path = write_room_capture(tmp_path / "room", width=160, height=120, poses=poses)
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
def test_real_capture_agrees():
    report = check_capture(read_capture(Path(os.environ["SPLATPILOT_DATA"]) / "redkitchen"))
    assert report.agrees and 0.002 < report.agreement.error < 0.01
