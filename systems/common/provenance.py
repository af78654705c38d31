"""Provenance of results: revision and versions of the program, and seeds.

Each range of seeds of worlds and flights serves one purpose, and no two ranges overlap.

| seeds | purpose |
|---|---|
| 0 to 99 | development: studies by which policies, worlds and defaults are chosen |
| 1,000 to 999,999 | test: reported studies, after the last change of policies and worlds |
| from 1,000,000 | training, `SEEDS_PER_RUN` a run |
| from 2,000,000 | validation: choose among checkpoints |
| from 3,000,000 | Monte Carlo simulations |
"""

import hashlib
import importlib.metadata
import platform
import subprocess
import tomllib
from pathlib import Path

import cv2

from splatpilot.systems.common.validation import require

_LIBRARIES = "drake", "numpy", "scipy", "torch", "onnx"
_FOLDERS = "splatpilot", "native", "systems", "diagrams", "training", "analysis"
_SUFFIXES = ".py", ".yaml", ".cpp", ".hpp", ".npz"  # with the weights that ship


def program() -> dict[str, str]:
    """Returns the revision of this program, and the versions of what its results depend on."""
    versions = {"opencv": cv2.__version__}
    for library in _LIBRARIES:
        try:
            versions[library] = importlib.metadata.version(library)
        except importlib.metadata.PackageNotFoundError:
            versions[library] = "absent"
    return {"splatpilot": revision(), "python": platform.python_version()} | versions


def revision() -> str:
    """Returns the git revision of this checkout, with a digest of changed and untracked source, or
    else the version of the installation, with a digest of the files of a wheel."""
    checkout = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        command = ["git", "-c", f"safe.directory={checkout}", *arguments]  # of any owner
        return subprocess.run(
            command, cwd=checkout, check=True, capture_output=True, text=True
        ).stdout

    try:
        project = tomllib.loads((checkout / "pyproject.toml").read_text())["project"]
        top_level = Path(git("rev-parse", "--show-toplevel").strip()).resolve()
        if (project["name"], top_level) == ("splatpilot", checkout):
            head = git("rev-parse", "HEAD").strip()
            changed = git("diff", "HEAD", "--name-only", "-z", "--", *_FOLDERS)
            untracked = git("ls-files", "--others", "--exclude-standard", "-z", "--", *_FOLDERS)
            named = (changed + untracked).split("\0")
            names = sorted(name for name in named if Path(name).suffix in _SUFFIXES)
            digest = hashlib.sha256()
            for name in names:
                file = checkout / name
                digest.update(f"{name}\0".encode())
                digest.update(file.read_bytes() if file.is_file() else b"")
            return f"{head}+{digest.hexdigest()[:8]}" if names else head
    except (OSError, KeyError, tomllib.TOMLDecodeError, subprocess.CalledProcessError):
        pass  # not a checkout, without a commit, or no git
    wheel = importlib.metadata.distribution("splatpilot")
    hashes = {f: f.hash.value for f in wheel.files or () if f.parts[0] == "splatpilot" and f.hash}
    if not any(file.suffix == ".py" for file in hashes):  # only native code, of an editable one
        return wheel.version
    text = "".join(sorted(f"{file} {value}\n" for file, value in hashes.items()))
    return f"{wheel.version}+{hashlib.sha256(text.encode()).hexdigest()[:8]}"


class InfeasibleFlightError(ValueError):
    """A random world, start or goal that leaves no collision-free path: a study counts the flight
    as failed and continues, while every other exception stops it."""


TRAINING_SEEDS = 1_000_000
VALIDATION_SEEDS = 2_000_000
SEEDS_PER_RUN = 1000

STUDY_SEEDS = {"dev": range(100), "test": range(1000, TRAINING_SEEDS)}
"""The seeds of a study, by its split."""

SPLIT_NAMES = {"dev": "development", "test": "test"}

MONTE_CARLO_SEEDS = range(3_000_000, 4_000_000)


def study_seeds(split: str, count: int) -> range:
    """Returns the first `count` seeds of a study's split."""
    require(split in STUDY_SEEDS, "split", f"one of {', '.join(STUDY_SEEDS)}", repr(split))
    seeds = STUDY_SEEDS[split]
    require(1 <= count <= len(seeds), f"seeds of split {split}", f"in [1, {len(seeds)}]", count)
    return seeds[:count]


def describe_seeds(split: str, count: int) -> str:
    """Describes the seeds of a study, as "development seeds 0 to 19"."""
    seeds = study_seeds(split, count)
    return f"{SPLIT_NAMES[split]} seeds {seeds[0]} to {seeds[-1]}"


def first_training_seed(run: int) -> int:
    """Returns the first of the `SEEDS_PER_RUN` seeds of a training run, named by its own seed."""
    runs = (VALIDATION_SEEDS - TRAINING_SEEDS) // SEEDS_PER_RUN
    require(0 <= run < runs, "seed", f"in [0, {runs - 1}]", run)
    return TRAINING_SEEDS + run * SEEDS_PER_RUN
