import importlib.util
import shutil
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "docs" / "results.py"
PAGE = "Before.\n<!-- table {} small -->\nan older table\n<!-- end of table -->\nAfter.\n"


@pytest.fixture
def results(study, tmp_path, monkeypatch):
    """The script, with the results of the small study."""
    spec = importlib.util.spec_from_file_location("results", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "RESULTS", tmp_path)
    shutil.copy(SCRIPT.with_name("results") / "policies.yaml", tmp_path)
    module.keep(study[1], "small")
    return module


def test_kept_results_agree_with_the_table_of_the_study(study, results, rows_of):
    kept = results.Results.read("small")
    assert kept.scenarios == ["short"] and len(kept.entries) == 2
    for found, row in zip(results.success_rows(kept), rows_of(study[1] / "table.csv"), strict=True):
        assert (found["flights"], found["successes"]) == (
            int(row["flights"]),
            int(row["successes"]),
        )
        assert found["clearance_m"] == pytest.approx(float(row["min_clearance_m"]), abs=1e-4)
    assert kept.about["split"] == "dev" and kept.about["program"]["numpy"]
    assert kept.about["command"].startswith("splatpilot benchmark --split dev --seeds 3")


def test_tables_of_a_page_are_written_between_their_markers(results):
    page = results.with_tables(PAGE.format("policies"))
    assert page.startswith("Before.\n<!-- table policies small -->\n\nDevelopment seeds 0 to 2")
    assert page.endswith("<!-- end of table -->\nAfter.\n") and "older" not in page
    assert "|0% to 56%|" in page  # Wilson's interval of 0 of 3
    assert results.with_tables(page) == page


def test_realism_is_shown_by_policy_and_condition(results):
    rows = "ideal,planner,3,3\nharsh,planner,3,1\nideal,straight,3,2\n"
    (results.RESULTS / "realism.csv").write_text(f"conditions,policy,flights,successes\n{rows}")
    (results.RESULTS / "realism.yaml").write_text("date: 2026-01-02\nprogram: 0123456789\n")
    page = results.with_tables(PAGE.format("realism").replace("small", "realism"))
    assert "|policy|ideal|harsh|" in page
    assert "|`planner`|3/3|1/3|\n|`straight`|2/3||" in page
