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

from splatpilot.diagrams.flight.policies import BENCHMARK_POLICIES

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
    """Runs a program of the environment in a folder outside the checkout."""
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "SPLATPILOT"))}

    def run(program: str, *words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [environment / "bin" / program, *words],
            cwd=tmp_path,
            env=inherited,
            capture_output=True,
            text=True,
        )

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


def test_installation_is_light(environment, run):
    sizes = {f.stat().st_ino: f.stat().st_size for f in environment.rglob("*") if f.is_file()}
    print(f"{sum(sizes.values()) / 1e6:.0f} MB")
    assert sum(sizes.values()) < MAX_SIZE
    for package in ("torch", "torchvision", "pycolmap"):
        assert f"No module named '{package}'" in run("python", "-c", f"import {package}").stderr


def test_flies(run, tmp_path):
    (tmp_path / "short.yaml").write_text(SHORT)
    flown = run("splatpilot", "fly", "--scenario", "short.yaml", "--out", "flight")
    assert flown.returncode == 0, flown.stderr
    made = {path.name for path in (tmp_path / "flight").iterdir()}
    assert made >= {"flight.html", "flight.mp4", "trajectory.npz", "summary.json", "scenario.yaml"}


def test_benchmarks(run, tmp_path):
    (tmp_path / "short.yaml").write_text(SHORT)
    study = run(
        "splatpilot", "benchmark", "--scenarios", "short.yaml", "--seeds", "1", "--out", "study"
    )
    assert study.returncode == 0, study.stderr
    with (tmp_path / "study" / "rollouts.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sorted(row["policy"] for row in rows) == sorted(BENCHMARK_POLICIES)
    assert {row["outcome"] for row in rows} == {"timeout"}
    assert (tmp_path / "study" / "report.html").is_file()


@pytest.mark.parametrize(
    ("words", "missing", "extra"),
    [
        (["reconstruct", ".", "--out", "scene"], "torch", "train"),
        (["scene", "measure", "."], "torch", "train"),
        (["scene", "ablate", "."], "torch", "train"),
        (["scene", "fidelity", "."], "torch", "train"),
        (["train", "diffaero", "--out", "trained"], "torch", "train"),
        (["capture", "check", "photographs"], "pycolmap", "photos"),
    ],
)
def test_a_command_names_its_missing_extra(run, tmp_path, words, missing, extra):
    (tmp_path / "photographs").mkdir()
    for number in range(3):
        picture = tmp_path / "photographs" / f"{number}.jpg"
        cv2.imwrite(str(picture), np.zeros((48, 64, 3), np.uint8))
    ended = run("splatpilot", *words)
    assert ended.returncode == 1
    needed = f"{words[0]} needs {missing}; pip install 'splatpilot[{extra}]'"
    assert ended.stderr.splitlines()[-1] == f"splatpilot: {needed}"
    assert "Traceback" not in ended.stderr


def test_the_command_in_the_checkout_is_the_installed_one(environment):
    program = "import splatpilot.systems.common.registry as r; print(r.__file__)"
    answer = subprocess.run(
        [environment / "bin" / "python", "-P", "-c", program],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
    )
    assert answer.stdout.startswith(str(environment)), answer.stderr
