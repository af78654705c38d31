"""Flights in which something goes wrong, and that nothing worse comes of it."""

import json
import os
import shutil

import lcm
import numpy as np
import pytest
from drake import lcmt_header

from splatpilot.analysis.cli import main
from splatpilot.analysis.faults.fault import DELAY, KINDS, Fault
from splatpilot.analysis.faults.relay import Relay
from splatpilot.analysis.faults.run import FaultsConfig, summarize
from splatpilot.systems.messaging.codecs import CommandCodec, StateCodec
from splatpilot.systems.vehicle.quadrotor_dynamics import hover_state


class Line:
    """States sent through a relay every 20 ms, and what arrives of them."""

    def __init__(self, kind: str, part: float = 1.0, size: float = 2.0):
        near, far = lcm.LCM("memq://"), lcm.LCM("memq://")
        fault = Fault(kind, begin=1.0, duration=1.0, part=part, size=size)
        random = np.random.default_rng(0)
        relay = Relay(near, far, [StateCodec()], [CommandCodec()], fault, random)
        self.heard = []
        far.subscribe("QUADROTOR_STATE", lambda _, data: self.heard.append((now, data)))
        self.sent = []
        for number in range(150):
            now = 0.02 * number
            header = lcmt_header()
            header.seq, header.utime, header.frame_name = number, round(now * 1e6), "world"
            state = hover_state([number * 0.1, 0.0, 2.0])
            self.sent.append(StateCodec().pack(state, header, 0.0).encode())
            near.publish("QUADROTOR_STATE", self.sent[-1])
            relay.step(now)
            while far.handle_timeout(0):
                pass
        self.during = [row for row in self.heard if 1.0 <= row[0] < 2.0]

    def numbers(self) -> list[int]:
        return [StateCodec.message.decode(data).header.seq for _, data in self.heard]


def test_without_a_fault_everything_arrives_at_once():
    """Before and after a fault messages are the very bytes that were sent, in order."""
    line = Line("policy_killed")
    assert [data for _, data in line.heard] == line.sent
    np.testing.assert_allclose([now for now, _ in line.heard], 0.02 * np.arange(150))


def test_a_relay_ends_with_what_it_connects():
    """Hundreds of trials in one process open no more files than one."""
    Line("dropped")
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        Line("dropped")
    assert len(os.listdir("/proc/self/fd")) == before


def test_each_fault_of_messages_is_what_it_is_called():
    """All messages of its second are lost, late, doubled or mixed up, and none of the others."""
    assert Line("dropped").numbers() == [*range(50), *range(100, 150)]
    late = Line("delayed")
    by_number = dict(zip(late.numbers(), (now for now, _ in late.heard), strict=True))
    assert by_number[70] == pytest.approx(1.4 + DELAY, abs=0.021)
    assert by_number[20] == pytest.approx(0.4)
    assert sorted(Line("duplicated").numbers()) == sorted([*range(150), *range(50, 100)])
    mixed = Line("reordered").numbers()
    assert mixed != sorted(mixed) and sorted(mixed) == list(range(150))


def test_contents_are_spoilt_as_they_are_called():
    """Corrupt messages differ from what was sent; frozen ones have new times and one content; after
    a jump of the clock all times are off."""
    assert not {data for _, data in Line("corrupt").during} & set(Line("corrupt").sent[50:100])
    frozen = [StateCodec.message.decode(data) for _, data in Line("state_frozen").during]
    assert {message.p_WB for message in frozen} == {(5.0, 0.0, 2.0)}
    assert len({message.header.utime for message in frozen}) == 50
    jumped = StateCodec.message.decode(Line("clock_jump").heard[-1][1])
    assert jumped.header.utime == round((149 * 0.02 + 2.0) * 1e6)
    spoilt = Line("not_finite")
    assert all(len(data) == len(spoilt.sent[0]) for _, data in spoilt.heard)
    assert not {data for _, data in spoilt.during} & set(spoilt.sent)


def test_kinds_take_turns_and_repeat():
    """Every kind is tried as often as the others, and a trial's fault is that of its number."""
    draw = [Fault.draw(n, np.random.default_rng([0, n])) for n in range(2 * len(KINDS))]
    assert [fault.kind for fault in draw] == [*KINDS, *KINDS]
    assert draw[3] == Fault.draw(3, np.random.default_rng([0, 3])) != draw[3 + len(KINDS)]


def test_a_campaign_is_safe_goes_on_where_it_stopped_and_repeats(tmp_path):
    """Trials of some kinds end in no accident; the campaign, interrupted after one of them, ends as
    one that was not, and its summary says how."""
    settings = ["world.length=12.0", "world.width=6.0", "start_radius=0.05"]
    sets = [word for setting in settings for word in ("--set", f"scenario.{setting}")]
    words = ["faults", "--set", "trials=2", "--set", "worlds=1", *sets]
    assert main([*words, "--out", str(tmp_path / "whole")]) == 0
    rows = (tmp_path / "whole" / "trials.jsonl").read_text().splitlines(keepends=True)
    assert len(rows) == 2 and all(json.loads(row)["safe"] for row in rows)
    again = tmp_path / "again"
    again.mkdir()
    shutil.copy(tmp_path / "whole" / "config.yaml", again)
    (again / "trials.jsonl").write_text(rows[0])
    assert main([*words, "--out", str(again)]) == 0
    assert (again / "trials.jsonl").read_text() == "".join(rows)
    summary = json.loads((again / "summary.json").read_text())
    assert (summary["trials"], summary["safe"]) == (2, 2)
    assert main([*words, "--set", "seed=1", "--out", str(again)]) == 1


def test_accidents_are_counted():
    """A trial that was not safe is no safe one in the summary."""
    row = {"kind": "dropped", "safe": True, "outcome": "hover"}
    summary = summarize([row, {**row, "safe": False, "outcome": "collision"}])
    assert (summary["trials"], summary["safe"]) == (2, 1)
    assert summary["kinds"]["dropped"]["outcomes"] == {"collision": 1, "hover": 1}


def test_bad_config_is_named():
    """A value out of range names the field."""
    with pytest.raises(ValueError, match="trials is 0; it must be at least 1"):
        FaultsConfig(trials=0).validate()
