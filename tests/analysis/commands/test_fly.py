"""`splatpilot fly`: where it writes, and what it is told."""

import json

import numpy as np
import pytest

from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight import fly
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.policies.straight import Straight

SHORT = ["--set", "world.length=10", "--set", "world.width=6", "--set", "timeout=0.5"]


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["--policy", "straight"], "forest-straight-2-000"),
        (["--policy", "mine=straight", "--speed", "1.5", "--seed", "7"], "forest-mine-1.5-007"),
        (["--scenario", "P02", "--policy", "straight"], "P02-straight-2-000"),
    ],
)
def test_default_output_is_named_as_flights_of_studies_are(words, name, tmp_path, monkeypatch):
    """By scenario or world, policy or its label, speed and seed, in the folder `out`."""
    monkeypatch.chdir(tmp_path)
    assert main(["fly", "--no-video", *words, *SHORT]) == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]
    assert (tmp_path / "out" / name / "flight.html").exists()


def test_nothing_is_overwritten_unless_told_to(tmp_path, capsys):
    """A folder that holds anything is refused, and stays as it is; with --overwrite the new flight
    takes the place of all of the old one."""
    out, graph = tmp_path / "flight", tmp_path / "diagram.dot"
    words = ["fly", "--policy", "straight", "--out", str(out), *SHORT]
    assert main(words) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert {"flight.mp4", "flight.html", "trajectory.npz"} <= set(before)
    capsys.readouterr()
    again = [*words, "--seed", "1", "--no-video"]
    assert main(again) == 1
    assert f"{out} is there already" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    graph.write_text("mine")
    assert main(["fly", *SHORT, "--out", str(tmp_path / "b"), "--graphviz", str(graph)]) == 1
    assert graph.read_text() == "mine"
    assert main([*again, "--overwrite"]) == 0
    assert not (out / "flight.mp4").exists()
    assert (out / "trajectory.npz").read_bytes() != before["trajectory.npz"]


def test_a_trajectory_is_there_before_pictures_are_made(tmp_path, monkeypatch):
    """When the page fails, the flight is not lost."""

    def fails(*arguments):
        raise OSError("the disk is full")

    monkeypatch.setattr(fly, "write_flight_page", fails)
    assert main(["fly", "--policy", "straight", "--out", str(tmp_path / "f"), *SHORT]) == 1
    assert {"trajectory.npz", "scenario.yaml"} <= {p.name for p in (tmp_path / "f").iterdir()}


def test_summary_as_json_is_all_that_is_printed(tmp_path, capsys):
    """Scripts read standard output; people still see the rest."""
    words = ["fly", "--policy", "straight", "--no-video", "--json", "--out", str(tmp_path / "f")]
    assert main([*words, *SHORT]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == json.loads((tmp_path / "f" / "summary.json").read_text())
    assert "Building the world" in printed.err


@pytest.mark.parametrize(
    ("policy", "field"),
    [("planner", "policy.lattice.speed"), ("reactive", "policy.speed"), ("scenario", None)],
)
def test_speed_is_asked_of_every_policy_alike(policy, field, tmp_path):
    """--speed is the nominal speed of whoever flies, wherever its configuration keeps it, the
    scenario's own policy included."""
    out = tmp_path / "flight"
    words = ["--no-video", "--policy", policy, "--speed", "1.5", "--out", str(out), *SHORT]
    assert main(["fly", *words]) == 0
    flown = load_config(Scenario(), out / "scenario.yaml").policy
    assert (flown.speed if field == "policy.speed" else flown.lattice.speed) == 1.5


def test_policies_are_given_as_in_the_benchmark(tmp_path):
    """Fields of a policy may stand behind its name."""
    out = tmp_path / "flight"
    words = ["--no-video", "--policy", "reactive:margin=0.3", "--out", str(out), *SHORT]
    assert main(["fly", *words]) == 0
    assert load_config(Scenario(), out / "scenario.yaml").policy.margin == 0.3


@pytest.mark.parametrize(
    ("error", "written"), [(InfeasibleFlightError("no route"), False), (KeyError("depth"), True)]
)
def test_an_exception_in_flight_leaves_the_page_and_the_flight(
    error, written, tmp_path, monkeypatch, capsys
):
    def fail_later(policy, context, discrete_state):
        if context.get_time() > 0.3:
            raise error

    monkeypatch.setattr(Straight, "_update", fail_later)
    out = tmp_path / "flight"
    words = ["--policy", "straight", "--json", "--no-video", "--out", str(out), *SHORT]
    assert main(["fly", *words]) == 1
    printed = capsys.readouterr()
    assert "the flight ended at t = 0.33 s, p_WB = [" in printed.err.splitlines()[-1]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["outcome"] == "error" and str(error) in summary["reason"]
    assert json.loads(printed.out) == summary
    assert (out / "flight.html").stat().st_size > 1e4
    assert np.load(out / "trajectory.npz")["times"][-1] == pytest.approx(0.32, abs=0.02)
    assert (out / "traceback.txt").exists() is written
