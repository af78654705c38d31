"""Atomic files."""

import pytest

from splatpilot.systems.files import (
    folder_written_atomically,
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
    with pytest.raises(FileNotFoundError, match=r"nowhere: there is no .*; a scene is needed"):
        require_existing(tmp_path / "nowhere", "a scene")
