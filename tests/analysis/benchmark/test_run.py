"""Studies, whole, interrupted and damaged."""

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

from splatpilot.analysis.benchmark import run_study as benchmark
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.benchmark.tables import policy_table
from splatpilot.analysis.commands.main import main


def test_study_leaves_what_it_promises(study, rows_of):
    config, out = study
    rows = rows_of(out / "rollouts.csv")
    assert [row["id"] for row in rows] == [spec.id for spec in config.rollouts()]
    for row, spec in zip(rows, config.rollouts(), strict=True):
        _, arrays = StudyFolder(out).read(spec)
        assert arrays["times"][-1] == pytest.approx(float(row["flight_time_s"]))
        least = float(np.nanmin(arrays["clearances"]))
        assert least == pytest.approx(float(row["min_clearance_m"]), abs=1e-6)
    assert {row["id"] for row in rows_of(out / "timings.csv")} == {row["id"] for row in rows}
    table = rows_of(out / "table.csv")
    assert [row["policy"] for row in table] == config.policies
    assert all(int(row["flights"]) == 3 for row in table)
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "http" not in page.replace("http-equiv", "")
    assert all(f"splatpilot replay . {row['id']} --meshcat" in page for row in rows)
    assert not [path for path in out.rglob(".*")]


def test_killed_study_is_finished_and_equals_an_uninterrupted_one(study, tmp_path, contents):
    config, whole = study
    out = tmp_path / "killed"
    command = [
        sys.executable,
        "-c",
        "from splatpilot.analysis.commands.main import main; main()",
        "benchmark",
    ]
    command += ["--scenarios", config.scenarios[0], "--policies", ",".join(config.policies)]
    process = subprocess.Popen(
        [*command, "--seeds", "3", "--jobs", "2", "--out", str(out)],
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

    benchmark.run(config=config, out=out, jobs=1)
    assert contents(out) == contents(whole)
    for name, when in flown.items():
        assert (out / "rollouts" / name).stat().st_mtime_ns == when


def test_damaged_file_is_flown_again_and_reported(study, tmp_path, capsys, contents):
    config, whole = study
    out = tmp_path / "damaged"
    shutil.copytree(whole, out)
    files = [out / "rollouts" / f"{spec.id}.npz" for spec in config.rollouts()]
    content = files[0].read_bytes()
    files[0].write_bytes(content[:547] + bytes(24) + content[571:])
    shutil.copyfile(files[4], files[3])
    untouched = files[1].stat().st_mtime_ns
    benchmark.run(config=config, out=out, jobs=1)
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
    with pytest.raises(ValueError, match=r"holds a study with seeds 3, not 4"):
        benchmark.run(config=replace(config, seeds=4), out=whole, jobs=1)
    with pytest.raises(ValueError, match=r"study with overrides \[\], not \['timeout=2'\]"):
        benchmark.run(config=replace(config, overrides=["timeout=2"]), out=whole, jobs=1)
    assert contents(whole) == before
    other = tmp_path / "other"
    shutil.copytree(whole, other)
    next(other.glob("rollouts/*")).unlink()
    text = (other / "study.yaml").read_text()
    (other / "study.yaml").write_text(re.sub(r"numpy: .*", "numpy: 0.1", text))
    with pytest.raises(ValueError, match=r"started with numpy 0.1, this is"):
        benchmark.run(config=config, out=other, jobs=1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("")
    with pytest.raises(ValueError, match="is not empty and holds no study"):
        benchmark.run(config=config, out=tmp_path / "full", jobs=1)


def test_absent_scene_is_not_run_and_never_passed(short_scenario, tmp_path, capsys):
    absent = tmp_path / "R99.yaml"
    absent.write_text(f"world: !SceneConfig {{path: {tmp_path / 'nowhere'}}}\n")
    config = StudyConfig([str(short_scenario), str(absent)], ["straight"], [2.0], seeds=2)
    table = benchmark.run(config=config, out=tmp_path / "out", jobs=1)
    assert (table[0]["flights"], table[0]["not_run"]) == (2, 2)
    printed = capsys.readouterr().out
    assert f"R99 is not flown: No such file or folder: {tmp_path / 'nowhere'}" in printed
    assert "R99 was not run" in (tmp_path / "out" / "report.html").read_text()


def test_nothing_flown_is_no_success(tmp_path, capsys):
    absent = tmp_path / "R99.yaml"
    absent.write_text(f"world: !SceneConfig {{path: {tmp_path / 'nowhere'}}}\n")
    out = tmp_path / "out"
    words = ["--scenarios", str(absent), "--policies", "straight", "--seeds", "1"]
    assert main(["benchmark", "--out", str(out), *words]) == 1
    printed = capsys.readouterr()
    assert "nothing can be flown" in printed.err and "nowhere" in printed.err
    assert "nan" not in printed.out and not out.exists()


def test_each_flight_is_read_once(study, tmp_path, monkeypatch, contents):
    config, whole = study
    out = tmp_path / "copy"
    shutil.copytree(whole, out)
    read, tables = [], []
    monkeypatch.setattr(StudyFolder, "read_there", StudyFolder.read, raising=False)
    monkeypatch.setattr(
        StudyFolder, "read", lambda self, spec: read.append(spec) or self.read_there(spec)
    )
    monkeypatch.setattr(
        benchmark, "policy_table", lambda *words: tables.append(policy_table(*words)) or tables[-1]
    )
    benchmark.run(config=config, out=out, jobs=1)
    pictured = read[len(config.rollouts()) :]
    assert read[: len(config.rollouts())] == config.rollouts()
    assert [spec.policy for spec in pictured] == config.policy_names
    assert len({(spec.scenario, spec.seed) for spec in pictured}) == 1
    assert len(tables) == 1
    assert contents(out) == contents(whole)


def test_study_interrupted_while_it_begins_is_finished(study, tmp_path, monkeypatch, contents):
    config, whole = study
    out = tmp_path / "begun"

    def interrupt(*words):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(benchmark, "keep_inputs", interrupt)
        benchmark.run(config=config, out=out, jobs=1)
    benchmark.run(config=config, out=out, jobs=1)
    assert contents(out) == contents(whole)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["replay", "{out}", "short-planner-2-999"], "has no flight 'short-planner-2-999'"),
        (["replay", "{out}/rollouts", "a"], "No such file: {out}/rollouts/study.yaml"),
        (["benchmark", "--out", "{out}", "--scenarios", "P99"], "there is no scenario 'P99'"),
        (["benchmark", "--out", "{out}", "--speeds", "fast"], "numbers in m/s, got 'fast'"),
        (
            ["benchmark", "--out", "{out}", "--scenarios", "{scenario}", "--policies", "nobody"],
            "there is no policy 'nobody'",
        ),
        (
            ["benchmark", "--out", "{out}", "--scenarios", "{scenario}", "--jobs", "0"],
            "--jobs must be at least 1, got 0",
        ),
    ],
)
def test_bad_command_is_one_message(study, arguments, message, capsys):
    config, out = study
    words = [word.format(out=out, scenario=config.scenarios[0]) for word in arguments]
    assert main(words) == 1
    error = capsys.readouterr().err
    assert error.splitlines()[-1].startswith("splatpilot: ")
    assert message.format(out=out) in error


