import os

from splatpilot.systems.common.processes import available_cores


def test_cores_are_those_that_the_process_may_use(monkeypatch):
    """A process that is bound to some cores has those; where no system call tells, it has all."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {1, 5, 7}, raising=False)
    assert available_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert available_cores() == 6
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert available_cores() == 1
