import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "hedgehop"
MAIN = "from splatpilot.analysis.commands.main import main; raise SystemExit(main())"


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder into which the package is installed as pip installs it."""
    source = tmp_path_factory.mktemp("source") / "hedgehop"
    shutil.copytree(EXAMPLE, source, ignore=shutil.ignore_patterns("build", "*.egg-info"))
    target = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps"]
    subprocess.run(
        [*command, "--no-build-isolation", "--target", str(target), str(source)], check=True
    )
    return target


def python(*words: str, path: Path, cwd: Path, status: int = 0) -> str:
    """Runs a Python program, and returns what it prints."""
    environment = os.environ | {"PYTHONPATH": str(path)}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    answer = subprocess.run([sys.executable, *words], cwd=cwd, env=environment, **streams)
    assert answer.returncode == status, answer.stdout
    return answer.stdout


def splatpilot(*words: str, path: Path, cwd: Path, status: int = 0) -> str:
    return python("-c", MAIN, *words, path=path, cwd=cwd, status=status)


def test_its_world_sensor_and_policy_fly_in_a_study(installed, tmp_path):
    scenario = tmp_path / "hedges.yaml"
    scenario.write_text("world: !HedgesConfig {hedges: 2, length: 16}\n")
    words = ["--scenarios", "hedges.yaml", "--policies", "climber,straight", "--seeds", "1"]
    out = splatpilot(
        "benchmark", *words, "--jobs", "1", "--out", "study", path=installed, cwd=tmp_path
    )
    rows = {line.split()[0]: line.split() for line in out.splitlines() if line}
    assert rows["climber"][2] == "1/1"
    assert "climber" in (tmp_path / "study" / "report.html").read_text()


def test_its_captures_are_read(installed, tmp_path):
    log = tmp_path / "log"
    log.mkdir()
    (log / "capture.yaml").write_text("intrinsics: [20, 20, 16, 12]\n")
    lines = ["image,x,y,z,qx,qy,qz,qw"]
    for i in range(3):
        cv2.imwrite(str(log / f"{i}.png"), np.full((24, 32, 3), 40 * i, np.uint8))
        lines.append(f"{i}.png,{0.5 * i},0,1,0,0,0,1")
    (log / "flight_log.csv").write_text("\n".join(lines) + "\n")
    program = (
        "import splatpilot as sp\n"
        "capture = sp.read_capture('log')\n"
        "print(capture.source, len(capture), capture.K[0, 0])\n"
        "print(*capture.X_WCs[2].multiply([0, 0, 1]))\n"
    )
    printed = python("-c", program, path=installed, cwd=tmp_path)
    assert printed == f"flight log {log} 3 20.0\n2.0 0.0 1.0\n"


def test_it_flies_uninstalled(tmp_path):
    (tmp_path / "hedges.yaml").write_text("world: !HedgesConfig {hedges: 2, length: 16}\n")
    imports = ["--import", "hedgehop.hedges", "--import", "hedgehop.climber"]
    words = ["--scenarios", "hedges.yaml", "--policies", "mine=hedgehop.climber:ClimberConfig"]
    out = splatpilot(
        *imports,
        *("benchmark", *words, "--seeds", "2", "--jobs", "2", "--out", "study"),
        path=EXAMPLE,
        cwd=tmp_path,
    )
    assert "2/2" in out
    words = ["replay", "study", "hedges-mine-2-000"]
    replay = splatpilot(*imports, *words, path=EXAMPLE, cwd=tmp_path)
    assert "is bitwise identical to the recorded flight" in replay
    # A study's files say what to import; only who replays it does.
    refusal = splatpilot(*imports[:2], *words, path=EXAMPLE, cwd=tmp_path, status=1)
    assert "add --import hedgehop.climber" in refusal
