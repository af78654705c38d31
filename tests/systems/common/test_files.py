"""Atomic files."""

import errno
import subprocess
import sys
import threading

import pytest

from splatpilot.systems.common.files import (
    folder_written_atomically,
    remove_leftovers,
    require_existing,
    require_unused,
    require_writable_folder,
    written_atomically,
)


def test_success_replaces_and_leaves_nothing_else(tmp_path):
    """After the block the file holds the new content and the folder nothing besides."""
    path = tmp_path / "a.txt"
    path.write_text("old")
    with written_atomically(path) as partial:
        assert partial.suffix == ".txt"
        partial.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_failure_keeps_what_was_there(tmp_path):
    """An exception half way leaves the old content and no temporary file."""
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="half way"), written_atomically(path) as partial:
        partial.write_text("ne")
        raise RuntimeError("half way")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_folder_that_cannot_be_made_is_refused(tmp_path):
    """A folder below a file cannot be made: the message names it and the remedy."""
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"file/out.*--out"):
        require_writable_folder(tmp_path / "file" / "out")


def test_folders_appear_whole(tmp_path):
    """A folder is there when the block ends and not before, and nothing besides; what a kill left
    under the temporary name is overwritten."""
    path = tmp_path / "a"
    with folder_written_atomically(path) as left:
        pass
    path.rmdir()
    left.mkdir()
    (left / "old").write_text("")
    with folder_written_atomically(path) as partial:
        (partial / "file").write_text("new")
        assert not path.exists()
    assert (path / "file").read_text() == "new"
    assert list(path.iterdir()) == [path / "file"]
    assert list(tmp_path.iterdir()) == [path]


def test_folders_that_fail_are_not_there_and_others_stay(tmp_path):
    """An exception leaves nothing; a folder that another put there meanwhile stays as it is."""
    path = tmp_path / "a"
    with pytest.raises(RuntimeError, match="half way"), folder_written_atomically(path) as partial:
        (partial / "file").write_text("ne")
        raise RuntimeError("half way")
    assert list(tmp_path.iterdir()) == []
    with folder_written_atomically(path) as partial:
        (partial / "file").write_text("mine")
        path.mkdir()
        (path / "file").write_text("theirs")
    assert (path / "file").read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_there_is_used_only_if_it_may_be_overwritten(tmp_path):
    """Files, and folders that hold anything, are refused with the remedy; empty folders are not."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    for unused in ("empty", "nothing"):
        require_unused(tmp_path / unused, overwrite=False)
    for used in (tmp_path / "file", tmp_path):
        with pytest.raises(FileExistsError, match=r"is there already; .* --overwrite"):
            require_unused(used, overwrite=False)
        require_unused(used, overwrite=True)


def test_what_must_be_there_is_named(tmp_path):
    """A path that leads nowhere is said with what is needed."""
    require_existing(tmp_path, "a folder")
    with pytest.raises(FileNotFoundError, match=r"No such file.*nowhere; expected a scene"):
        require_existing(tmp_path / "nowhere", "a scene")


def test_full_disk_names_the_file_and_keeps_the_old(tmp_path):
    """What libraries say of a full disk, with an error number or without, becomes a sentence with
    the file and the remedy; an error about another file stays what it is."""
    path = tmp_path / "a.txt"
    path.write_text("old")
    for error in (OSError(errno.ENOSPC, "No space left on device"), OSError("8 requested, 0 done")):
        with (
            pytest.raises(OSError, match=r"a\.txt: cannot be written \(.*\); make room"),
            written_atomically(path),
        ):
            raise error
    with pytest.raises(FileNotFoundError, match="nowhere"), written_atomically(path):
        (tmp_path / "nowhere").read_text()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_found_broken_is_not_renamed(tmp_path):
    """A file that its check refuses does not take the place of the old one."""
    path = tmp_path / "a.txt"

    def check(written):
        if written.read_text() != "good":
            raise OSError("it is not good")

    with written_atomically(path, check) as partial:
        partial.write_text("good")
    with (
        pytest.raises(OSError, match=r"a\.txt: cannot be written \(it is not good\)"),
        written_atomically(path, check) as partial,
    ):
        partial.write_text("bad")
    assert path.read_text() == "good"
    assert list(tmp_path.iterdir()) == [path]


def test_replaced_folder_is_there_at_every_instant(tmp_path):
    """While a folder is replaced again and again, whoever looks finds it, and all of it."""
    path = tmp_path / "a"
    path.mkdir()
    (path / "file").write_text("0")
    over, found = threading.Event(), set()

    def look():
        while not over.is_set():
            found.add((path / "file").read_text())

    looking = threading.Thread(target=look)
    looking.start()
    try:
        for number in range(1, 30):
            with folder_written_atomically(path, replace=True) as partial:
                (partial / "file").write_text(str(number))
    finally:
        over.set()
        looking.join()
    assert found <= {str(number) for number in range(30)} and len(found) > 1
    assert (path / "file").read_text() == "29"
    assert list(tmp_path.iterdir()) == [path]


_KILLED = """
import os, signal, sys
from pathlib import Path
from splatpilot.systems.common.files import folder_written_atomically, written_atomically
folder = Path(sys.argv[1])
with written_atomically(folder / "a.txt") as file, folder_written_atomically(folder / "b") as inner:
    file.write_text("half")
    (inner / "c").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_kill_has_left_goes_with_the_next_run(tmp_path):
    """Temporary files and folders of processes that have ended are removed, and count as nothing;
    those of this process, which is at work, and all else stay."""
    subprocess.run([sys.executable, "-c", _KILLED, str(tmp_path)], check=False)
    assert len(list(tmp_path.iterdir())) == 2
    require_unused(tmp_path, overwrite=False)
    (tmp_path / ".mine.partial").write_text("")
    with written_atomically(tmp_path / "mine.txt") as partial:
        partial.write_text("")
        require_writable_folder(tmp_path)
        assert sorted(tmp_path.iterdir()) == sorted([tmp_path / ".mine.partial", partial])
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".mine.partial", "mine.txt"]
