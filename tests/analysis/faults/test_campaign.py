import json
import shutil

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.faults import campaign

SETTINGS = ["world.length=10.0", "world.width=6.0", "start_radius=0.05"]
SETS = [word for setting in SETTINGS for word in ("--set", f"scenario.{setting}")]
WORDS = ["hardware", "faults", "--set", "worlds=1", *SETS]


def test_a_trial_of_a_campaign_is_safe(tmp_path):
    assert main([*WORDS, "--set", "trials=1", "--out", str(tmp_path)]) == 0
    [row] = map(json.loads, (tmp_path / "trials.jsonl").read_text().splitlines())
    assert row["safe"] and row["faults"][0]["kind"] == "dropped"
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["trials"], summary["safe"]) == (1, 1)


def test_a_campaign_resumes_and_repeats(tmp_path, monkeypatch):
    def fly_trial(scenario, world, trial, limits, seed):
        faults = [{"kind": fault.kind, "begin": fault.begin} for fault in trial.faults]
        return {"faults": faults, "seed": seed, "safe": True, "outcome": "hover"}

    monkeypatch.setattr(campaign, "fly_trial", fly_trial)
    words, again = [*WORDS, "--set", "trials=3"], tmp_path / "again"
    assert main([*words, "--out", str(tmp_path / "whole")]) == 0
    rows = (tmp_path / "whole" / "trials.jsonl").read_text().splitlines(keepends=True)
    again.mkdir()
    shutil.copy(tmp_path / "whole" / "config.yaml", again)
    (again / "trials.jsonl").write_text(rows[0])
    assert main([*words, "--out", str(again)]) == 0
    assert (again / "trials.jsonl").read_text() == "".join(rows)
    assert json.loads(rows[2])["seed"] == 2
    for other in ("seed=1", "trials=0"):
        assert main([*words, "--set", other, "--out", str(again)]) == 1


def test_accidents_are_counted():
    row = {"faults": [{"kind": "dropped"}], "safe": True, "outcome": "hover"}
    summary = campaign.summarize([row, {**row, "safe": False, "outcome": "collision"}])
    assert (summary["trials"], summary["safe"]) == (2, 1)
    assert summary["kinds"]["dropped"]["outcomes"] == {"collision": 1, "hover": 1}
