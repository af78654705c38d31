"""The report of a study."""

import pytest

from splatpilot.analysis.benchmark import run_study as benchmark
from splatpilot.analysis.benchmark.study import StudyConfig


@pytest.mark.parametrize(("split", "named"), [("dev", "development"), ("test", "test")])
def test_report_and_table_name_the_split(short_scenario, tmp_path, capsys, split, named):
    config = StudyConfig([str(short_scenario)], ["straight", "planner"], seeds=1, split=split)
    benchmark.run(config=config, out=tmp_path / "out", jobs=1)
    page = (tmp_path / "out" / "report.html").read_text()
    for heading in ("Policies", "Scenarios", "Pairs of policies on the same flights"):
        assert f"<h2>{heading}, {named} seeds</h2>" in page
    assert f"{named} seeds" in capsys.readouterr().out
    assert f"split: {split}\n" in (tmp_path / "out" / "study.yaml").read_text()


def test_report_says_where_seeds_are_not_environments(place, short_scenario, tmp_path):
    hall = tmp_path / "hall.yaml"
    hall.write_text(f"world: !SceneConfig {{path: {place.scene('hall')}}}\n")
    config = StudyConfig([str(short_scenario), str(hall)], ["straight"], seeds=1)
    benchmark.run(config=config, out=tmp_path / "out", jobs=1)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Each of hall is one environment" in page


def test_test_study_flies_in_test_scenes_alone(place, tmp_path):
    hall = tmp_path / "hall.yaml"
    config = StudyConfig([str(hall)], ["straight"], seeds=1, split="test")
    hall.write_text(f"world: !SceneConfig {{path: {place.scene('own', split='train')}}}\n")
    with pytest.raises(ValueError, match=r"split of .*own, in which hall flies, must be test"):
        benchmark.run(config=config, out=tmp_path / "out", jobs=1)
    hall.write_text(f"world: !SceneConfig {{path: {place.scene('held', split='test')}}}\n")
    (row,) = benchmark.run(config=config, out=tmp_path / "out", jobs=1)
    assert row["flights"] == 1