def test_cluster_flies_the_same_study_and_survives_the_death_of_a_worker(study, tmp_path, contents):
    distributed = pytest.importorskip("distributed")
    config, whole = study
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        with distributed.Client(cluster) as client:
            victim, _ = client.run(os.getpid).values()
        killed = []

        def write_and_kill(folder: StudyFolder, rollout) -> None:
            StudyFolder.write_there(folder, rollout)
            if not killed:
                killed.append(os.kill(victim, signal.SIGKILL))

        patch = pytest.MonkeyPatch()
        patch.setattr(StudyFolder, "write_there", StudyFolder.write, raising=False)
        patch.setattr(StudyFolder, "write", write_and_kill)
        try:
            out = tmp_path / "cluster"
            benchmark.run(config=config, out=out, cluster=cluster.scheduler_address)
        finally:
            patch.undo()
    assert killed
    assert contents(out) == contents(whole)


def test_cluster_that_is_not_there_is_named(study, tmp_path, monkeypatch):
    config, _ = study
    monkeypatch.setattr("splatpilot.analysis.benchmark.run_study.CONNECT_TIMEOUT", 0.5)
    with pytest.raises(OSError, match=r"tcp://127.0.0.1:1 .*dask worker"):
        benchmark.run(config=config, out=tmp_path / "out", cluster="tcp://127.0.0.1:1")
