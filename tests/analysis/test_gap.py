import csv
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

import splatpilot as sp
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.gap import (
    GapConfig,
    Row,
    View,
    _photograph,
    captured_viewpoints,
    plan,
    run,
    summarize,
)
from splatpilot.systems.policies.base import Policy
from splatpilot.systems.policies.hypotheses import Hypotheses, hypotheses_size
from splatpilot.systems.policies.velocity import RESPONSE_TIME
from splatpilot.training.captures.capture import Capture, pixel_rays

SMALL = {"policies": ["diffaero"], "viewpoints": 3, "draws": 2, "frames": 2, "generated": ["P10"]}


@dataclass
class FixedConfig(sp.Config):
    rate: ClassVar[float] = 10.0
    camera: sp.OnboardCamera = field(default_factory=sp.OnboardCamera)


class Fixed(Policy):
    """Decides the same, and counts its images."""

    def __init__(self, output, value):
        super().__init__(FixedConfig(), "color_image")
        self.declare_state(np.zeros(len(value)), output)
        self.declare_state(np.zeros(1))
        self.value, self.seen = value, []

    def decide(self, observed, *state):
        self.seen.append((observed.time, float(state[1][0]), int(observed.image[0, 0, 0])))
        return self.value, state[1] + 1.0


START = RigidTransform([1.0, 2.0, 3.0])


def test_frames_at_which_a_vehicle_would_collide_are_left_out():
    at = [RigidTransform([0.2 * k, 0.0, 0.0]) for k in range(10)]
    capture = Capture("c", "a test", np.eye(3), 8, 8, at, lambda i: np.zeros((8, 8, 3), np.uint8))

    def distance(p_WQ):  # a wall at 1 m, and nothing known beyond 1.7 m
        return np.where(p_WQ[..., 0] > 1.7, np.nan, abs(p_WQ[..., 0] - 1.0))

    world: Any = SimpleNamespace(distance_field=SimpleNamespace(distance=distance))
    chosen = captured_viewpoints(capture, world, GapConfig(viewpoints=30, frames=1))
    assert [viewpoint.name for viewpoint in chosen] == [f"frame {k}" for k in (0, 1, 2, 3, 7, 8, 9)]


def path_of(policy, v_WB, X_WBs=(START,)):
    views = [View(np.full((36, 64, 3), n, np.uint8), np.zeros((36, 64))) for n in range(9)]
    return plan(policy, X_WBs, views[: len(X_WBs)], np.array(v_WB), np.array([9.0, 0, 0]))


def test_accelerations_are_held_for_the_response_time():
    a, v = np.array([1.0, 0.0, 0.5]), np.array([0.5, 1.0, 0.0])
    path = path_of(Fixed("acceleration", a), v)
    times = np.arange(1, 11)[:, None] * 0.1
    expected = np.where(
        times <= RESPONSE_TIME,
        v * times + 0.5 * a * times**2,
        v * times + 0.5 * a * RESPONSE_TIME**2 + a * RESPONSE_TIME * (times - RESPONSE_TIME),
    )
    np.testing.assert_allclose(path, expected + START.translation(), atol=1e-12)


def test_desired_velocities_are_reached():
    path = path_of(Fixed("velocity", np.array([1.0, 0.5, 0.0])), [0.0, 0.0, 0.0])
    np.testing.assert_allclose(np.diff(path, axis=0)[-1] / 0.1, [1.0, 0.5, 0.0], atol=1e-9)


def test_the_cheapest_hypothesis_is_the_plan():
    waypoints = np.random.default_rng(0).normal(size=(3, 10, 3))
    X_WB = RigidTransform(RollPitchYaw(0.0, 0.0, 1.0), [1.0, 0.0, 2.0])
    made = Hypotheses(0.0, X_WB, waypoints, np.array([2.0, 1.0, 3.0]))
    policy = Fixed("hypotheses", made.to_vector())
    assert len(policy.value) == hypotheses_size(3)
    path = path_of(policy, [0.0, 0.0, 0.0], [X_WB])
    np.testing.assert_allclose(path, (X_WB @ waypoints[1].T).T, atol=1e-9)


