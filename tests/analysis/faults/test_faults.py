"""Flights in which something goes wrong, and that nothing worse comes of it."""

import json
import os
import shutil
import socket
import struct

import lcm
import numpy as np
import pytest
from drake import lcmt_header

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.faults.campaign import FaultsConfig, summarize
from splatpilot.analysis.faults.trial import (
    DELAY,
    KINDS,
    Fault,
    GridStream,
    Relay,
    Trial,
    fly_trial,
)
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.messaging.codecs import (
    CommandCodec,
    DepthGridCodec,
    MotionCaptureCodec,
    StateCodec,
)
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.vehicle.quadrotor import hover_state


class Line:
    """States sent through a relay every 20 ms, and what arrives of them."""

    def __init__(self, *kinds: str, size: float = 2.0):
        near, far = lcm.LCM("memq://"), lcm.LCM("memq://")
        faults = tuple(Fault(kind, 1.0, duration=1.0, fraction=1.0, size=size) for kind in kinds)
        random = np.random.default_rng(0)
        relay = Relay(near, far, [StateCodec()], [CommandCodec()], faults, random)
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
    line = Line("policy_killed")
    assert [data for _, data in line.heard] == line.sent
    np.testing.assert_allclose([now for now, _ in line.heard], 0.02 * np.arange(150))


def test_a_relay_ends_with_what_it_connects():
    Line("dropped")
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        Line("dropped")
    assert len(os.listdir("/proc/self/fd")) == before


def test_each_fault_of_messages_is_what_it_is_called():
    assert Line("dropped").numbers() == [*range(50), *range(100, 150)]
    late = Line("delayed")
    by_number = dict(zip(late.numbers(), (now for now, _ in late.heard), strict=True))
    assert by_number[70] == pytest.approx(1.4 + DELAY, abs=0.021)
    assert by_number[20] == pytest.approx(0.4)
    assert sorted(Line("duplicated").numbers()) == sorted([*range(150), *range(50, 100)])
    mixed = Line("reordered").numbers()
    assert mixed != sorted(mixed) and sorted(mixed) == list(range(150))


def test_contents_are_spoilt_as_they_are_called():
    assert not {data for _, data in Line("corrupt").during} & set(Line("corrupt").sent[50:100])
    frozen = [StateCodec.message.decode(data) for _, data in Line("state_frozen").during]
    assert {message.p_WB for message in frozen} == {(5.0, 0.0, 2.0)}
    assert len({message.header.utime for message in frozen}) == 50
    jumped = StateCodec.message.decode(Line("clock_jump").heard[-1][1])
    assert jumped.header.utime == round((149 * 0.02 + 2.0) * 1e6)
    spoilt = Line("not_finite")
    assert all(len(data) == len(spoilt.sent[0]) for _, data in spoilt.heard)
    assert not {data for _, data in spoilt.during} & set(spoilt.sent)


def test_a_state_that_jumps_is_meters_away_and_of_two_faults_both_happen():
    jumped = [StateCodec.message.decode(data) for _, data in Line("state_jumped").during]
    assert {message.p_WB[1] for message in jumped} == {3.0}
    both = [
        (now, StateCodec.message.decode(data))
        for now, data in Line("delayed", "state_frozen").heard
    ]
    hit = [(now, message) for now, message in both if 50 <= message.header.seq < 100]
    assert {message.p_WB for _, message in hit} == {(5.0, 0.0, 2.0)}
    late = [now - 0.02 * message.header.seq for now, message in hit]
    np.testing.assert_allclose(late, DELAY, atol=0.021)


@pytest.mark.parametrize(
    ("kind", "tracked"), [("body_lost", [False]), ("body_dropped", []), ("grid_dropped", [True])]
)
def test_motion_capture_is_lost_as_it_is_called(kind, tracked):
    near, far, heard, codec = lcm.LCM("memq://"), lcm.LCM("memq://"), [], MotionCaptureCodec("a")
    fault = Fault(kind, begin=0.0, duration=1.0, fraction=1.0, size=1.0)
    relay = Relay(near, far, [codec], [], (fault,), np.random.default_rng(0))
    far.subscribe(codec.channel, lambda _, data: heard.append(codec.message.decode(data).tracked))
    header = lcmt_header()
    header.frame_name = "world"
    near.publish(codec.channel, codec.pack(np.array([1.0, 2, 3, 1, 0, 0, 0]), header, 0.0).encode())
    relay.step(0.5)
    while far.handle_timeout(0):
        pass
    assert heard == tracked


