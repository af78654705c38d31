"""Which program a result comes from."""

import hashlib
import importlib.metadata
import platform
import subprocess
import tomllib
from pathlib import Path

import cv2

_LIBRARIES = "drake", "numpy", "scipy", "scikit-fmm", "torch", "onnx"
_FOLDERS = "splatpilot", "native", "systems", "diagrams", "training", "analysis"
_SUFFIXES = ".py", ".yaml", ".cpp", ".hpp", ".npz"  # the last are weights that ship


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
    """
    Identifies this source: in a checkout by the git revision, with a digest of the source files
    that differ from it or are untracked; installed, by the version.

    A checkout of something else around the installation says nothing about it.
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
        pass  # No checkout, no git, or a checkout without a commit.
    return importlib.metadata.version("splatpilot")


class InfeasibleFlightError(ValueError):
    """
    This flight cannot be flown, though nothing is wrong with the program.

    Raised where a random world, start or goal does not leave what a flight needs: no instance of
    the world drawn from its seed has a way through, start or goal lie where the vehicle does not
    fit, or no way leads from where the planner is to its goal. Other seeds of the same scenario may
    well be flown, and so a study counts such a flight as failed and goes on; every other exception
    is a mistake in a program or a configuration, and stops it.
    """
