import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from splatpilot.analysis.benchmark import replay
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.study_folder import (
    StudyFolder,
    input_digests,
    keep_inputs,
    plugin_digests,
    source_digest,
)
from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.systems.common.provenance import program
from splatpilot.systems.policies import checkpoint
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK


class Maker:
    def __init__(self, gain):
        self.gain = gain

    def make(self, scenario, world):
        return self.gain

    __call__ = make


@pytest.mark.parametrize("held", [lambda m: m, lambda m: m.make, lambda m: partial(m.make, 1)])
def test_digests_of_functions_follow_the_values_of_their_object(held):
    first, again, other = (source_digest(held(Maker(gain))) for gain in (1.0, 1.0, 2.0))
    assert first == again != other


def test_digests_of_recursive_functions_end():
    def make(depth):
        return make(depth - 1) if depth else None

    assert len(source_digest(make)) == 16


@pytest.mark.parametrize("row", [[1, 2], 3, {}, {"success": True, "outcome": "goal"}])
def test_invalid_rows_are_damage(study, tmp_path, row):
    config, whole = study
    spec = config.rollouts()[0]
    folder = StudyFolder(tmp_path)
    (tmp_path / "rollouts").mkdir()
    arrays = StudyFolder(whole).read(spec)[1]
    if isinstance(row, dict):
        row = spec._asdict() | row
    np.savez(folder.trajectory(spec.id), row=np.array(json.dumps(row)), **arrays)
    with pytest.raises(ValueError, match=rf"{spec.id}\.npz is damaged: "):
        folder.read(spec)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must be 1, got None"),
        ("[1", "is not YAML"),
        ("format_version: 9\nstudy: {}\nprogram: {}", "must be 1, got 9; use the version"),
        ("format_version: 1", "must be a mapping, got None"),
        ("format_version: 1\nstudy: {}\nprogram: null", "must be a mapping, got None"),
        ("format_version: 1\nstudy: {sedes: 3}\nprogram: {}", "there is no field sedes"),
        ("format_version: 1\nstudy: {seeds: many}\nprogram: {}", ".*many"),
        ("format_version: 1\nstudy: {seeds: 1000000000}\nprogram: {}", "got 1000000000"),
        ("format_version: 1\nstudy: {speeds: [.nan]}\nprogram: {}", "speeds must be .* got nan"),
    ],
)
def test_invalid_descriptions_name_the_file(tmp_path, text, message):
    (tmp_path / "study.yaml").write_text(text)
    with pytest.raises(ValueError, match=rf"study\.yaml:? .*{message}"):
        StudyFolder(tmp_path).config()


def test_missing_fields_have_their_defaults(short_study, tmp_path):
    folder, file = StudyFolder(tmp_path / "out"), tmp_path / "out/study.yaml"
    folder.begin(short_study, program())
    begun = file.read_text()
    assert "  split: dev\n" in begun
    file.write_text(begun.replace("  split: dev\n", ""))
    folder.begin(short_study, program())
    with pytest.raises(ValueError, match="holds a study with split dev, not test; choose"):
        folder.begin(replace(short_study, split="test"), program())


def save_weights(file: Path, thrust: float = 0.0) -> Path:
    """Writes weights of DiffAero whose head only pulls up."""
    shipped = PolicyCheckpoint.load("", "diffaero", DIFFAERO_NETWORK)
    weights = dict(shipped.weights)
    weights["head.weight"] = 0.0 * weights["head.weight"]
    weights["head.bias"] = np.array([0.0, 0.0, thrust], np.float32)
    PolicyCheckpoint("diffaero", shipped.spec, weights, {}).save(file)
    return file


def test_weights_from_a_file_fly_and_are_kept(benchmark, tmp_path, rows_of, capsys):
    mine, folder = save_weights(tmp_path / "mine.npz", 2.0), StudyFolder(tmp_path / "out")
    words = "out", "--policies", f"diffaero,{mine},diffaero.1={mine}"
    assert benchmark(*words) == 0
    rows = rows_of(folder.path / "rollouts.csv")
    assert [row["policy"] for row in rows] == ["diffaero", "mine", "diffaero.1"]
    assert rows[0]["digest"] != rows[1]["digest"] == rows[2]["digest"]
    states = folder.read(folder.config().rollouts()[1])[1]["states"]
    assert states[-1, 2] - states[0, 2] > 1.0 and states[-1, 5] > 2.0  # straight up

    save_weights(mine, -2.0)
    assert benchmark(*words) == 1
    assert "mine.npz has changed since" in capsys.readouterr().err
    mine.unlink()
    assert replay.run(study=folder.path, id="short-mine-2-000")


def test_study_is_not_resumed_with_other_shipped_weights(benchmark, tmp_path, monkeypatch, capsys):
    save_weights(tmp_path / "diffaero.npz")
    monkeypatch.setattr(checkpoint, "_SHIPPED", tmp_path)
    words, folder = ("out", "--policies", "diffaero", "--seeds", "2"), StudyFolder(tmp_path / "out")
    assert benchmark(*words) == 0
    assert len(folder.program()["weights of diffaero"]) == 16

    save_weights(tmp_path / "diffaero.npz", 1.0)
    folder.trajectory("short-diffaero-2-001").unlink()
    assert benchmark(*words) == 1
    error = capsys.readouterr().err
    assert "weights of diffaero of" in error and "with which it was started" in error


