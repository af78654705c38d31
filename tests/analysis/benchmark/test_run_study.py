import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from splatpilot.analysis.benchmark import run_study
from splatpilot.analysis.benchmark.run_study import chunks
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.benchmark.tables import DODGEDRONE_SPEEDS, PUBLISHED
from splatpilot.analysis.commands.main import main
from splatpilot.diagrams.flight.policies import BENCHMARK_POLICIES, policy_named


def test_chunks_are_flights_through_one_world(short_scenario):
    config = StudyConfig([str(short_scenario)], ["planner", "straight"], [1.5, 2.0], seeds=3)
    flights = [(spec, spec.id) for spec in config.rollouts()]
    parts = list(chunks(flights, 3))
    assert [flight for part in parts for flight in part] == flights
    assert [len(part) for part in parts] == [3, 1] * 3
    assert all(len({spec.seed for spec, _ in part}) == 1 for part in parts)


def test_variants_of_a_scenario_share_chunks_if_they_share_worlds():
    texts = ["P02:vehicle.drag=0.3", "P02:world.spacing=2", "P02:vehicle.drag=0.5"]
    config = StudyConfig(texts, ["straight"], seeds=2)
    flights = [(spec, spec.id) for spec in config.rollouts()]
    changed = {each.label: each for each in config.scenario_variants}
    parts = [[spec for spec, _ in part] for part in chunks(flights, 6, changed)]
    assert [len(part) for part in parts] == [2, 2, 1, 1]
    assert [spec.scenario for spec in parts[0]] == ["P02-vehicle.drag-0.3", "P02-vehicle.drag-0.5"]


def test_study_has_all_flights_tables_and_a_report(study, rows_of):
    config, out = study
    rows = rows_of(out / "rollouts.csv")
    assert [row["id"] for row in rows] == [spec.id for spec in config.rollouts()]
    for row, spec in zip(rows, config.rollouts(), strict=True):
        _, arrays = StudyFolder(out).read(spec)
        assert arrays["times"][-1] == pytest.approx(float(row["flight_time_s"]))
        clearance = float(np.nanmin(arrays["clearances"]))
        assert clearance == pytest.approx(float(row["min_clearance_m"]), abs=1e-6)
    assert {row["id"] for row in rows_of(out / "timings.csv")} == {row["id"] for row in rows}
    table = rows_of(out / "table.csv")
    assert [row["policy"] for row in table] == config.policies
    assert all(int(row["flights"]) == 3 for row in table)
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "http" not in page.replace("http-equiv", "")
    assert all(f"splatpilot replay . {row['id']} --meshcat" in page for row in rows)
    assert all(f'href="replays/{row["id"]}/flight.html"' in page for row in rows)
    assert 'name="viewport"' in page and "color-scheme: light dark" in page
    assert not list(out.rglob(".*"))