def test_memory_sees_the_images_in_turn():
    policy = Fixed("acceleration", np.zeros(3))
    path_of(policy, [1.0, 0.0, 0.0], [RigidTransform([0.1 * k, 0, 0]) for k in range(4)])
    assert policy.seen == [(k / 10.0, float(k), k) for k in range(4)]


def test_photographs_are_seen_through_the_policys_camera(seen_room):
    _, room = seen_room
    rays = pixel_rays(room.K, room.width, room.height)
    image = np.clip(128 + 100 * rays[..., [0, 1, 1]], 0, 255).astype(np.uint8)
    capture = replace(room, load_image=lambda i: image)
    K = np.array([[20.0, 0, 30], [0, 20.0, 18], [0, 0, 1]])
    color, depth, valid = _photograph(capture, 0, K, 60, 36)
    # 64x48 pixels of 1/32 rad cover 40x30 of 1/20.
    assert valid.mean() == pytest.approx(40 * 30 / (60 * 36), abs=0.06)
    assert not valid[0].any() and not valid[:, 0].any()
    expected = np.clip(128 + 100 * pixel_rays(K, 60, 36)[..., [0, 1, 1]], 0, 255)
    assert np.abs(color - expected)[valid].max() < 4.0
    assert (depth[valid] > 0.0).all()


def test_a_perfect_scene_has_no_gap_and_one_without_a_wall_has(room, capsys):
    perfect = room.scene("perfect")
    gaussians = room.gaussians
    kept = gaussians.means[:, 0] < 5.9  # all but the wall ahead
    names = ("means", "quats", "scales", "opacities", "sh")
    part = replace(gaussians, **{name: getattr(gaussians, name)[kept] for name in names})
    open_room, config = room.scene("open", part), GapConfig(**SMALL, turn=10.0)
    table = run([perfect, open_room], room.folder / "out", config)
    found, other = table["perfect"]["diffaero"], table["open"]["diffaero"]
    assert found["gap"] == 0.0 and found["plans_apart"] < 1e-6 and found["seen"] == 1.0
    assert found["real"] == found["rendered"]
    assert other["real"] == found["real"] and other["plans_apart"] > 0.05
    assert set(table["generated"]["diffaero"]) == {"generated", "generated_progress"}
    rows = list(csv.DictReader((room.folder / "out" / "gap.csv").open()))
    assert len(rows) == 3 * 2 * (2 + 2 + 1)
    assert cv2.imread(str(room.folder / "out" / "views.png")) is not None
    assert "perfect" in capsys.readouterr().out
    config = replace(config, generated=[], viewpoints=2, draws=1)
    assert set(run([perfect], room.folder / "without", config)) == {"perfect"}


def test_the_interval_is_of_viewpoints():
    rows = [
        Row("s", "p", kind, f"frame {n}", 0, 1.0, clearance, 0.0, 0.0, 0.0, 0.0)
        for n in range(20)
        for kind, clearance in (("real", 1.0 if n % 2 else -1.0), ("rendered", 1.0))
    ]
    found = summarize(rows)["s"]["p"]
    assert (found["real"], found["rendered"], found["gap"]) == (0.5, 1.0, -0.5)
    low, high = found["gap_interval"]
    assert -0.8 < low < -0.6 and -0.4 < high < -0.2  # 1.96 sqrt(0.25 / 20) = 0.22


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("policies=[straight]", "with the color or depth of a camera, got 'straight'"),
        ("policies=[planner]", "with the color or depth of a camera, got 'planner'"),
        ("seed=25000", "seed must be in [0, 24999], got 25000"),
        ("seed=-1", "seed must be in [0, 24999], got -1"),
    ],
)
def test_invalid_fields_are_errors(field, message, room, set_fields, capsys):
    words = ["gap", str(room.scene("room")), "--out", str(room.folder / "out")]
    assert main([*words, *set_fields(field)]) == 1
    assert message in capsys.readouterr().err


def test_two_scenes_of_one_name_are_refused(tmp_path):
    scenes = [tmp_path / "a/hall", tmp_path / "b/hall"]
    with pytest.raises(ValueError, match="names of scenes must be different, got hall, hall"):
        run(scenes, tmp_path / "out", GapConfig(**SMALL))
