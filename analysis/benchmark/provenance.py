"""Which program a result comes from."""

import hashlib
import importlib.metadata
import platform
import subprocess
from pathlib import Path

_LIBRARIES = "drake", "numpy", "scipy", "scikit-fmm"


def program() -> dict[str, str]:
    """The revision of this program, and the versions of what its results depend on."""
    versions = {}
    for library in _LIBRARIES:
        try:
            versions[library] = importlib.metadata.version(library)
        except importlib.metadata.PackageNotFoundError:
            versions[library] = "absent"
    return {"splatpilot": _revision(), "python": platform.python_version()} | versions


def _revision() -> str:
    """The git revision and a digest of what was changed since; installed, the version."""
    folder = Path(__file__).resolve().parent

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=folder, check=True, capture_output=True, text=True
        ).stdout

    try:
        revision = git("rev-parse", "HEAD").strip()
        changes = git("diff", "HEAD", "--", "*.py", "*.yaml", "*.cpp", "*.hpp", ":/")
    except (OSError, subprocess.CalledProcessError):
        return importlib.metadata.version("splatpilot")
    return revision + (f"+{hashlib.sha256(changes.encode()).hexdigest()[:8]}" if changes else "")