def test_killed_study_is_resumed_and_equals_an_uninterrupted_one(study, tmp_path, contents):
    config, whole = study
    out = tmp_path / "killed"
    script = "from splatpilot.analysis.commands.main import main; main()"
    words = ["--scenarios", config.scenarios[0], "--policies", ",".join(config.policies)]
    words += ["--seeds", "3", "--jobs", "2", "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "-c", script, "benchmark", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while process.poll() is None and not list(out.glob("rollouts/[!.]*.npz")):
        time.sleep(0.005)
    process.kill()
    assert process.wait() == -signal.SIGKILL, "it ended before it could be killed"
    flown = {path.name: path.stat().st_mtime_ns for path in out.glob("rollouts/[!.]*.npz")}
    assert 0 < len(flown) < 6
    assert not (out / "report.html").exists()

    run_study.run(config=config, out=out, jobs=1)
    assert contents(out) == contents(whole)
    for name, when in flown.items():
        assert (out / "rollouts" / name).stat().st_mtime_ns == when


def test_study_interrupted_before_its_flights_is_resumed(study, tmp_path, monkeypatch, contents):
    config, whole = study

    def interrupt(*words):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(run_study, "keep_inputs", interrupt)
        run_study.run(config=config, out=tmp_path / "begun", jobs=1)
    run_study.run(config=config, out=tmp_path / "begun", jobs=1)
    assert contents(tmp_path / "begun") == contents(whole)


def test_damaged_files_are_flown_again_and_reported(study, tmp_path, capsys, contents):
    config, whole = study
    out = tmp_path / "damaged"
    shutil.copytree(whole, out)
    files = [out / "rollouts" / f"{spec.id}.npz" for spec in config.rollouts()]
    content = files[0].read_bytes()
    files[0].write_bytes(content[:547] + bytes(24) + content[571:])
    shutil.copyfile(files[4], files[3])
    untouched = files[1].stat().st_mtime_ns
    run_study.run(config=config, out=out, jobs=1)
    printed = capsys.readouterr().out
    assert f"{files[0]} is damaged" in printed
    assert f"{files[3]} is of another flight" in printed
    assert "4 of 6 flights exist already" in printed
    assert contents(out) == contents(whole)
    assert files[1].stat().st_mtime_ns == untouched
    assert "is damaged" in (out / "report.html").read_text()


def test_folder_of_another_study_is_refused(study, tmp_path, contents):
    config, whole = study
    before = contents(whole)
    with pytest.raises(ValueError, match=r"holds a study with seeds 3, not 2"):
        run_study.run(config=replace(config, seeds=2), out=whole, jobs=1)
    with pytest.raises(ValueError, match=r"study with overrides \[\], not \['timeout=2'\]"):
        run_study.run(config=replace(config, overrides=["timeout=2"]), out=whole, jobs=1)
    assert contents(whole) == before
    other = tmp_path / "other"
    shutil.copytree(whole, other)
    next(other.glob("rollouts/*")).unlink()
    text = (other / "study.yaml").read_text()
    (other / "study.yaml").write_text(re.sub(r"numpy: .*", "numpy: 0.1", text))
    with pytest.raises(ValueError, match=r"numpy of .* must be 0.1"):
        run_study.run(config=config, out=other, jobs=1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("")
    with pytest.raises(ValueError, match="is not empty and holds no study"):
        run_study.run(config=config, out=tmp_path / "full", jobs=1)


def test_absent_scene_is_not_run_and_never_passed(short_scenario, tmp_path, capsys):
    absent = tmp_path / "R99.yaml"
    absent.write_text(f"world: !SceneConfig {{path: {tmp_path / 'nowhere'}}}\n")
    config = StudyConfig([str(short_scenario), str(absent)], ["straight"], [2.0], seeds=2)
    table = run_study.run(config=config, out=tmp_path / "out", jobs=1).table
    assert (table[0]["flights"], table[0]["not_run"]) == (2, 2)
    printed = capsys.readouterr().out
    assert f"R99 is not flown: No such file or folder: {tmp_path / 'nowhere'}" in printed
    assert "R99 was not run" in (tmp_path / "out" / "report.html").read_text()

    with pytest.raises(FileNotFoundError, match=r"nothing can be flown: .*nowhere"):
        run_study.run(config=replace(config, scenarios=[str(absent)]), out=tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_cluster_flies_the_same_study_and_survives_the_death_of_a_worker(
    study, tmp_path, contents, monkeypatch
):
    distributed = pytest.importorskip("distributed")
    config, whole = study
    out = tmp_path / "cluster"
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        with distributed.Client(cluster) as client:
            victim, _ = client.run(os.getpid).values()
        killed = []
        write = StudyFolder.write

        def write_and_kill(folder: StudyFolder, rollout) -> None:
            write(folder, rollout)
            if not killed:
                killed.append(os.kill(victim, signal.SIGKILL))

        monkeypatch.setattr(StudyFolder, "write", write_and_kill)
        run_study.run(config=config, out=out, cluster=cluster.scheduler_address)
    assert killed
    assert contents(out) == contents(whole)


def test_missing_cluster_is_named(study, tmp_path, monkeypatch):
    config, _ = study
    monkeypatch.setattr(run_study, "CONNECT_TIMEOUT", 0.5)
    with pytest.raises(OSError, match=r"tcp://127.0.0.1:1 .*dask worker"):
        run_study.run(config=config, out=tmp_path / "out", cluster="tcp://127.0.0.1:1")


@pytest.mark.parametrize(("split", "name"), [("dev", "development"), ("test", "test")])
def test_report_and_table_name_the_split(short_scenario, tmp_path, capsys, split, name):
    config = StudyConfig([str(short_scenario)], ["straight", "planner"], seeds=1, split=split)
    run_study.run(config=config, out=tmp_path / "out", jobs=1)
    page = (tmp_path / "out" / "report.html").read_text()
    for heading in ("Policies", "Scenarios", "Pairs of policies on the same flights"):
        assert f"<h2>{heading}, {name} seeds</h2>" in page
    assert f"{name} seeds" in capsys.readouterr().out
    assert f"split: {split}\n" in (tmp_path / "out" / "study.yaml").read_text()


def test_test_study_flies_only_in_test_scenes_each_one_environment(room, tmp_path):
    hall = tmp_path / "hall.yaml"
    config = StudyConfig([str(hall)], ["straight"], seeds=1, split="test")
    hall.write_text(f"world: !SceneConfig {{path: {room.scene('own', split='train')}}}\n")
    with pytest.raises(ValueError, match=r"split of .*own, in which hall flies, must be test"):
        run_study.run(config=config, out=tmp_path / "out", jobs=1)
    hall.write_text(f"world: !SceneConfig {{path: {room.scene('held', split='test')}}}\n")
    (row,) = run_study.run(config=config, out=tmp_path / "out", jobs=1).table
    assert row["flights"] == 1
    assert "Each of hall is one environment" in (tmp_path / "out" / "report.html").read_text()


def test_one_option_flies_the_dodgedrone_challenge(monkeypatch, tmp_path):
    studies = []

    def run(*, config, out, jobs, cluster):
        studies.append(config)
        return run_study.Flown([], [])

    monkeypatch.setattr(run_study, "run", run)
    command = ["benchmark", "--dodgedrone", "--out", str(tmp_path)]
    assert main(command) == 0
    main([*command, "--scenarios", "dodgedrone_easy", "--speeds", "3", "--seeds", "2"])
    whole, part = studies
    assert whole.scenarios == list(PUBLISHED) and whole.speeds == list(DODGEDRONE_SPEEDS)
    assert tuple(whole.policies) == BENCHMARK_POLICIES and whole.seeds == 20
    assert (part.scenarios, part.speeds, part.seeds) == (["dodgedrone_easy"], [3.0], 2)
    assert len(whole.load_scenarios()) == 3
    for policy in BENCHMARK_POLICIES:
        for speed in DODGEDRONE_SPEEDS:
            policy_named(policy, speed)
