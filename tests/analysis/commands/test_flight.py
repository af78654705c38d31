import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight import fly
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.policies.straight import Straight, StraightConfig
from splatpilot.systems.visualization.live import LiveControls

SMALL = ["--set", "world.length=10", "--set", "world.width=6"]
SHORT = [*SMALL, "--set", "timeout=0.5", "--no-video"]


def flown_policy(out):
    return load_config(Scenario(), out / "scenario.yaml").policy


def test_fly_writes_page_video_trajectory_and_summary(tmp_path, capsys):
    out, graph = tmp_path / "flight", tmp_path / "diagram.dot"
    words = ["--seed", "2", "--graphviz", str(graph), *SMALL, "--set", "timeout=15"]
    assert main(["fly", "--out", str(out), *words]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["outcome"] == "goal" and summary["min_clearance_m"] > 0
    printed = capsys.readouterr().out
    for text in ("outcome", "goal", "minimum clearance", "real-time factor", str(out)):
        assert text in printed

    trajectory = np.load(out / "trajectory.npz")
    assert trajectory["states"].shape == (len(trajectory["times"]), 13)
    assert trajectory["times"][-1] == summary["flight_time_s"]
    video = cv2.VideoCapture(str(out / "flight.mp4"))
    frames = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    assert frames == int(summary["flight_time_s"] * 15 + 1e-6) + 1
    _, frame = video.read()
    assert frame.shape == (240, 640, 3)
    assert frame[:, :320].std() > 20 and frame[:, 320:].std() > 20  # color and depth
    assert "<html" in (out / "flight.html").read_text().lower()
    assert "digraph" in graph.read_text()
    assert not list(out.glob(".*"))


def test_live_flight_starts_with_its_viewer_and_is_recorded_for_rerun(
    tmp_path, monkeypatch, capsys
):
    viewers = []
    monkeypatch.setattr(LiveControls, "wait_for_viewer", lambda self: viewers.append(self))
    out, record = tmp_path / "flight", tmp_path / "flight.rrd"
    words = ["--live", "--draw", "thrust,axes", "--rerun", str(record), *SHORT]
    assert main(["fly", "--out", str(out), *words]) == 0
    assert len(viewers) == 1
    assert "The flight starts when you open" in capsys.readouterr().out
    assert "window.live" in (out / "live.html").read_text()
    assert record.stat().st_size > 1e5 and not list(tmp_path.glob(".*"))
    assert main(["fly", "--out", str(tmp_path / "b"), "--rerun", str(record), *SHORT]) == 1
    assert f"{record} is there already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--policy teleop", "--policy teleop must be flown with --live"),
        ("--draw axes", "--draw must be left out without --live, got axes"),
    ],
)
def test_what_needs_a_viewer_is_refused_without_one(words, message, tmp_path, capsys):
    assert main(["fly", "--out", str(tmp_path / "a"), *words.split(), *SHORT]) == 1
    assert message in capsys.readouterr().err


def test_a_written_scenario_flies_the_same_flight(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["fly", "--out", str(first), "--seed", "5", *SHORT]) == 0
    scenario = str(first / "scenario.yaml")
    assert main(["fly", "--scenario", scenario, "--out", str(second), "--no-video"]) == 0
    trajectories = [(folder / "trajectory.npz").read_bytes() for folder in (first, second)]
    assert trajectories[0] == trajectories[1]


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("--policy straight", "forest-straight-2-000"),
        ("--policy mine=straight --speed 1.5 --seed 7", "forest-mine-1.5-007"),
        ("--scenario P02 --policy straight", "P02-straight-2-000"),
    ],
)
def test_default_output_is_named_as_flights_of_studies_are(words, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["fly", *words.split(), *SHORT]) == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]
    assert (tmp_path / "out" / name / "flight.html").exists()


def test_overwrite_replaces_the_whole_folder(tmp_path, capsys):
    out = tmp_path / "flight"
    words = ["fly", "--policy", "straight", "--out", str(out), *SHORT]
    assert main([word for word in words if word != "--no-video"]) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert {"flight.mp4", "flight.html", "trajectory.npz"} <= set(before)
    assert main([*words, "--seed", "1"]) == 1
    assert f"{out} is there already" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert main([*words, "--seed", "1", "--overwrite"]) == 0
    assert not (out / "flight.mp4").exists()
    assert (out / "trajectory.npz").read_bytes() != before["trajectory.npz"]


