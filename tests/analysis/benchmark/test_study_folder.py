"""The files of studies: what is damaged, and what a kill leaves."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from splatpilot.analysis.benchmark import run_study as benchmark
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.systems.common.provenance import program


@pytest.mark.parametrize("row", [[1, 2], 3, {}, {"success": True, "outcome": "goal"}])
def test_rows_that_are_none_are_damage(study, tmp_path, row):
    config, whole = study
    spec = config.rollouts()[0]
    folder = StudyFolder(tmp_path)
    (tmp_path / "rollouts").mkdir()
    arrays = StudyFolder(whole).read(spec)[1]
    if isinstance(row, dict):
        row = spec._asdict() | row
    np.savez(folder.trajectory(spec.id), row=np.array(json.dumps(row)), **arrays)
    with pytest.raises(ValueError, match=rf"{spec.id}\.npz is damaged: "):
        folder.read(spec)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not a study"),
        ("[1", "is not a study"),
        ("format_version: 1", "is not a study: study is None"),
        ("format_version: 1\nstudy: {}\nprogram: null", "is not a study: program is None"),
        ("format_version: 1\nstudy: {sedes: 3}\nprogram: {}", "there is no field sedes"),
        ("format_version: 1\nstudy: {seeds: many}\nprogram: {}", ".*many"),
        ("format_version: 1\nstudy: {seeds: 1000000000}\nprogram: {}", "got 1000000000"),
        ("format_version: 1\nstudy: {speeds: [.nan]}\nprogram: {}", "speeds must be .* got nan"),
        ("format_version: 9\nstudy: {}\nprogram: {}", "format version 9"),
    ],
)
def test_descriptions_that_are_none_name_the_file(tmp_path, text, message):
    (tmp_path / "study.yaml").write_text(text)
    with pytest.raises(ValueError, match=rf"study\.yaml:? .*{message}"):
        StudyFolder(tmp_path).config()


def test_study_that_was_killed_before_it_began_is_begun(study, tmp_path, contents):
    config, whole = study
    out = tmp_path / "killed"
    begun = (
        "import os, signal, sys; from pathlib import Path\n"
        "from splatpilot.systems.common.files import written_atomically\n"
        "with written_atomically(Path(sys.argv[1])) as file:\n"
        "    file.write_text('half'); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    out.mkdir()
    for file in ("study.yaml", "scenarios/short.yaml"):
        (out / file).parent.mkdir(exist_ok=True)
        subprocess.run([sys.executable, "-c", begun, str(out / file)], check=False)
        StudyFolder(out).claim(config, program())
    assert not list(out.rglob("*.partial*"))
    benchmark.run(config=config, out=out, jobs=1)
    assert contents(out) == contents(whole)


def test_fields_that_came_later_are_as_they_are_by_default(study, tmp_path):
    config, _ = study
    folder = StudyFolder(tmp_path / "out")
    folder.claim(config, program())
    file = tmp_path / "out/study.yaml"
    begun = file.read_text()
    assert "  split: dev\n" in begun
    file.write_text(begun.replace("  split: dev\n", ""))
    folder.claim(config, program())
    with pytest.raises(ValueError, match="holds a study with split dev, not test; choose"):
        folder.claim(replace(config, split="test"), program())
