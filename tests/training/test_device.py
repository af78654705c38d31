"""Devices that are asked for."""

import pytest
import torch

from splatpilot.training.device import require_device, require_renderer


def test_what_is_there_is_accepted():
    """The CPU always is."""
    require_device("cpu")
    require_renderer("cpu")


@pytest.mark.parametrize("device", ["cuda", "cuda:1"])
def test_a_gpu_that_is_absent_is_one_sentence(device, monkeypatch):
    """Its absence is said with the remedy, before anything is computed."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for require in (require_device, require_renderer):
        with pytest.raises(ValueError, match=rf"device is '{device}', but .* choose device=cpu"):
            require(device)


def test_rendering_on_a_gpu_needs_gsplat(monkeypatch):
    """Where only gsplat is missing, that is said; training alone does not need it."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    require_device("cuda")
    with pytest.raises(ValueError, match=r"splatpilot\[cuda\]"):
        require_renderer("cuda")


def test_other_words_are_refused():
    """A misspelled device is named with those that there are."""
    with pytest.raises(ValueError, match=r"device is 'gpu'; it must be cpu or cuda"):
        require_device("gpu")
