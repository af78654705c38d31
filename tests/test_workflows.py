"""The recipes of wheels, images and workflows name files, targets and commands that exist."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
import yaml

CHECKOUT = Path(__file__).parents[1]
PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())
WORKFLOWS = sorted((CHECKOUT / ".github" / "workflows").glob("*.yml"))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_use_files_targets_and_jobs_that_exist(path):
    text = path.read_text()
    workflow = yaml.load(text, yaml.BaseLoader)  # leaves `on` a string
    targets = re.findall(r"^([\w-]+):", (CHECKOUT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"\bmake ([\w-]+)", text)) <= set(targets)
    for watched in (workflow["on"]["pull_request"] or {}).get("paths", []):
        assert any(CHECKOUT.glob(watched)), watched
    for job in workflow["jobs"].values():
        assert set(job.get("needs", [])) <= set(workflow["jobs"])
        assert job["runs-on"]
        assert all(("uses" in step) != ("run" in step) for step in job["steps"])
        for step in job["steps"]:
            version_file = step.get("with", {}).get("python-version-file")
            assert version_file is None or (CHECKOUT / version_file).is_file()


def test_only_tags_are_published_and_only_that_job_may():
    workflow = yaml.safe_load((CHECKOUT / ".github/workflows/wheels.yml").read_text())
    publish = workflow["jobs"].pop("publish")
    assert "startsWith(github.ref, 'refs/tags/v')" in publish["if"]
    assert publish["permissions"] == {"id-token": "write"}
    assert set(publish["needs"]) == set(workflow["jobs"])
    assert workflow["permissions"] == {"contents": "read"}
    assert not any("permissions" in job for job in workflow["jobs"].values())


def test_wheels_are_built_for_the_declared_pythons():
    project, recipe = PROJECT["project"], PROJECT["tool"]["cibuildwheel"]
    classifiers = "\n".join(project["classifiers"])
    declared = re.findall(
        r"^Programming Language :: Python :: (3\.\d+)$", classifiers, re.MULTILINE
    )
    assert [f"3.{re.match(r'cp3(\d+)', build)[1]}" for build in recipe["build"]] == declared
    newest = int(declared[-1].removeprefix("3."))
    assert project["requires-python"] == f">={declared[0]},<3.{newest + 1}"
    named = [word for word in shlex.split(" ".join(recipe["test-command"])) if word.endswith(".py")]
    for file in recipe["test-sources"] + named:
        assert (CHECKOUT / file).exists(), file


def test_the_image_copies_all_that_a_wheel_is_built_from():
    recipe, project = (CHECKOUT / "Dockerfile").read_text(), PROJECT["project"]
    copies = re.findall(r"^COPY (.*) \S+$", recipe, re.MULTILINE)
    copied = set(" ".join(copies).split())
    assert all((CHECKOUT / name).exists() for name in copied)
    package = CHECKOUT / "splatpilot"
    links = {path.readlink().name for path in package.iterdir() if path.is_symlink()}
    read = {project["readme"], *project["license-files"], "pyproject.toml", "CMakeLists.txt"}
    assert copied == links | read | {"native", "splatpilot"}
    stages = re.split(r"^FROM ", recipe, flags=re.MULTILINE)[2:]
    assert all(re.search(r"^USER \d+$", stage, re.MULTILINE) for stage in stages)
