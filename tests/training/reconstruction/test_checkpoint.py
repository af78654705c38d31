"""Interrupted reconstructions."""

import resource
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.optimize import Optimization
from splatpilot.training.reconstruction.reconstruct import reconstruct

CONFIG = ReconstructConfig(
    iterations=24,
    image_width=0,
    hold_out=6,
    voxel_size=0.2,
    threads=1,
    checkpoint_every=8,
    strategy="default",
    refine_start=2,
    refine_every=5,
    reset_every=11,
    refine_fraction=1.0,
)

# A process that kills itself, as `kill -9` would, in its 20th step or halfway through its second
# checkpoint.
_CHILD = """
import os, signal, sys, torch
from pathlib import Path
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.reconstruction.optimize import Optimization
from splatpilot.training.reconstruction.reconstruct import reconstruct
from tests_config import CONFIG

room, out, when = sys.argv[1:]
take_step, save = Optimization.take_step, torch.save

def step(self):
    if self.step == 19:
        os.kill(os.getpid(), signal.SIGKILL)
    take_step(self)

def save_half(content, path):
    if content["step"] == 16:
        Path(path).write_bytes(b"half of it")
        os.kill(os.getpid(), signal.SIGKILL)
    save(content, path)

if when == "step":
    Optimization.take_step = step
else:
    torch.save = save_half
reconstruct(read_capture(room), out, CONFIG)
"""


def kill_a_run(tmp_path, room, out, when: str) -> None:
    (tmp_path / "tests_config.py").write_text(
        "from splatpilot.training.captures.capture_config import CaptureConfig, ScaleConfig\n"
        "from splatpilot.training.reconstruction.config import ReconstructConfig\n"
        f"CONFIG = {CONFIG!r}\n"
    )
    child = subprocess.run(
        [sys.executable, "-c", _CHILD, room, out, when], cwd=tmp_path, capture_output=True
    )
    assert child.returncode == -signal.SIGKILL, child.stderr.decode()


@pytest.fixture
def room(tmp_path, write_room):
    return write_room(tmp_path / "room")


def assert_same_scene(tmp_path, room, out) -> None:
    reconstruct(read_capture(room), tmp_path / "whole", CONFIG)
    for file in ("gaussians.ply", "scene.yaml", "esdf.npz"):
        assert (out / file).read_bytes() == (tmp_path / "whole" / file).read_bytes()


def test_a_killed_run_goes_on_and_ends_in_the_same_scene(tmp_path, room, write_room, monkeypatch):
    out = tmp_path / "scene"
    kill_a_run(tmp_path, room, out, "step")
    unread = replace(read_capture(room), load_image=lambda i: pytest.fail("an image was read"))
    with pytest.raises(ValueError, match=r"with depth_weight 0\.2, not 0\.3; .* --restart"):
        reconstruct(unread, out, replace(CONFIG, depth_weight=0.3))
    other = write_room(tmp_path / "other", brightness=lambda i, rho: np.full(1, 0.9))
    with pytest.raises(ValueError, match="an interrupted run on another capture"):
        reconstruct(read_capture(other), out, CONFIG)
    assert not out.exists()

    steps = []
    take_step = Optimization.take_step
    monkeypatch.setattr(
        Optimization, "take_step", lambda self: (steps.append(self.step), take_step(self))
    )
    reconstruct(read_capture(room), out, CONFIG)
    assert steps == list(range(16, 24))
    assert not (tmp_path / ".scene.partial").exists()
    assert_same_scene(tmp_path, room, out)


def test_a_run_killed_while_it_wrote_a_checkpoint(tmp_path, room):
    out = tmp_path / "scene"
    kill_a_run(tmp_path, room, out, "checkpoint")
    reconstruct(read_capture(room), out, CONFIG)
    assert_same_scene(tmp_path, room, out)

    file = tmp_path / ".scene.partial" / "checkpoint.pt"
    file.parent.mkdir()
    file.write_bytes(b"half of it")
    with pytest.raises(ValueError, match=r"checkpoint\.pt: not a readable checkpoint"):
        reconstruct(read_capture(room), out, CONFIG)
    reconstruct(read_capture(room), out, CONFIG, restart=True)
    assert_same_scene(tmp_path, room, out)
    assert not file.exists()


def test_a_full_disk_is_one_message_and_leaves_the_last_checkpoint(tmp_path, room):
    out = tmp_path / "scene"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
        with pytest.raises(OSError, match=r"checkpoint\.pt: cannot be written .perhaps the disk"):
            reconstruct(read_capture(room), out, CONFIG)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert not out.exists()
    assert list((tmp_path / ".scene.partial").iterdir()) == []
