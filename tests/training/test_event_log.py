import pytest

from splatpilot.training.reconstruction.checkpoint import event_log


def test_event_log_writes_what_tensorboard_reads(tmp_path):
    """Numbers that are logged are read again by tensorboard; without a folder nothing is."""
    with event_log("") as log:
        log(1, {"psnr_db": 30.0})
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator", reason="no tensorboard"
    )
    with event_log(str(tmp_path / "events")) as log:
        log(500, {"psnr_db": 30.0})
    events = accumulator.EventAccumulator(str(tmp_path / "events")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("psnr_db")] == [(500, 30.0)]
