import errno
import fcntl
import os
from pathlib import Path

import pytest

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import (
    _HOST,
    DATA,
    claim_folder,
    find_data,
    folder_written_atomically,
    locked_folder,
    locks_folder,
    require_existing,
    require_unused,
    require_writable_folder,
    written_atomically,
)


def test_file_is_replaced_when_the_block_ends(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with written_atomically(path) as partial:
        assert partial.suffix == ".txt"
        partial.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def broken(written: Path) -> None:
    raise OSError("it is not good")


@pytest.mark.parametrize(
    ("raised", "check", "error", "message"),
    [
        (RuntimeError("half way"), None, RuntimeError, "half way"),
        (OSError(errno.ENOSPC, "No space left"), None, OSError, r"a\.txt: cannot .*; make room"),
        (OSError("8 requested, 0 done"), None, OSError, r"a\.txt: cannot .*; make room"),
        (FileNotFoundError(2, "No", "nowhere"), None, FileNotFoundError, "nowhere"),
        (None, broken, OSError, r"a\.txt: cannot be written \(it is not good\)"),
    ],
)
def test_file_stays_if_writing_fails(tmp_path, raised, check, error, message):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(error, match=message), written_atomically(path, check) as partial:
        partial.write_text("ne")
        if raised is not None:
            raise raised
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_folder_appears_when_the_block_ends(tmp_path):
    path = tmp_path / "a"
    with pytest.raises(RuntimeError, match="half way"), folder_written_atomically(path) as left:
        (left / "file").write_text("ne")
        raise RuntimeError("half way")
    assert list(tmp_path.iterdir()) == []
    left.mkdir()
    (left / "old").write_text("")  # as a kill leaves it
    with folder_written_atomically(path) as partial:
        (partial / "file").write_text("new")
        assert not path.exists()
    assert list(path.iterdir()) == [path / "file"]
    with folder_written_atomically(path) as partial:
        (partial / "file").write_text("another")
    assert (path / "file").read_text() == "new"
    with folder_written_atomically(path, replace=True) as partial:
        (partial / "other").write_text("newer")
    assert list(path.iterdir()) == [path / "other"] and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(errno.EIO, "input/output error")])
def test_a_folder_is_kept_if_its_replacement_fails(tmp_path, monkeypatch, error):
    path, rename = tmp_path / "scene", Path.rename
    (path / "old").mkdir(parents=True)

    def fail(self, target):
        if self.name.endswith(".partial"):
            raise error
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises((KeyboardInterrupt, OSError)), folder_written_atomically(path, replace=True):
        pass
    assert list(path.iterdir()) == [path / "old"] and list(tmp_path.iterdir()) == [path]
    # A process that was killed between both renames.
    ended = f".scene.{_HOST}.{2**31 - 1}.partial"
    path.rename(tmp_path / f"{ended}.replaced")
    (tmp_path / ended).mkdir()
    require_writable_folder(tmp_path)
    assert list(path.iterdir()) == [path / "old"] and list(tmp_path.iterdir()) == [path]


def test_a_link_to_a_folder_stays_a_link(tmp_path):
    link, folder = tmp_path / "scene", tmp_path / "disk/scene"
    folder.mkdir(parents=True)
    link.symlink_to(folder)
    with folder_written_atomically(link, replace=True) as partial:
        (partial / "new").touch()
    assert link.is_symlink() and (folder / "new").exists() and len(list(tmp_path.iterdir())) == 2


def test_leftovers_of_ended_processes_are_removed(tmp_path):
    with written_atomically(tmp_path / "mine.txt") as mine:
        ended = mine.name.replace(str(os.getpid()), str(2**31 - 1))
        other = tmp_path / ".mine.partial"
        for file in (mine, tmp_path / ended, other):
            file.touch()
        (tmp_path / f"{ended}b").mkdir()
        require_writable_folder(tmp_path)
        assert set(tmp_path.iterdir()) == {other, mine}
        other.unlink()
        require_unused(tmp_path, overwrite=False)


def test_paths_are_checked(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    for unused in ("empty", "nothing"):
        require_unused(tmp_path / unused, overwrite=False)
    for used in (tmp_path / "file", tmp_path):
        with pytest.raises(FileExistsError, match=r"is there already; .* --overwrite"):
            require_unused(used, overwrite=False)
        require_unused(used, overwrite=True)
    require_existing(tmp_path, "a folder")
    with pytest.raises(FileNotFoundError, match=r"No such file.*nowhere; expected a scene"):
        require_existing(tmp_path / "nowhere", "a scene")
    with pytest.raises(OSError, match=r"file/out.*--out"):
        require_writable_folder(tmp_path / "file" / "out")


def test_a_folder_belongs_to_one_configuration(tmp_path):
    file, other = tmp_path / "mine" / "flight.yaml", tmp_path / "other"
    file.parent.mkdir()
    (file.parent / ".flight.1.partial.yaml").touch()
    text = claim_folder(file, Scenario(seed=1))
    assert claim_folder(file, Scenario(seed=1)) == text == file.read_text()
    with pytest.raises(ValueError, match=r"holds another configuration, with seed: 1; choose"):
        claim_folder(file, Scenario(seed=2))
    assert file.read_text() == text
    claim_folder(file, Scenario(seed=2), overwrite=True)
    assert load_config(Scenario(), file).seed == 2
    other.mkdir()
    (other / "letters").touch()
    with pytest.raises(ValueError, match=r"other must be empty or hold flight.yaml, got letters"):
        claim_folder(other / "flight.yaml", Scenario())
    assert [path.name for path in other.iterdir()] == ["letters"]


def test_a_locked_folder_is_refused_until_its_holder_ends(tmp_path):
    holder = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(holder, fcntl.LOCK_EX)
    with pytest.raises(OSError, match="is in use by another process; wait"):
        locked_folder(tmp_path).__enter__()
    os.close(holder)
    with locked_folder(tmp_path):
        pass
    assert tmp_path.is_dir()


def test_a_locked_folder_that_stays_empty_is_removed(tmp_path):
    @locks_folder("out")
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


def test_data_are_found_here_or_in_their_folder(tmp_path, monkeypatch, capsys):
    found = tmp_path / "data" / "tartanair" / "hospital"
    found.mkdir(parents=True)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv(DATA, str(tmp_path / "data"))
    for name in ("hospital", "tartanair/hospital"):
        assert find_data(Path(name), "a capture") == found
        assert capsys.readouterr().out == f"{name} is {found}\n"
        Path(name).mkdir(parents=True)
        assert find_data(Path(name), "a capture") == Path(name)
        assert not capsys.readouterr().out
    message = "^No such file or folder: hospitl; expected a capture, here or in "
    with pytest.raises(FileNotFoundError, match=message + str(tmp_path / "data$")):
        find_data(Path("hospitl"), "a capture")
    monkeypatch.delenv(DATA)
    with pytest.raises(FileNotFoundError, match=rf"{message}the folder that {DATA} names \(it is"):
        find_data(Path("hospitl"), "a capture")
