"""Folders that commands write into: whose they are, and who holds them."""

import os
import subprocess
import sys

import pytest

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import claim_folder, held_folder, holds_folder


def test_a_folder_is_of_one_configuration(tmp_path):
    """A folder is one configuration's, whatever a kill has left in it; for another one, or where
    something else is, it is refused unless that may be overwritten."""
    file, other = tmp_path / "mine" / "flight.yaml", tmp_path / "other"
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / ".flight.1.partial.yaml").touch()
    text = claim_folder(file, Scenario(seed=1))
    assert claim_folder(file, Scenario(seed=1)) == text == file.read_text()
    with pytest.raises(ValueError, match=r"holds another configuration, with seed: 1; choose"):
        claim_folder(file, Scenario(seed=2))
    assert file.read_text() == text
    claim_folder(file, Scenario(seed=2), overwrite=True)
    assert load_config(Scenario(), file).seed == 2
    other.mkdir()
    (other / "letters").touch()
    with pytest.raises(ValueError, match=r"other holds letters and no flight.yaml; choose"):
        claim_folder(other / "flight.yaml", Scenario())
    assert [path.name for path in other.iterdir()] == ["letters"]


def test_second_process_learns_who_holds_a_folder(tmp_path):
    """A folder is one process's at a time; another is told which, and a kill sets it free."""
    holding = (
        "import sys, time; from pathlib import Path\n"
        "from splatpilot.systems.common.files import held_folder\n"
        "with held_folder(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)\n"
    )
    folder = tmp_path / "out" / "folder"
    words = [sys.executable, "-c", holding, str(folder)]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        told = rf"folder is in use by (process {other.pid} \(.*python|another process)"
        with pytest.raises(OSError, match=told), held_folder(folder):
            pass
        other.kill()
        other.wait()
    with held_folder(folder):
        (folder / "file").touch()
    assert folder.is_dir()


def test_folder_that_stays_empty_goes_again(tmp_path):
    """A run that fails before it has written anything leaves no folder, and none above it."""

    @holds_folder("out")
    def run(*, out, text):
        assert out.is_dir()
        if not text:
            raise ValueError("nothing to write")
        (out / "file").write_text(text)

    with pytest.raises(ValueError, match="nothing to write"):
        run(out=tmp_path / "a" / "b", text="")
    assert list(tmp_path.iterdir()) == []
    run(out=tmp_path / "a" / "b", text="something")
    assert (tmp_path / "a" / "b" / "file").read_text() == "something"
    assert os.access(tmp_path / "a", os.W_OK)
