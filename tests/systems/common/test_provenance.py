import importlib.metadata
import importlib.util
import shutil
import subprocess
from itertools import combinations
from pathlib import Path

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
    identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    command = ["git", *identity, *words]
    return subprocess.run(
        command, cwd=folder, check=True, capture_output=True, text=True
    ).stdout.strip()


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
    return tmp_path


def test_checkout_says_its_commit_and_what_was_changed(checkout):
    """The revision is HEAD; changed source adds a digest of the change, changed prose nothing."""
    copied = installed(checkout)
    (checkout / "pyproject.toml").write_text('[project]\nname = "splatpilot"\n')
    (checkout / "README.md").write_text("one\n")
    source = checkout / "systems" / "other.py"
    source.write_text("x = 1\n")
    assert copied.revision() == VERSION  # of no commit yet
    head = commit(checkout)
    assert copied.revision() == head
    (checkout / "README.md").write_text("two\n")
    assert copied.revision() == head
    source.write_text("x = 2\n")
    two = copied.revision()
    source.write_text("x = 3\n")
    three = copied.revision()
    assert len({head, two, three}) == 3
    assert two.startswith(f"{head}+") and three.startswith(f"{head}+")


@pytest.mark.parametrize(
    "name", ["systems/policies/new.py", "systems/policies/weights/diffaero.npz", "native/new.hpp"]
)
def test_untracked_module_and_replaced_weights_change_the_revision(checkout, name):
    copied = installed(checkout)
    (checkout / "pyproject.toml").write_text('[project]\nname = "splatpilot"\n')
    head = commit(checkout)
    file = checkout / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b"\x00one")
    untracked = copied.revision()
    commit(checkout)
    file.write_bytes(b"\x00two")
    replaced = copied.revision()
    assert untracked.startswith(f"{head}+")
    assert replaced.startswith(f"{git(checkout, 'rev-parse', 'HEAD')}+")


def test_untracked_file_outside_the_program_does_not_change_the_revision(checkout):
    copied = installed(checkout)
    (checkout / "pyproject.toml").write_text('[project]\nname = "splatpilot"\n')
    head = commit(checkout)
    (checkout / "my_policy.py").write_text("x = 1\n")
    assert copied.revision() == head


def test_program_states_the_versions_of_what_computes_policies():
    assert {"opencv", "torch", "onnx", "numpy"} <= provenance.program().keys()


@pytest.mark.parametrize("package", ["lib/site-packages/splatpilot", "third_party/splatpilot", "."])
def test_checkout_of_something_else_says_nothing(checkout, package):
    copied = installed(checkout / package)
    if package.startswith("third_party"):
        (checkout / package / "pyproject.toml").write_text('[project]\nname = "splatpilot"\n')
    (checkout / "pyproject.toml").write_text('[project]\nname = "theirs"\n')
    commit(checkout)
    before = copied.program()
    (checkout / "theirs.py").write_text("")
    commit(checkout)
    assert before["splatpilot"] == VERSION
    assert copied.program() == before


def test_program_without_git_says_its_version(tmp_path):
    assert installed(tmp_path / "splatpilot").revision() == VERSION


def test_runs_fill_the_seeds_between_benchmark_and_validation():
    """The seeds of the thousand runs follow each other without gap or overlap, from the first that
    the benchmark leaves to the last before validation's."""
    firsts = [first_training_seed(run) for run in range(1000)]
    assert firsts == list(range(TRAINING_SEEDS, VALIDATION_SEEDS, SEEDS_PER_RUN))


def test_ranges_of_seeds_do_not_overlap():
    training = range(TRAINING_SEEDS, first_training_seed(999) + SEEDS_PER_RUN)
    validation = range(VALIDATION_SEEDS, VALIDATION_SEEDS + SEEDS_PER_RUN)
    ranges = [*STUDY_SEEDS.values(), training, validation, MONTE_CARLO_SEEDS]
    for a, b in combinations(ranges, 2):
        assert a[-1] < b[0] or b[-1] < a[0]


@pytest.mark.parametrize("run", [-1, 1000])
def test_run_without_seeds_of_its_own_is_refused(run):
    with pytest.raises(ValueError, match=rf"seed .*999\], got {run}"):
        first_training_seed(run)


@pytest.mark.parametrize(("split", "count"), [("dev", 101), ("test", 999_001), ("dev", 0)])
def test_more_seeds_than_a_split_has_are_refused(split, count):
    with pytest.raises(ValueError, match=f"got {count}"):
        study_seeds(split, count)
