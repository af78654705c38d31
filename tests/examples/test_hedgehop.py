import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

from splatpilot.analysis.commands.main import main

EXAMPLE = Path(__file__).parents[2] / "examples" / "hedgehop"
HEDGES = "world: !HedgesConfig {hedges: 2, length: 16}\n"
PROGRAM = """
import sys
import splatpilot as sp
from splatpilot.analysis.commands.main import main

capture = sp.read_capture("log")
print(capture.source, len(capture), capture.K[0, 0])
print(*capture.X_WCs[2].multiply([0, 0, 1]))
sys.exit(main())
"""


def test_its_captures_are_read_and_its_world_sensor_and_policy_fly_if_it_is_installed(tmp_path):
    source, site, log = (tmp_path / name for name in ("hedgehop", "site", "log"))
    shutil.copytree(EXAMPLE, source, ignore=shutil.ignore_patterns("build", "*.egg-info"))
    install = "pip install --quiet --no-deps --no-build-isolation --target".split()
    subprocess.run([sys.executable, "-m", "uv", *install, site, source], check=True)

    log.mkdir()
    (log / "capture.yaml").write_text("intrinsics: [20, 20, 16, 12]\n")
    lines = ["image,x,y,z,qx,qy,qz,qw", *(f"{i}.png,{0.5 * i},0,1,0,0,0,1" for i in range(3))]
    (log / "flight_log.csv").write_text("\n".join(lines) + "\n")
    for i in range(3):
        cv2.imwrite(str(log / f"{i}.png"), np.full((24, 32, 3), 40 * i, np.uint8))
    (tmp_path / "hedges.yaml").write_text(HEDGES)
    words = "benchmark --scenarios hedges.yaml --policies climber,straight --seeds 1 --jobs 1"
    out = subprocess.run(
        [sys.executable, "-c", PROGRAM, *words.split(), "--out", "study"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(site)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    ).stdout
    assert f"flight log {log} 3 20.0\n2.0 0.0 1.0\n" in out
    assert re.search(r"^climber +2 +1/1", out, re.MULTILINE)
    assert "climber" in (tmp_path / "study" / "report.html").read_text()


def test_it_flies_uninstalled(hedgehop, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("hedges.yaml").write_text(HEDGES)
    imports = ["--import", "hedgehop.hedges", "--import", "hedgehop.climber"]
    words = "benchmark --scenarios hedges.yaml --policies mine=hedgehop.climber:ClimberConfig"
    words += " --seeds 1 --jobs 2 --out study"
    assert main([*imports, *words.split()]) == 0
    assert "1/1" in capsys.readouterr().out
    replay = ["replay", "study", "hedges-mine-2-000"]
    assert main([*imports, *replay]) == 0
    assert "is bitwise identical to the recorded flight" in capsys.readouterr().out
    # A study's files say what to import; only who replays it does.
    del sys.modules["hedgehop.climber"]
    assert main([*imports[:2], *replay]) == 1
    assert "add --import hedgehop.climber" in capsys.readouterr().err
