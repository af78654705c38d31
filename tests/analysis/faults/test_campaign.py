import json
import shutil

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.faults.campaign import summarize


def test_a_campaign_is_safe_resumes_and_repeats(tmp_path):
    settings = ["world.length=10.0", "world.width=6.0", "start_radius=0.05"]
    sets = [word for setting in settings for word in ("--set", f"scenario.{setting}")]
    words = ["hardware", "faults", "--set", "trials=2", "--set", "worlds=1", *sets]
    assert main([*words, "--out", str(tmp_path / "whole")]) == 0
    rows = (tmp_path / "whole" / "trials.jsonl").read_text().splitlines(keepends=True)
    assert len(rows) == 2 and all(json.loads(row)["safe"] for row in rows)
    again = tmp_path / "again"
    again.mkdir()
    shutil.copy(tmp_path / "whole" / "config.yaml", again)
    (again / "trials.jsonl").write_text(rows[0])
    assert main([*words, "--out", str(again)]) == 0
    assert (again / "trials.jsonl").read_text() == "".join(rows)
    summary = json.loads((again / "summary.json").read_text())
    assert (summary["trials"], summary["safe"]) == (2, 2)
    assert main([*words, "--set", "seed=1", "--out", str(again)]) == 1
    assert main([*words, "--set", "trials=0", "--out", str(again)]) == 1


def test_accidents_are_counted():
    row = {"faults": [{"kind": "dropped"}], "safe": True, "outcome": "hover"}
    summary = summarize([row, {**row, "safe": False, "outcome": "collision"}])
    assert (summary["trials"], summary["safe"]) == (2, 1)
    assert summary["kinds"]["dropped"]["outcomes"] == {"collision": 1, "hover": 1}
