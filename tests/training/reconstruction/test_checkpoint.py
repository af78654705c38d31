import resource
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from room import write_room_capture

from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.reconstruction.checkpoint import event_log, save_tensors
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.optimize import Optimization
from splatpilot.training.reconstruction.reconstruct import reconstruct

CONFIG = ReconstructConfig(iterations=12, image_width=0, hold_out=6, initial_gaussians=1000)
CONFIG = replace(CONFIG, voxel_size=0.2, threads=1, checkpoint_every=4, strategy="default")
CONFIG = replace(CONFIG, refine_start=2, refine_every=3, reset_every=5, refine_fraction=1.0)


class KilledError(BaseException):
    """Ends a run where `kill -9` would."""


def test_killed_run_resumes_and_ends_in_the_same_scene(tmp_path, monkeypatch):
    out, work, left = (tmp_path / name for name in ("scene", ".scene.partial", "left"))
    save = torch.save

    def save_half(content, path):
        if content["step"] == 8:
            Path(path).write_bytes(b"half of it")
            shutil.copytree(work, left)  # as a kill would leave it
            raise KilledError
        save(content, path)

    capture = read_capture(write_room_capture(tmp_path / "room"))
    with monkeypatch.context() as patch, pytest.raises(KilledError):
        patch.setattr(torch, "save", save_half)
        reconstruct(capture, out, CONFIG)
    shutil.rmtree(work, ignore_errors=True)
    left.rename(work)
    assert any(file.read_bytes() == b"half of it" for file in work.iterdir())
    unread = replace(capture, load_image=lambda i: pytest.fail("an image was read"))
    with pytest.raises(ValueError, match=r"with depth_weight 0\.2, not 0\.3; .* --restart"):
        reconstruct(unread, out, replace(CONFIG, depth_weight=0.3))
    other = write_room_capture(tmp_path / "other", brightness=lambda i, rho: np.full(1, 0.9))
    with pytest.raises(ValueError, match="an interrupted run on another capture"):
        reconstruct(read_capture(other), out, CONFIG)
    assert not out.exists()

    steps, take_step = [], Optimization.take_step
    monkeypatch.setattr(
        Optimization, "take_step", lambda self: (steps.append(self.step), take_step(self))
    )
    reconstruct(capture, out, CONFIG)
    assert steps == list(range(4, 12))
    assert not work.exists()

    work.mkdir()
    (work / "checkpoint.pt").write_bytes(b"half of it")
    with pytest.raises(ValueError, match=r"checkpoint\.pt: not a readable checkpoint"):
        reconstruct(capture, out, CONFIG)
    resumed = {file.name: file.read_bytes() for file in out.iterdir()}
    reconstruct(capture, out, CONFIG, restart=True)
    assert not work.exists()
    for name in ("gaussians.ply", "scene.yaml", "esdf.npz"):
        assert (out / name).read_bytes() == resumed[name]


def test_full_disk_leaves_no_half_checkpoint(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
        with pytest.raises(OSError, match=r"checkpoint\.pt: cannot be written .perhaps the disk"):
            save_tensors({"means": torch.zeros(10_000)}, tmp_path / "checkpoint.pt")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert not list(tmp_path.iterdir())


def test_tensorboard_reads_logged_metrics(tmp_path):
    with event_log("") as log:
        log(1, {"psnr_db": 30.0})
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator", reason="no tensorboard"
    )
    with event_log(str(tmp_path / "events")) as log:
        log(500, {"psnr_db": 30.0})
    events = accumulator.EventAccumulator(str(tmp_path / "events")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("psnr_db")] == [(500, 30.0)]
