"""Which program a result comes from."""

import hashlib
import importlib.metadata
import platform
import subprocess
import tomllib
from pathlib import Path

_LIBRARIES = "drake", "numpy", "scipy", "scikit-fmm"
_SOURCE = "*.py", "*.yaml", "*.cpp", "*.hpp"


def program() -> dict[str, str]:
    """The revision of this program, and the versions of what its results depend on."""
    versions = {}
    for library in _LIBRARIES:
        try:
            versions[library] = importlib.metadata.version(library)
        except importlib.metadata.PackageNotFoundError:
            versions[library] = "absent"
    return {"splatpilot": revision(), "python": platform.python_version()} | versions


def revision() -> str:
    """
    What tells this source from others: flown from its checkout, the git revision and a digest of
    what was changed in the source since; installed, the version.

    A checkout of something else around the installation says nothing about it.
    """
    checkout = Path(__file__).resolve().parents[1]

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=checkout, check=True, capture_output=True, text=True
        ).stdout

    try:
        project = tomllib.loads((checkout / "pyproject.toml").read_text())["project"]
        top_level = Path(git("rev-parse", "--show-toplevel").strip()).resolve()
        if (project["name"], top_level) == ("splatpilot", checkout):
            head = git("rev-parse", "HEAD").strip()
            changes = git("diff", "HEAD", "--", *_SOURCE)
            digest = hashlib.sha256(changes.encode()).hexdigest()[:8]
            return f"{head}+{digest}" if changes else head
    except (OSError, KeyError, tomllib.TOMLDecodeError, subprocess.CalledProcessError):
        pass  # No checkout, no git, or a checkout without a commit.
    return importlib.metadata.version("splatpilot")
