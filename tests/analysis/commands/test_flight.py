import json
import os
from operator import attrgetter
from pathlib import Path

import cv2
import numpy as np
import pytest

import splatpilot as sp
from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight import fly
from splatpilot.systems.policies.straight import Straight

SMALL = ["--set", "world.length=10", "--set", "world.width=6"]
SHORT = [*SMALL, "--set", "timeout=0.5", "--no-video"]


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
    monkeypatch.setattr(sp.LiveControls, "wait_for_viewer", lambda self: viewers.append(self))
    out, record = tmp_path / "flight", tmp_path / "flight.rrd"
    words = ["--live", "--draw", "thrust,axes", "--rerun", str(record), *SHORT]
    assert main(["fly", "--out", str(out), *words]) == 0
    assert len(viewers) == 1
    assert "The flight starts when you open" in capsys.readouterr().out
    assert "window.live" in (out / "live.html").read_text()
    assert record.stat().st_size > 1e5 and not list(tmp_path.glob(".*"))


def test_a_written_scenario_flies_the_same_flight_and_overwrites_the_folder(tmp_path, capsys):
    out, copy = tmp_path / "flight", tmp_path / "scenario.yaml"
    words = ["fly", "--policy", "straight", "--out", str(out)]
    assert main([*words, "--seed", "5", *(word for word in SHORT if word != "--no-video")]) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert {"flight.mp4", "flight.html", "trajectory.npz"} <= set(before)
    copy.write_bytes(before["scenario.yaml"])
    assert main([*words, "--seed", "1", *SHORT]) == 1
    assert f"{out} is there already" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    again = ["fly", "--scenario", str(copy), "--out", str(out), "--no-video", "--overwrite"]
    assert main(again) == 0
    assert not (out / "flight.mp4").exists()
    assert (out / "trajectory.npz").read_bytes() == before["trajectory.npz"]


@pytest.mark.parametrize(
    ("words", "name", "field", "value"),
    [
        ("--set policy.speed=1.5", "forest-straight-1.5-000", "speed", 1.5),
        ("--policy mine=straight --speed 1.5 --seed 7", "forest-mine-1.5-007", "speed", 1.5),
        ("--scenario P02 --policy straight", "P02-straight-2-000", "speed", 2.0),
        ("--policy planner --speed 1.5", "forest-planner-1.5-000", "lattice.speed", 1.5),
        ("--policy r=reactive:margin=0.2", "forest-r-2-000", "margin", 0.2),
        ("--policy scenario --speed 1.5", "forest-scenario-1.5-000", "lattice.speed", 1.5),
    ],
)
def test_flights_are_named_as_those_of_studies_and_have_their_policy(
    words, name, field, value, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    words = words if "--policy" in words else f"--policy straight {words}"
    assert main(["fly", "--json", *words.split(), *SHORT]) == 0
    (out,) = (tmp_path / "out").iterdir()
    assert out.name == name and (out / "flight.html").exists()
    flown = sp.load_config(sp.Scenario(), out / "scenario.yaml").policy
    assert attrgetter(field)(flown) == value
    # The summary is all that is printed on standard output.
    printed = capsys.readouterr()
    assert json.loads(printed.out) == json.loads((out / "summary.json").read_text())
    assert "Building the world" in printed.err


def test_the_trajectory_is_written_before_the_page(tmp_path, monkeypatch):
    def fail(*arguments):
        raise OSError("the disk is full")

    monkeypatch.setattr(fly, "flight_page", fail)
    assert main(["fly", "--policy", "straight", "--out", str(tmp_path / "f"), *SHORT]) == 1
    assert {"trajectory.npz", "scenario.yaml"} <= {p.name for p in (tmp_path / "f").iterdir()}


@pytest.mark.parametrize(
    ("error", "status", "outcome", "files"),
    [
        (sp.InfeasibleFlightError("no route"), 1, "error", set()),
        (KeyError("depth"), 1, "error", {"traceback.txt"}),
        (KeyboardInterrupt(), 130, "interrupted", set()),
    ],
)
def test_an_exception_in_flight_leaves_page_and_trajectory(
    error, status, outcome, files, tmp_path, monkeypatch, capsys
):
    def fail_later(policy, context, discrete_state):
        if context.get_time() > 0.3:
            raise error

    monkeypatch.setattr(Straight, "_update", fail_later)
    out = tmp_path / "flight"
    assert main(["fly", "--policy", "straight", "--json", "--out", str(out), *SHORT]) == status
    printed = capsys.readouterr()
    summary = json.loads((out / "summary.json").read_text())
    assert summary["outcome"] == outcome
    if outcome == "error":
        assert "the flight ended at t = 0.33 s, p_WB = [" in printed.err.splitlines()[-1]
        assert str(error) in summary["reason"] and json.loads(printed.out) == summary
    assert (out / "flight.html").stat().st_size > 1e4
    assert np.load(out / "trajectory.npz")["times"][-1] == pytest.approx(0.32, abs=0.02)
    assert {path.name for path in out.glob("traceback.txt")} == files


@pytest.mark.skipif("SPLATPILOT_DATA" not in os.environ, reason="SPLATPILOT_DATA is not set")
def test_flight_through_a_real_capture(tmp_path):
    whole, capture = Path(os.environ["SPLATPILOT_DATA"]) / "tartanair/hospital", tmp_path / "part"
    scene, out = tmp_path / "hospital", tmp_path / "flight"
    for part in ("image_left", "depth_left"):
        (capture / part).mkdir(parents=True)
        for file in sorted((whole / part).iterdir())[::6]:
            (capture / part / file.name).symlink_to(file)
    poses = (whole / "pose_left.txt").read_text().splitlines(keepends=True)
    (capture / "pose_left.txt").write_text("".join(poses[::6]))
    words = ["--set", "iterations=0", "--set", "voxel_size=0.1"]
    assert main(["reconstruct", str(capture), "--out", str(scene), *words]) == 0
    assert main(["fly", "--scene", str(scene), "--out", str(out), "--no-video"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["outcome"] == "goal"
    assert summary["path_length_m"] >= 5.0 and summary["min_clearance_m"] > 0.0