@pytest.mark.parametrize(("kind", "came"), [("body_lost", True), ("grid_dropped", False)])
def test_grids_travel_as_packets_of_the_sensor(kind, came):
    codec, near = DepthGridCodec(16, 9, 5.0, "policy_camera"), lcm.LCM("memq://")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as inbox:
        inbox.bind(("127.0.0.1", 0))
        inbox.settimeout(0.2)
        fault = Fault(kind, begin=0.0, duration=1.0, fraction=1.0, size=1.0)
        stream = GridStream(inbox.getsockname()[1])
        random = np.random.default_rng(0)
        relay = Relay(near, lcm.LCM("memq://"), [codec], [], (fault,), random, stream)
        header = lcmt_header()
        header.seq, header.utime, header.frame_name = 3, 7, codec.frame
        near.publish(codec.channel, codec.pack(np.full(144, 0.25), header, 0.0).encode())
        relay.step(0.5)
        try:
            packet = inbox.recv(65536)
        except TimeoutError:
            packet = b""
    expected = struct.pack("<IIQ144f", 0x544F4632, 3, 7000, *[0.25] * 144)
    assert packet == (expected if came else b"")


def test_kinds_interfaces_and_policies_take_turns_and_repeat():
    count = 4 * len(KINDS)
    trials = [Trial.sample(n, np.random.default_rng([0, n])) for n in range(count)]
    for number, trial in enumerate(trials):
        kinds = [fault.kind for fault in trial.faults]
        assert KINDS[number % len(KINDS)] in kinds and len(set(kinds)) == len(kinds)
        grids = any(kind.startswith("grid") for kind in kinds)
        assert (trial.policy == "diffaero_tof") == grids
    assert {trial.setpoints for trial in trials} == {"velocity", "body_rates"}
    assert {trial.policy for trial in trials} == {"straight", "reactive", "diffaero_tof"}
    pairs = sum(len(trial.faults) == 2 for trial in trials)
    assert 0.3 * count < pairs < 0.7 * count
    assert trials[3] == Trial.sample(3, np.random.default_rng([0, 3])) != trials[3 + len(KINDS)]


@pytest.mark.parametrize("setpoints", ["velocity", "body_rates"])
def test_a_state_that_freezes_while_images_are_lost_ends_in_no_accident(setpoints):
    scenario = Scenario(
        world=ForestConfig(length=12.0, width=6.0), policy=policy_named("straight", 2.0)
    )
    world = make_world(scenario.world, 0)
    faults = tuple(Fault(kind, 1.5, 2.0, 1.0, 1.0) for kind in ("dropped", "state_frozen"))
    trial = Trial(faults, "straight", setpoints)
    row = fly_trial(scenario, world, trial, FlightLimits(max_speed=2.5), 0)
    assert row["safe"]
    assert row["min_clearance"] >= 0.09


def test_a_campaign_is_safe_goes_on_where_it_stopped_and_repeats(tmp_path):
    settings = ["world.length=12.0", "world.width=6.0", "start_radius=0.05"]
    sets = [word for setting in settings for word in ("--set", f"scenario.{setting}")]
    words = ["hardware", "faults", "--set", "trials=2", "--set", "worlds=1", *sets]
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
    row = {"faults": [{"kind": "dropped"}], "safe": True, "outcome": "hover"}
    summary = summarize([row, {**row, "safe": False, "outcome": "collision"}])
    assert (summary["trials"], summary["safe"]) == (2, 1)
    assert summary["kinds"]["dropped"]["outcomes"] == {"collision": 1, "hover": 1}


def test_bad_config_is_named():
    with pytest.raises(ValueError, match=r"trials must be in \[1, inf\), got 0"):
        FaultsConfig(trials=0).validate()
