"""Folders that environment variables name."""

from pathlib import Path

import pytest

from splatpilot.systems.common.files import DATA, find_data


@pytest.fixture
def data(tmp_path, monkeypatch) -> Path:
    """A folder of data in which `tartanair/hospital` is, outside the working directory."""
    (tmp_path / "data" / "tartanair" / "hospital").mkdir(parents=True)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv(DATA, str(tmp_path / "data"))
    return tmp_path / "data"


@pytest.mark.parametrize("name", ["hospital", "tartanair/hospital"])
def test_a_capture_is_found_in_the_folder_of_data_and_told(name, data, capsys):
    found = data / "tartanair" / "hospital"
    assert find_data(Path(name), "a capture") == found
    assert capsys.readouterr().out == f"{name} is {found}\n"


def test_the_working_directory_comes_first(data, capsys):
    Path("hospital").mkdir()
    assert find_data(Path("hospital"), "a capture") == Path("hospital")
    assert not capsys.readouterr().out


@pytest.mark.parametrize("is_set", [True, False])
def test_an_absent_capture_is_told_with_where_it_was_looked_for(is_set, data, monkeypatch):
    if not is_set:
        monkeypatch.delenv(DATA)
    where = str(data) if is_set else rf"the folder that {DATA} names \(it is not set\)"
    message = rf"^No such file or folder: hospitl; expected a capture, here or in {where}$"
    with pytest.raises(FileNotFoundError, match=message):
        find_data(Path("hospitl"), "a capture")
