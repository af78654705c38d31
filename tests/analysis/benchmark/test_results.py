import importlib.util
import shutil
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "docs" / "results.py"


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
    assert kept.scenarios == ["short"] and len(kept.rows) == 2
    for found, row in zip(
        results.success_rows(kept.rows), rows_of(study[1] / "table.csv"), strict=True
    ):
        for count in ("flights", "successes"):
            assert found[count] == int(row[count])
        assert found["clearance_m"] == pytest.approx(float(row["min_clearance_m"]), abs=1e-4)
    assert kept.about["split"] == "dev" and kept.about["program"]["numpy"]
    assert kept.about["command"].startswith("splatpilot benchmark --split dev --seeds 3")


def test_tables_of_a_page_are_written_between_their_markers(results):
    markers = "Before.\n<!-- table policies small -->\n{}<!-- end of table -->\nAfter.\n"
    page = results.with_tables(markers.format("an older table\n"))
    assert page.startswith(markers.partition("{")[0] + "\nDevelopment seeds 0 to 2")
    assert page.endswith("<!-- end of table -->\nAfter.\n") and "older" not in page
    assert "|0% to 56%|" in page  # Wilson's interval of 0 of 3
