from pathlib import Path

import pytest

from splatpilot.training.captures.capture import cache_folder, cache_key, prepare_cache
from splatpilot.training.captures.capture_config import CaptureConfig


def test_where(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder(CaptureConfig(cache="here"), "bags", "a") == Path("here")
    assert cache_folder(CaptureConfig(), "bags", "a") == tmp_path / "splatpilot/bags/a"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder(CaptureConfig(), "bags") == Path.home() / ".cache/splatpilot/bags"


def test_keys(tmp_path):
    one, other = tmp_path / "a", tmp_path / "b"
    one.write_text("1")
    other.write_text("1")
    names = [cache_key([one], 2), cache_key([other], 2), cache_key([one], 3)]
    assert cache_key([one], 2) == names[0]
    one.write_text("12")
    names.append(cache_key([one], 2))
    assert len(set(names)) == 4


def test_no_place(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"file/deep: cannot be written .*; set capture\.cache to"):
        prepare_cache(tmp_path / "file/deep")
    prepare_cache(tmp_path / "made/deep")
    assert (tmp_path / "made/deep").is_dir()
