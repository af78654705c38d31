"""Atomic files."""

import pytest

from splatpilot.systems.files import require_writable_folder, written_atomically


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
