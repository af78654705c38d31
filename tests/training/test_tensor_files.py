import pytest
import torch

from splatpilot.training.reconstruction.checkpoint import save_tensors


def test_tensors_come_back(tmp_path):
    """What is saved is what `torch.load` reads without running code."""
    save_tensors({"a": torch.arange(3), "b": {"c": 1.5}}, tmp_path / "checkpoint.pt")
    read = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert read["a"].tolist() == [0, 1, 2] and read["b"] == {"c": 1.5}


def test_full_disk_names_the_file_and_keeps_the_old(tmp_path, monkeypatch):
    """torch's RuntimeError about a full disk becomes an OSError with the file."""
    path = tmp_path / "checkpoint.pt"
    save_tensors({"a": torch.arange(3)}, path)
    before = path.read_bytes()

    def fail(content, file):
        file.write_bytes(b"half")
        raise RuntimeError("[enforce fail at inline_container.cc:778] . PytorchStreamWriter failed")

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(OSError, match=r"checkpoint\.pt: cannot be written \(.*Writer failed"):
        save_tensors({"a": torch.arange(4)}, path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