def test_the_trajectory_is_written_before_the_page(tmp_path, monkeypatch):
    def fail(*arguments):
        raise OSError("the disk is full")

    monkeypatch.setattr(fly, "flight_page", fail)
    assert main(["fly", "--policy", "straight", "--out", str(tmp_path / "f"), *SHORT]) == 1
    assert {"trajectory.npz", "scenario.yaml"} <= {p.name for p in (tmp_path / "f").iterdir()}


def test_json_is_all_that_is_printed_on_standard_output(tmp_path, capsys):
    out = tmp_path / "flight"
    assert main(["fly", "--policy", "straight", "--json", "--out", str(out), *SHORT]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == json.loads((out / "summary.json").read_text())
    assert "Building the world" in printed.err


@pytest.mark.parametrize(
    ("policy", "field"),
    [("planner", "lattice.speed"), ("reactive:margin=0.3", "speed"), ("scenario", "lattice.speed")],
)
def test_speed_is_set_of_every_policy(policy, field, tmp_path):
    words = ["--policy", policy, "--speed", "1.5", "--out", str(tmp_path / "flight"), *SHORT]
    assert main(["fly", *words]) == 0
    flown = flown_policy(tmp_path / "flight")
    assert (flown.speed if field == "speed" else flown.lattice.speed) == 1.5
    assert getattr(flown, "margin", 0.3) == 0.3


def test_overrides_change_the_named_policy(tmp_path):
    words = ["--policy", "straight", "--set", "policy.speed=1.5", *SHORT]
    assert main(["fly", "--out", str(tmp_path / "flight"), *words]) == 0
    assert flown_policy(tmp_path / "flight") == StraightConfig(speed=1.5)
    assert np.load(tmp_path / "flight" / "trajectory.npz")["hypotheses"].shape == (0, 0)


@pytest.mark.parametrize(
    ("error", "written"), [(InfeasibleFlightError("no route"), False), (KeyError("depth"), True)]
)
def test_an_exception_in_flight_leaves_page_and_trajectory(
    error, written, tmp_path, monkeypatch, capsys
):
    def fail_later(policy, context, discrete_state):
        if context.get_time() > 0.3:
            raise error

    monkeypatch.setattr(Straight, "_update", fail_later)
    out = tmp_path / "flight"
    assert main(["fly", "--policy", "straight", "--json", "--out", str(out), *SHORT]) == 1
    printed = capsys.readouterr()
    assert "the flight ended at t = 0.33 s, p_WB = [" in printed.err.splitlines()[-1]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["outcome"] == "error" and str(error) in summary["reason"]
    assert json.loads(printed.out) == summary
    assert (out / "flight.html").stat().st_size > 1e4
    assert np.load(out / "trajectory.npz")["times"][-1] == pytest.approx(0.32, abs=0.02)
    assert (out / "traceback.txt").exists() is written


def test_ctrl_c_leaves_page_and_trajectory(tmp_path, monkeypatch):
    def interrupt(policy, context, discrete_state):
        if context.get_time() > 0.3:
            raise KeyboardInterrupt

    monkeypatch.setattr(Straight, "_update", interrupt)
    out = tmp_path / "flight"
    assert main(["fly", "--policy", "straight", "--out", str(out), *SHORT]) == 130
    assert json.loads((out / "summary.json").read_text())["outcome"] == "interrupted"
    assert (out / "flight.html").stat().st_size > 1e4


@pytest.mark.skipif("SPLATPILOT_DATA" not in os.environ, reason="SPLATPILOT_DATA is not set")
def test_flight_through_a_real_capture(tmp_path):
    whole, capture = Path(os.environ["SPLATPILOT_DATA"]) / "tartanair/hospital", tmp_path / "third"
    scene, out = tmp_path / "hospital", tmp_path / "flight"
    for part in ("image_left", "depth_left"):
        (capture / part).mkdir(parents=True)
        for file in sorted((whole / part).iterdir())[::3]:
            (capture / part / file.name).symlink_to(file)
    poses = (whole / "pose_left.txt").read_text().splitlines(keepends=True)
    (capture / "pose_left.txt").write_text("".join(poses[::3]))
    words = ["--set", "iterations=0", "--set", "voxel_size=0.1"]
    assert main(["reconstruct", str(capture), "--out", str(scene), *words]) == 0
    assert main(["fly", "--scene", str(scene), "--out", str(out)]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["outcome"] == "goal"
    assert summary["path_length_m"] >= 5.0 and summary["min_clearance_m"] > 0.0
