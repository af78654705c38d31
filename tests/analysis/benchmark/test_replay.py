import json
import shutil

import numpy as np
import pytest
import yaml

from splatpilot.analysis.benchmark import replay
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.commands.main import main


def test_replay_equals_the_record_and_says_so(study, tmp_path, capsys):
    config, whole = study
    copy = tmp_path / "elsewhere"
    shutil.copytree(whole, copy)
    spec = config.rollouts()[1]
    record = tmp_path / "flight.rrd"
    words = ["--meshcat", "--video", "--rerun", str(record)]
    assert main(["replay", str(copy), spec.id, *words]) == 0
    assert record.stat().st_size > 1e5
    assert "is bitwise identical to the recorded flight" in capsys.readouterr().out
    assert (copy / "replays" / spec.id / "flight.html").stat().st_size > 1e5
    assert (copy / "replays" / spec.id / "flight.mp4").stat().st_size > 1e3

    file = StudyFolder(copy).trajectory(spec.id)
    with np.load(file) as arrays:
        changed = dict(arrays)
    changed["states"][-1, 0] += 0.001
    changed["row"] = np.array(str(changed["row"]).replace('"digest": "', '"digest": "0'))
    np.savez(file, **changed)
    assert not replay.run(study=copy, id=spec.id)
    printed = capsys.readouterr().out
    assert "THE REPLAY DIFFERS" in printed and "by up to 0.001 m" in printed
    assert f"It was flown by this program and machine: {spec.policy} keeps state" in printed
    assert main(["replay", str(copy), spec.id]) == 1
    assert f"{spec.id}: the replay differs" in capsys.readouterr().err

    timing = copy / "timings" / f"{spec.id}.json"
    timing.write_text(json.dumps(json.loads(timing.read_text()) | {"host": "elsewhere"}))
    replay.run(study=copy, id=spec.id)
    assert "It was flown on elsewhere, this is" in capsys.readouterr().out
    content = yaml.safe_load((copy / "study.yaml").read_text())
    content["program"]["drake"] = "0.1"
    (copy / "study.yaml").write_text(yaml.safe_dump(content))
    replay.run(study=copy, id=spec.id)
    assert "It was flown by drake 0.1, this is" in capsys.readouterr().out

    file.unlink()
    with pytest.raises(FileNotFoundError, match=f"{spec.id} has not been flown yet in .*again"):
        replay.run(study=copy, id=spec.id)


def test_flights_through_one_world_are_shown_on_one_page(study, tmp_path, capsys):
    config, whole = study
    ids = [spec.id for spec in config.rollouts()]  # two policies, seed by seed
    words = ["replay", str(whole), "--out", str(tmp_path)]
    assert main([*words, *ids[:2]]) == 0
    assert (tmp_path / "flights.html").stat().st_size > 1e5
    assert main([*words, *ids[1:3], "--overwrite"]) == 1
    assert f"{ids[2]} flew another world than {ids[1]}" in capsys.readouterr().err
