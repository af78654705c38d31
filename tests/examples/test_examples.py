import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from splatpilot.training.captures import render as render_capture
from splatpilot.training.captures.render import RenderConfig

EXAMPLES = Path(__file__).parents[2] / "examples"
FILES = sorted(EXAMPLES.glob("*.py"))
MAIN = "from splatpilot.analysis.commands.main import main; raise SystemExit(main())"
SHORT = "world: {length: 9, width: 6}\ntimeout: 12\n"


def python(*words: object, cwd: Path) -> str:
    """Runs a Python program; returns its output."""
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout


def run(name: str, *words: object, cwd: Path) -> str:
    """Runs an example; returns its output."""
    return python(EXAMPLES / name, *words, cwd=cwd)


def number(pattern: str, text: str) -> float:
    """Returns the number that a pattern matches in a text."""
    found = re.search(pattern, text)
    assert found is not None, text
    return float(found[1])


@pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])
def test_each_is_short_begins_with_its_command_and_has_a_test(file):
    docstring = file.read_text().split('"""')[1]
    assert re.search(rf"\n    .*\b{file.stem}\b", docstring)
    assert len(file.read_text().splitlines()) <= 75
    assert f'"{file.name}"' in Path(__file__).read_text()


def test_flight_by_hand(tmp_path):
    out = run("flight_by_hand.py", "--length", 9, cwd=tmp_path)
    assert "s at the goal" in out
    assert number(r"clearance (\S+) m", out) > 0
    assert 20 < number(r"mean (\d+)", out) < 240


def test_splats_behind_drake(opengl, tmp_path):
    red = []
    for seconds in (0.0, 0.2, 0.5):
        words = "--width", 240, "--seconds", seconds, "--out", tmp_path / "sphere.png"
        run("splats_behind_drake.py", *words, cwd=tmp_path)
        image = np.array(cv2.imread(str(tmp_path / "sphere.png")), dtype=int)
        is_red = image[..., 2] > 100 + image[..., :2].max(axis=-1)
        assert image[~is_red].std() > 20
        red.append(int(is_red.sum()))
    assert red[1] == 0 and 0 < red[0] < 0.6 * red[2]


def test_bouncing_sphere(tmp_path):
    run("bouncing_sphere.py", "--out", tmp_path / "sphere.csv", cwd=tmp_path)
    _, _, _, z, clearance = np.loadtxt(tmp_path / "sphere.csv", delimiter=",", skiprows=1).T
    first = np.flatnonzero(np.diff(z) > 0)[0]
    assert z[0] - z[first] > 1.0
    assert z[first:].max() > z[first] + 0.05
    assert np.abs(clearance[-25:]).max() < 0.05 and clearance.min() > -0.1


def test_own_policy(tmp_path):
    (tmp_path / "own_policy.py").write_text((EXAMPLES / "own_policy.py").read_text())
    (tmp_path / "short.yaml").write_text(SHORT)
    words = ["--policies", "sidestep=own_policy:SidestepConfig", "--scenarios", "short.yaml"]
    words = ["--import", "own_policy", "benchmark", *words, "--seeds", "1", "--jobs", "1"]
    out = python("-c", MAIN, *words, "--out", "study", cwd=tmp_path)
    assert re.search(r"sidestep +2 +1/1", out)


def test_unregistered_own_policy_flies_in_worker_processes(tmp_path):
    own = (EXAMPLES / "own_policy.py").read_text().replace("sp.register_policy(", "build = (")
    kind = 'PolicyEntry(*build, speed_field="speed")'
    own += f"\nfrom splatpilot.diagrams.flight.policies import PolicyEntry\nKIND = {kind}\n"
    (tmp_path / "loose_policy.py").write_text(own)
    (tmp_path / "short.yaml").write_text(SHORT)
    words = ["benchmark", "--policies", "mine=loose_policy:KIND", "--scenarios", "short.yaml"]
    out = python("-c", MAIN, *words, "--seeds", "2", "--jobs", "2", "--out", "study", cwd=tmp_path)
    assert re.search(r"mine +2 +2/2", out)


def test_photographs_to_flight(opengl, tmp_path):
    room = trimesh.creation.box((7.0, 4.0, 3.0))
    room.invert()
    room.export(tmp_path / "room.obj", include_normals=True)
    config = RenderConfig(
        width=64, height=48, path=[[-2, 0, 0], [2, 0, 0]], spacing=1, yaws=[0, 90, 180, -90], up="z"
    )
    render_capture.run(world=tmp_path / "room.obj", out=tmp_path / "photos", config=config)
    out = run("photographs_to_flight.py", "photos", "--iterations", 20, cwd=tmp_path)
    assert re.search(r"outcome +goal", out)
    assert (tmp_path / "out/photos/flight/flight.html").is_file()


def test_monte_carlo(tmp_path):
    (tmp_path / "short.yaml").write_text(SHORT)
    words = ["--scenarios", "short.yaml", "--seeds", 1, "--jobs", 1]
    out = run("monte_carlo.py", *words, cwd=tmp_path)
    summary = out[out.index("policy   observation") :]
    assert re.findall(r"(clean|noisy) +1 ", summary) == ["clean", "noisy"] * 2
    assert "of 2 flights arrive without noise" in out


def test_distance_gradient(tmp_path):
    out = run("distance_gradient.py", "--points", 4000, cwd=tmp_path)
    assert number(r"predict to (\S+) m", out) < 1e-6
    assert number(r"(\d+)% have clearance", out) > 95


def test_lqr_hover(tmp_path):
    out = run("lqr_hover.py", cwd=tmp_path)
    assert number(r"from (\S+) s on", out) < 5
    assert number(r", (\S+) mm", out) < 0.5


def test_crash_replayed(tmp_path):
    wall = "world: !WallsConfig {pattern: big_wall, length: 14, width: 14, wall: 8}\n"
    (tmp_path / "wall.yaml").write_text(wall)
    out = run("crash_replayed.py", "--scenario", "wall.yaml", cwd=tmp_path)
    assert "is bitwise identical to the recorded flight" in out
    assert number(r"along \[(\S+),", out) == pytest.approx(1.0, abs=0.05)
    speed = number(r"at (\S+) m/s", out)
    ahead = number(r"was (\S+) m away", out)
    assert ahead == pytest.approx(0.5 * speed + 0.354 - 0.1, abs=0.25)
    assert (tmp_path / "out/crash/before.png").is_file()


def test_drakes_quadrotor(tmp_path):
    out = run("drakes_quadrotor.py", "--seconds", 1, "--out", "flight.mp4", cwd=tmp_path)
    assert number(r"flown \[(\S+),", out) > 0.5
    video = cv2.VideoCapture(str(tmp_path / "flight.mp4"))
    assert video.read()[0]
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == pytest.approx(15, abs=1)
