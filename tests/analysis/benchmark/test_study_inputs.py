"""What a study keeps of what its flights depend on: policies, weights, scenarios, scenes."""

from dataclasses import replace

import numpy as np
import pytest

from splatpilot.analysis.benchmark import replay
from splatpilot.analysis.benchmark import run_study as benchmark
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.study_folder import (
    StudyFolder,
    input_digests,
    keep_inputs,
    kept_flights,
    kept_scenario,
)
from splatpilot.analysis.commands.main import main
from splatpilot.systems.policies import checkpoint as policy_checkpoint
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.systems.policies.diffaero import DIFFAERO_NETWORK


def test_weights_of_ones_own_fly_in_a_study_that_keeps_them(short_scenario, tmp_path, rows_of):
    shipped = PolicyCheckpoint.load("", "diffaero", DIFFAERO_NETWORK)

    def write(thrust: float) -> None:
        weights = {**shipped.weights, "head.weight": 0.0 * shipped.weights["head.weight"]}
        weights["head.bias"] = np.array([0.0, 0.0, thrust], np.float32)
        PolicyCheckpoint("diffaero", shipped.spec, weights, {}).save(tmp_path / "mine.npz")

    write(2.0)
    policies = ["diffaero", str(tmp_path / "mine.npz"), f"diffaero.1={tmp_path / 'mine.npz'}"]
    config = StudyConfig([str(short_scenario)], policies, seeds=1)
    folder = StudyFolder(tmp_path / "out")
    benchmark.run(config=config, out=folder.path, jobs=1)
    rows = rows_of(folder.path / "rollouts.csv")
    assert [row["policy"] for row in rows] == ["diffaero", "mine", "diffaero.1"]
    assert rows[0]["digest"] != rows[1]["digest"] == rows[2]["digest"]
    risen = [folder.read(spec)[1]["states"] for spec in config.rollouts()][1]
    z, v_z = risen[-1, 2] - risen[0, 2], risen[-1, 5]
    assert z > 1.0 and v_z > 2.0  # straight up, as these weights say

    write(-2.0)
    with pytest.raises(ValueError, match=r"mine.npz has changed since"):
        benchmark.run(config=config, out=folder.path, jobs=1)
    (tmp_path / "mine.npz").unlink()
    assert replay.run(study=folder.path, id="short-mine-2-000").exact


def test_variants_of_a_policy_fly_side_by_side(short_scenario, tmp_path, rows_of):
    out = tmp_path / "out"
    words = ["--scenarios", str(short_scenario), "--seeds", "1", "--jobs", "1"]
    words += ["--policies", "slow=planner:rate=2,planner", "--sweep", "straight:rate=5,10"]
    assert main(["benchmark", "--out", str(out), *words]) == 0
    folder = StudyFolder(out)
    labels = ["slow", "planner", "straight-rate-5", "straight-rate-10"]
    assert folder.config().policy_names == labels
    specs = folder.config().rollouts()
    rates = [scenario.policy.rate for _, scenario in kept_flights(folder, specs)]
    assert rates == [2.0, 15.0, 5.0, 10.0]
    rows = rows_of(out / "rollouts.csv")
    assert [row["policy"] for row in rows] == labels
    assert len({row["digest"] for row in rows}) == 4
    assert replay.run(study=out, id="short-slow-2-000").exact


def test_own_policy_of_a_scenario_flies_and_is_kept(short_scenario, tmp_path, capsys):
    shipped = PolicyCheckpoint.load("", "diffaero", DIFFAERO_NETWORK)
    mine = tmp_path / "mine.npz"
    weights = {name: 0.0 * array for name, array in shipped.weights.items()}
    PolicyCheckpoint("diffaero", shipped.spec, weights, {}).save(mine)
    own = f"policy: !DiffAeroConfig {{weights: {mine}}}\n"
    short_scenario.write_text(short_scenario.read_text() + own)
    before = short_scenario.read_text()
    out = tmp_path / "out"
    words = ["benchmark", "--scenarios", str(short_scenario), "--seeds", "1", "--jobs", "1"]
    assert main([*words, "--out", str(out)]) == 0
    assert "is not flown" not in capsys.readouterr().out
    mine.unlink()
    assert replay.run(study=out, id="short-scenario-2-000").exact
    assert short_scenario.read_text() == before
    moved = tmp_path / "moved"
    out.rename(moved)
    assert replay.run(study=moved, id="short-scenario-2-000").exact

    assert main([*words, "--out", str(tmp_path / "other"), "--policies", "straight"]) == 0
    assert f"The policy of {short_scenario} is not flown" in capsys.readouterr().out


def test_study_is_not_continued_with_other_shipped_weights(short_scenario, tmp_path, monkeypatch):
    shipped = PolicyCheckpoint.load("", "diffaero", DIFFAERO_NETWORK)
    monkeypatch.setattr(policy_checkpoint, "_SHIPPED", tmp_path)
    PolicyCheckpoint("diffaero", shipped.spec, dict(shipped.weights), {}).save(
        tmp_path / "diffaero.npz"
    )
    config = StudyConfig([str(short_scenario)], ["diffaero"], seeds=2)
    folder = StudyFolder(tmp_path / "out")
    benchmark.run(config=config, out=folder.path, jobs=1)
    assert len(folder.program()["weights of diffaero"]) == 16

    zeros = {name: 0.0 * array for name, array in shipped.weights.items()}
    PolicyCheckpoint("diffaero", shipped.spec, zeros, {}).save(tmp_path / "diffaero.npz")
    folder.trajectory("short-diffaero-2-001").unlink()
    with pytest.raises(ValueError, match="was started with weights of diffaero"):
        benchmark.run(config=config, out=folder.path, jobs=1)


def test_digest_of_a_scene_is_that_of_what_flies(place, tmp_path):
    file = tmp_path / "hall.yaml"

    def digest(scene) -> str:
        file.write_text(f"world: !SceneConfig {{path: {scene}}}\n")
        config = StudyConfig([str(file)], ["straight"], seeds=1)
        return input_digests(config, config.load_scenarios())["scene of hall"]

    scene = place.scene("hall")
    first = digest(scene)
    assert digest(scene.rename(tmp_path / "renamed")) == first
    fewer = replace(place.gaussians, means=place.gaussians.means + 0.1)
    assert digest(place.scene("moved", fewer)) != first


def test_begun_study_leaves_its_scenarios_as_they_are(place, tmp_path):
    scene = place.scene("hall")
    file = tmp_path / "hall.yaml"
    file.write_text(f"world: !SceneConfig {{path: {scene}}}\n")
    config = StudyConfig([str(file)], ["straight"], seeds=1)
    scenarios = config.load_scenarios()
    folder = StudyFolder(tmp_path / "out")
    folder.claim(config, {})
    keep_inputs(folder, config, scenarios)
    assert scenarios["hall"].world.path == str(scene)
    assert kept_scenario(folder, "hall").world.path == str(tmp_path / "out" / "scenes" / "hall")
