import importlib.metadata
import importlib.util
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest

from splatpilot.systems.common import provenance
from splatpilot.systems.common.provenance import (
    MONTE_CARLO_SEEDS,
    SEEDS_PER_RUN,
    STUDY_SEEDS,
    TRAINING_SEEDS,
    VALIDATION_SEEDS,
    first_training_seed,
    study_seeds,
)

VERSION = importlib.metadata.version("splatpilot")


def git(folder: Path, *words: str) -> str:
    command = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", *words]
    return subprocess.check_output(command, cwd=folder, text=True).strip()


def commit(folder: Path) -> str:
    git(folder, "add", "--all")
    git(folder, "commit", "--allow-empty", "--message", "a change")
    return git(folder, "rev-parse", "HEAD")


def installed(package: Path):
    """The module as it is imported from `package`."""
    (package / "systems" / "common").mkdir(parents=True)
    file = package / "systems" / "common" / "provenance.py"
    shutil.copyfile(str(provenance.__file__), file)
    spec = importlib.util.spec_from_file_location("copied_provenance", file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def checkout(tmp_path) -> Path:
    """A git checkout without a commit."""
    git(tmp_path, "init", "--quiet")
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "splatpilot"\n')
    return tmp_path


def test_revision_is_the_commit_with_a_digest_of_changed_and_new_source(checkout):
    copied = installed(checkout)
    assert copied.revision() == VERSION  # without a commit
    (checkout / "README.md").write_text("one\n")
    head = commit(checkout)
    (checkout / "README.md").write_text("two\n")
    (checkout / "my_policy.py").write_text("x = 1\n")
    assert copied.revision() == head
    revisions = []
    for name in ("systems/common/provenance.py", "systems/new.py", "systems/a.npz", "native/a.hpp"):
        (checkout / name).parent.mkdir(exist_ok=True)
        for content in (b"\x00one", b"\x00two"):
            (checkout / name).write_bytes(content)
            revisions.append(copied.revision())
    assert len(set(revisions)) == 8
    assert all(revision.startswith(f"{head}+") for revision in revisions)


def test_program_states_the_versions_of_what_computes_policies():
    assert {"opencv", "torch", "onnx", "numpy"} <= provenance.program().keys()


@pytest.mark.parametrize("package", ["lib/site-packages/splatpilot", "third_party/splatpilot", "."])
def test_outside_a_checkout_of_its_own_the_revision_is_the_version(checkout, package):
    copied = installed(checkout / package)
    (checkout / "pyproject.toml").write_text('[project]\nname = "theirs"\n')
    if package.startswith("third_party"):
        (checkout / package / "pyproject.toml").write_text('[project]\nname = "splatpilot"\n')
    commit(checkout)
    assert copied.program()["splatpilot"] == VERSION
    shutil.rmtree(checkout / ".git")
    assert copied.revision() == VERSION


def test_revision_of_a_wheel_depends_on_its_files(checkout, monkeypatch):
    copied, revisions = installed(checkout / "lib/splatpilot"), []
    for content in ("one", "two", "one"):
        file = importlib.metadata.PackagePath("splatpilot/a.py")
        file.hash = importlib.metadata.FileHash(f"sha256={content}")
        wheel = SimpleNamespace(version="1.0", files=[file])
        monkeypatch.setattr(importlib.metadata, "distribution", lambda name, wheel=wheel: wheel)
        revisions.append(copied.revision())
    assert revisions[0] == revisions[2] != revisions[1] and revisions[0].startswith("1.0+")


def test_ranges_of_seeds_are_filled_and_do_not_overlap():
    firsts = [first_training_seed(run) for run in range(1000)]
    assert firsts == list(range(TRAINING_SEEDS, VALIDATION_SEEDS, SEEDS_PER_RUN))
    others = range(VALIDATION_SEEDS, VALIDATION_SEEDS + SEEDS_PER_RUN), MONTE_CARLO_SEEDS
    ranges = *STUDY_SEEDS.values(), range(TRAINING_SEEDS, VALIDATION_SEEDS), *others
    assert all(a[-1] < b[0] for a, b in pairwise(ranges))


@pytest.mark.parametrize(
    ("seeds", "arguments", "message"),
    [
        (first_training_seed, (-1,), r"seed .*999\], got -1"),
        (first_training_seed, (1000,), r"seed .*999\], got 1000"),
        (study_seeds, ("dev", 101), "got 101"),
        (study_seeds, ("test", 999_001), "got 999001"),
        (study_seeds, ("dev", 0), "got 0"),
    ],
)
def test_seeds_outside_their_range_are_refused(seeds, arguments, message):
    with pytest.raises(ValueError, match=message):
        seeds(*arguments)