def test_variants_of_a_policy_fly_side_by_side(benchmark, tmp_path, rows_of):
    policies = "slow=planner:rate=2,planner"
    assert benchmark("out", "--policies", policies, "--sweep", "straight:rate=5,10") == 0
    rows = rows_of(tmp_path / "out" / "rollouts.csv")
    labels = ["slow", "planner", "straight-rate-5", "straight-rate-10"]
    assert [row["policy"] for row in rows] == labels
    assert len({row["digest"] for row in rows}) == 4
    assert replay.run(study=tmp_path / "out", id="short-slow-2-000")


def test_own_policy_of_a_scenario_flies_and_is_kept(benchmark, short_scenario, tmp_path, capsys):
    mine = save_weights(tmp_path / "mine.npz")
    text = short_scenario.read_text() + f"policy: !DiffAeroConfig {{weights: {mine}}}\n"
    short_scenario.write_text(text)
    assert benchmark("out") == 0
    assert "is not flown" not in capsys.readouterr().out
    assert short_scenario.read_text() == text
    mine.unlink()
    moved = (tmp_path / "out").rename(tmp_path / "moved")
    assert replay.run(study=moved, id="short-scenario-2-000")

    assert benchmark("other", "--policies", "straight") == 0
    assert f"The policy of {short_scenario} is not flown" in capsys.readouterr().out


def scene_digest(file: Path, scene: Path, kind: str = "SceneConfig") -> str:
    """Writes a scenario in a scene, and returns the digest of the scene in a study."""
    file.write_text(f"world: !{kind} {{path: {scene}}}\n")
    config = StudyConfig([str(file)], ["straight"], seeds=1)
    (digest,) = input_digests(config, config.load_scenarios()).values()
    return digest


def test_digest_of_a_mesh_is_that_of_its_files(tmp_path):
    digests, parts = set(), [tmp_path / "hall.gltf", tmp_path / "hall.bin"]
    for contents in (("a", "a"), ("b", "a"), ("a", "b")):
        for part, content in zip(parts, contents, strict=True):
            part.write_text(content)
        digests.add(scene_digest(tmp_path / "hall.yaml", parts[0], "MeshWorld"))
    assert len(digests) == 3


def test_two_scenes_of_one_name_are_not_flown_as_one(room, tmp_path):
    (tmp_path / "other").mkdir()
    moved = room.scene("moved").rename(tmp_path / "other/hall")
    (moved / "observations.npz").write_bytes(b"other")
    files = [tmp_path / "first.yaml", tmp_path / "second.yaml"]
    for file, scene in zip(files, (room.scene("hall"), moved), strict=True):
        file.write_text(f"world: !SceneConfig {{path: {scene}}}\n")
    config, folder = StudyConfig([*map(str, files)], ["straight"]), StudyFolder(tmp_path / "out")
    folder.begin(config, {})
    with pytest.raises(ValueError, match=r"hall differs from .*scenes/hall, .*; rename it"):
        keep_inputs(folder, config, config.load_scenarios())


def test_digest_of_a_scene_is_that_of_its_flown_files(room, tmp_path):
    file, scene = tmp_path / "hall.yaml", room.scene("hall")
    first = scene_digest(file, scene)
    assert scene_digest(file, scene.rename(tmp_path / "renamed")) == first
    moved = replace(room.gaussians, means=room.gaussians.means + 0.1)
    assert scene_digest(file, room.scene("moved", moved)) != first


POLICY = """
import splatpilot
from splatpilot.systems.policies.straight import Straight, StraightConfig

class StrayingConfig(StraightConfig): ...

splatpilot.register_policy(StrayingConfig, lambda config, world, scenario: Straight(config))
"""


@pytest.mark.usefixtures("short_scenario", "registered")
def test_a_study_is_flown_by_one_version_of_a_plugin(tmp_path, capsys, monkeypatch):
    package = tmp_path / "straying"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "speed.py").write_text("SPEED = 0.5\n")
    (package / "policy.py").write_text(POLICY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))

    def read_versions() -> dict[str, str]:
        return StudyFolder(tmp_path / "study").program()

    words = ["--import", "straying.policy", "benchmark", "--scenarios", "short.yaml", "--policies"]
    words += ["straying", "--seeds", "2", "--jobs", "1", "--out", "study"]
    assert main(words) == 0
    versions = read_versions()
    assert len(versions["source of straying"]) == 16
    assert main(words) == 0  # nothing is missing

    (package / "speed.py").write_text("SPEED = 0.6\n")
    first, second = sorted((tmp_path / "study/rollouts").iterdir())
    first.unlink()
    capsys.readouterr()
    assert main(words) == 1
    assert "source of straying" in capsys.readouterr().err
    # This process has imported the version that flew.
    assert main(["--import", "straying.policy", "replay", "study", second.stem]) == 0

    second.unlink()
    assert main(words) == 0  # no flight of the other version is left
    assert read_versions()["source of straying"] != versions["source of straying"]
    assert read_versions().keys() == versions.keys()


def test_our_own_code_is_no_plugin():
    assert plugin_digests([Scenario()]) == {}
