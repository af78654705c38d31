"""Shards of a study, flown apart and joined."""

import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from splatpilot.analysis.benchmark import merge
from splatpilot.analysis.benchmark import run_study as benchmark
from splatpilot.analysis.benchmark.shard import Shard
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.commands.main import main


@pytest.fixture(scope="session")
def shards(study, tmp_path_factory):
    """The folders of the two shards of the study; not to be changed."""
    folder = tmp_path_factory.mktemp("shards")
    for number in (1, 2):
        benchmark.run(config=study[0], out=folder / str(number), jobs=1, shard=Shard(number, 2))
    return folder / "1", folder / "2"


def test_merged_shards_equal_the_study_flown_whole(study, shards, tmp_path, contents, monkeypatch):
    """All files but the timings, whatever the order and where merging was interrupted; a study
    that was merged goes on like any other.
    """
    config, whole = study
    out = tmp_path / "merged"
    flown = [{path.name for path in shard.glob("rollouts/*")} for shard in shards]
    assert [len(names) for names in flown] == [4, 2] and not flown[0] & flown[1]
    copied, copyfile = [], shutil.copyfile

    def interrupted(source, target):
        if len(copied) == 3:
            raise KeyboardInterrupt
        copied.append(copyfile(source, target))

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(merge.shutil, "copyfile", interrupted)
        merge.run(out=out, shards=shards)
    assert len(copied) == 3 and not (out / "rollouts.csv").exists()
    assert main(["merge", str(out), str(shards[1]), str(shards[0])]) == 0
    assert contents(out) == contents(whole)
    assert {path.name for path in out.glob("timings/*")} == {
        path.name for path in whole.glob("timings/*")
    }
    (out / "rollouts" / "short-planner-2-001.npz").unlink()
    benchmark.run(config=config, out=out, jobs=1)
    assert contents(out) == contents(whole)


def test_killed_shard_is_refused_until_it_is_finished(study, shards, tmp_path, contents):
    """A shard killed after its first flight lacks flights; its own command flies them, and merged
    it leaves the bytes of the study flown whole.
    """
    config, whole = study
    killed = tmp_path / "killed"
    command = [sys.executable, "-c", "from splatpilot.analysis.commands.main import main; main()"]
    command += ["benchmark", "--scenarios", config.scenarios[0], "--seeds", "3", "--jobs", "1"]
    command += ["--policies", ",".join(config.policies), "--shard", "1/2", "--out", str(killed)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while process.poll() is None and not list(killed.glob("rollouts/[!.]*.npz")):
        time.sleep(0.005)
    process.kill()
    assert process.wait() == -signal.SIGKILL, "it ended before it could be killed"
    with pytest.raises(ValueError, match=r"killed, shard 1/2, lacks \d of its 4 flights, short-"):
        merge.run(out=tmp_path / "out", shards=[killed, shards[1]])
    assert not (tmp_path / "out").exists()
    assert subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode == 0
    merge.run(out=tmp_path / "out", shards=[killed, shards[1]])
    assert contents(tmp_path / "out") == contents(whole)


def test_wrong_shards_are_refused(study, shards, tmp_path):
    """What is missing, given twice, whole, of another study or program, damaged or flown in
    something else is named, before anything is written.
    """
    config, whole = study
    first, second = shards
    out = tmp_path / "out"

    def copy(name: str):
        return shutil.copytree(first, tmp_path / name)

    def refused(message: str, *folders) -> None:
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            merge.run(out=out, shards=folders)

    refused("of 2 shards 2 is missing", first)
    refused(f"{first} and {copy('again')} are both shard 1/2", first, tmp_path / "again")
    refused("its number of shards is None, not 2", first, whole)
    refused("is a study flown whole", whole)
    refused("a study is a folder", first, tmp_path / "nowhere")
    for name, old, new, message in (
        ("foreign", "seeds: 3", "seeds: 4", "another study than .*: its seeds is 4, not 3"),
        ("older", "numpy: ", "numpy: 0", "its numpy is 0"),
        ("thirds", "shard: 1/2", "shard: 1/3", "its number of shards is 3, not 2"),
    ):
        file = copy(name) / "study.yaml"
        file.write_text(file.read_text().replace(old, new))
        refused(message, second, tmp_path / name)
    file = next(copy("damaged").glob("rollouts/*"))
    file.write_bytes(file.read_bytes()[:-100])
    refused("lacks 1 of its 4 flights, .* is damaged", tmp_path / "damaged", second)
    assert not out.exists()
    file = copy("elsewhere") / "scenarios" / "short.yaml"
    file.write_text(file.read_text().replace("timeout: 1.5", "timeout: 1.6"))
    refused("differ, but all shards fly with the same", tmp_path / "elsewhere", second)
    with pytest.raises(ValueError, match="holds shard 1/2 of this study, not all"):
        merge.run(out=first, shards=shards)
    with pytest.raises(ValueError, match="holds shard 1/2 of this study, not shard 2/2"):
        benchmark.run(config=config, out=first, shard=Shard(2, 2))


def test_scene_that_no_shard_has_is_not_run(short_scenario, tmp_path, contents):
    """Merged it is reported as by the study flown whole, also where a shard flew nothing; if
    another shard has it, the one that lacks it is named.
    """
    absent = tmp_path / "R99.yaml"
    absent.write_text(f"world: !SceneConfig {{path: {tmp_path / 'nowhere'}}}\n")
    config = StudyConfig([str(short_scenario), str(absent)], ["straight"], seeds=1)
    benchmark.run(config=config, out=tmp_path / "whole", jobs=1)
    folders = [tmp_path / "1", tmp_path / "2"]
    for number, folder in enumerate(folders, 1):
        benchmark.run(config=config, out=folder, jobs=1, shard=Shard(number, 2))
    table = merge.run(out=tmp_path / "merged", shards=folders)
    assert (table[0]["flights"], table[0]["not_run"]) == (1, 1)
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")

    (folders[0] / "scenarios" / "R99.yaml").write_text("")
    with pytest.raises(ValueError, match=r"2/2, lacks 1 of its 1 flights, R99-straight-2-000"):
        merge.run(out=tmp_path / "other", shards=folders)
    config = replace(config, scenarios=[str(absent)])
    benchmark.run(config=config, out=tmp_path / "none", shard=Shard(1, 1))
    with pytest.raises(FileNotFoundError, match="nothing was flown"):
        merge.run(out=tmp_path / "other", shards=[tmp_path / "none"])
