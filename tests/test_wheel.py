import csv
import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatpilot.analysis.benchmark.variants import BENCHMARK_POLICIES

CHECKOUT = Path(__file__).parents[1]
PACKAGE = CHECKOUT / "splatpilot"
MAX_SIZE = 1.2e9
"""[bytes], of an installation that flies."""
SHORT = "world: {length: 10, width: 6}\ntimeout: 1\n"
UV = sys.executable, "-m", "uv", "--quiet"


@pytest.fixture(scope="module")
def distributions(tmp_path_factory) -> tuple[Path, Path]:
    """The source distribution and the wheel of the checkout, whose build is taken on."""
    out = tmp_path_factory.mktemp("distributions")
    build = *UV, "build", "--no-build-isolation", "--python", sys.executable, "--out-dir", out
    for kind in ("--sdist", "--wheel"):
        subprocess.run([*build, kind, CHECKOUT], check=True)
    return next(out.glob("*.tar.gz")), next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def environment(distributions, tmp_path_factory) -> Path:
    """An environment that holds the wheel and none of its extras."""
    folder = tmp_path_factory.mktemp("environment")
    python = folder / "bin" / "python"
    subprocess.run([*UV, "venv", "--clear", "--python", sys.executable, folder], check=True)
    subprocess.run(
        [*UV, "pip", "install", "--no-build", "--python", python, distributions[1]], check=True
    )
    return folder


@pytest.fixture
def run(environment, tmp_path):
    """Runs a program of the environment, in a folder outside the checkout."""
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "SPLATPILOT"))}

    def run(program: str, *words: str, cwd: Path = tmp_path) -> subprocess.CompletedProcess[str]:
        command = [environment / "bin" / program, *words]
        return subprocess.run(command, cwd=cwd, env=inherited, capture_output=True, text=True)

    return run


def test_distributions_are_complete(distributions):
    sdist, wheel = distributions
    files = {
        f"splatpilot/{path.relative_to(PACKAGE).as_posix()}"
        for folder in (PACKAGE, *filter(Path.is_dir, PACKAGE.iterdir()))
        for path in (folder.iterdir() if folder == PACKAGE else folder.rglob("*.*"))
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert "splatpilot/systems/policies/weights/diffaero.npz" in files
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    native = {
        name for name in names if name.startswith("splatpilot/_native.") and name.endswith("so")
    }
    assert len(native) == 1
    assert names - native == files
    sources = {path.relative_to(CHECKOUT).as_posix() for path in CHECKOUT.glob("native/*/*.[ch]pp")}
    sources |= {"CMakeLists.txt", "LICENSE", "README.md", "pyproject.toml"}
    with tarfile.open(sdist) as archive:
        assert files | sources < {name.partition("/")[2] for name in archive.getnames()}


def test_installation_is_light_and_apart_from_the_checkout(environment, run):
    sizes = {f.stat().st_ino: f.stat().st_size for f in environment.rglob("*") if f.is_file()}
    print(f"{sum(sizes.values()) / 1e6:.0f} MB")
    assert sum(sizes.values()) < MAX_SIZE
    find = "[find_spec(name) for name in ('torch', 'torchvision', 'pycolmap')]"
    program = "from importlib.util import find_spec; import splatpilot.systems.common.registry as r"
    found = run("python", "-P", "-c", f"{program}; print(r.__file__, *{find})", cwd=CHECKOUT)
    file, *extras = found.stdout.split()
    assert file.startswith(str(environment)), found.stderr
    assert extras == ["None"] * 3


def test_flies(run, tmp_path):
    (tmp_path / "short.yaml").write_text(SHORT)
    flown = run("splatpilot", "fly", "--scenario", "short.yaml", "--out", "flight")
    assert flown.returncode == 0, flown.stderr
    made = {path.name for path in (tmp_path / "flight").iterdir()}
    assert made >= {"flight.html", "flight.mp4", "trajectory.npz", "summary.json", "scenario.yaml"}


def test_benchmarks(run, tmp_path):
    (tmp_path / "short.yaml").write_text(SHORT)
    words = "benchmark", "--scenarios", "short.yaml", "--seeds", "1", "--jobs", "1"
    study = run("splatpilot", *words, "--out", "study")
    assert study.returncode == 0, study.stderr
    with (tmp_path / "study" / "rollouts.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sorted(row["policy"] for row in rows) == sorted(BENCHMARK_POLICIES)
    assert {row["outcome"] for row in rows} == {"timeout"}
    assert (tmp_path / "study" / "report.html").is_file()


EXTRAS = {
    "reconstruct . --out scene": ("torch", "train"),
    "scene measure small_house": ("torch", "train"),
    "scene ablate .": ("torch", "train"),
    "scene fidelity small_house": ("torch", "train"),
    "train diffaero --out trained": ("torch", "train"),
    "capture check photographs": ("pycolmap", "photos"),
}
RUN_ALL = """
import sys
from splatpilot.analysis.commands.main import main
assert [main(line.split()) for line in sys.argv[1:]] == [1] * len(sys.argv[1:])
"""


def test_commands_name_their_missing_extras(run, tmp_path):
    (tmp_path / "photographs").mkdir()
    for number in range(3):
        picture = tmp_path / "photographs" / f"{number}.jpg"
        cv2.imwrite(str(picture), np.zeros((48, 64, 3), np.uint8))
    ended = run("python", "-c", RUN_ALL, *EXTRAS)
    assert ended.returncode == 0 and "Traceback" not in ended.stderr, ended.stderr
    errors = [line for line in ended.stderr.splitlines() if line.startswith("splatpilot: ")]
    assert errors == [
        f"splatpilot: {line.split()[0]} needs {missing}; pip install 'splatpilot[{extra}]'"
        for line, (missing, extra) in EXTRAS.items()
    ]
