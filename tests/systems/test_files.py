"""Atomic files."""

import pytest

from splatpilot.systems.files import (
    folder_written_atomically,
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
