"""Provenance of results: revision and versions of the program."""

import hashlib
import importlib.metadata
import platform
import subprocess
import tomllib
from pathlib import Path

import cv2

_LIBRARIES = "drake", "numpy", "scipy", "torch", "onnx"
_FOLDERS = "splatpilot", "native", "systems", "diagrams", "training", "analysis"
_SUFFIXES = ".py", ".yaml", ".lcm", ".cpp", ".hpp", ".npz"  # with the weights that ship


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
    """Returns the git revision of this checkout, with a digest of changed and untracked source.

    Outside a checkout of splatpilot it is the version of the installation.
    """
    checkout = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=checkout, check=True, capture_output=True, text=True
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
    return importlib.metadata.version("splatpilot")


class InfeasibleFlightError(ValueError):
    """A random world, start or goal that leaves no collision-free path.

    Other seeds of the scenario may be feasible, so a study counts the flight as failed and
    continues. Every other exception stops it.
    """
