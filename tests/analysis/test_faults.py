import json
import os
import shutil
import socket
import struct
from dataclasses import replace
from functools import cached_property

import lcm
import numpy as np
import pytest
from drake import lcmt_header

import splatpilot as sp
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.faults import (
    DELAY,
    FAULTY_POLICIES,
    KINDS,
    Fault,
    Relay,
    Trial,
    fly_trial,
    summarize,
)
from splatpilot.diagrams.worlds.forest.forest import ForestConfig
from splatpilot.systems.messaging.codecs import (
    CommandCodec,
    DepthGridCodec,
    MotionCaptureCodec,
    StateCodec,
    VehicleStatusCodec,
)
from splatpilot.systems.messaging.flight_limits import FlightLimits
from splatpilot.systems.messaging.generated import lcmt_bridge_status
from splatpilot.systems.vehicle.quadrotor import hover_state


def encoded(codec, value, number: int = 0, utime: int = 0) -> bytes:
    header = lcmt_header()
    header.seq, header.utime, header.frame_name = number, utime, codec.frame
    return codec.pack(np.asarray(value), header, 0.0).encode()


class Line:
    """States sent through a relay every 20 ms; those from 1 s to 2 s have faults."""

    def __init__(self, *kinds: str, size: float = 2.0):
        near, far, codec = lcm.LCM("memq://"), lcm.LCM("memq://"), StateCodec()
        hit = tuple(Fault(kind, 1.0, duration=1.0, fraction=1.0, size=size) for kind in kinds)
        relay = Relay(near, far, [codec], [CommandCodec()], hit, np.random.default_rng(0))
        self.heard, self.sent = [], []
        far.subscribe(codec.channel, lambda _, data: self.heard.append((now, data)))
        for number in range(150):
            now = 0.02 * number
            state = hover_state([number * 0.1, 0.0, 2.0])
            self.sent.append(encoded(codec, state, number, round(now * 1e6)))
            near.publish(codec.channel, self.sent[-1])
            relay.step(now)
            while far.handle_timeout(0):
                pass
        self.during = [data for when, data in self.heard if 1.0 <= when < 2.0]

    @cached_property
    def messages(self) -> list:
        return [StateCodec.message.decode(data) for _, data in self.heard]

    def hit(self) -> list:
        """Returns the messages that have the faults."""
        return [each for each in self.messages if 50 <= each.header.seq < 100]

    def numbers(self) -> list[int]:
        return [message.header.seq for message in self.messages]

    def delays(self) -> dict[int, float]:
        return {n: now - 0.02 * n for n, (now, _) in zip(self.numbers(), self.heard, strict=True)}


def test_without_a_fault_everything_arrives_at_once():
    line = Line("policy_killed")
    assert [data for _, data in line.heard] == line.sent
    assert max(map(abs, line.delays().values())) < 1e-9


def test_a_relay_ends_with_its_transports():
    numbers = [len(os.listdir("/proc/self/fd")) for _ in range(3) if Line("dropped")]
    assert numbers[0] == numbers[-1]


@pytest.mark.parametrize(
    ("kind", "numbers"),
    [
        *((kind, range(0)) for kind in ("dropped", "state_off", "link_off")),
        *((kind, (50, 75)) for kind in ("slow", "state_slow")),  # 0.5 s, at a fraction of 1
        ("duplicated", np.repeat(range(50, 100), 2)),
    ],
)
def test_messages_are_dropped_or_duplicated(kind, numbers):
    assert sorted(Line(kind).numbers()) == [*range(50), *numbers, *range(100, 150)]


def test_messages_are_delayed_and_reordered():
    for kind in ("delayed", "state_delayed"):
        delays = Line(kind).delays()
        assert delays[70] == pytest.approx(DELAY, abs=0.021) and delays[20] == pytest.approx(0.0)
    mixed = Line("reordered").numbers()
    assert mixed != sorted(mixed) == list(range(150))


def test_contents_are_corrupted():
    for kind in ("corrupt", "not_finite"):
        line = Line(kind)
        assert not set(line.during) & set(line.sent[50:100])
    assert all(len(data) == len(line.sent[0]) for data in line.during)
    noise = Line("state_garbage").hit()
    np.testing.assert_allclose([np.linalg.norm(message.q_WB) for message in noise], 1.0)
    assert len({message.p_WB for message in noise}) == 50


def test_states_freeze_and_jump_and_clocks_too():
    frozen = Line("state_frozen").hit()
    assert {message.p_WB for message in frozen} == {(5.0, 0.0, 2.0)}
    assert len({message.header.utime for message in frozen}) == 50
    assert {message.p_WB[1] for message in Line("state_jumped").hit()} == {3.0}
    rotated = {message.q_WB for message in Line("heading_jumped").hit()}
    np.testing.assert_allclose([*rotated], [[np.cos(1.25), 0, 0, np.sin(1.25)]])
    last = Line("clock_jump").messages[-1]
    assert last.header.utime == round((149 * 0.02 + 2.0) * 1e6)


def test_two_faults_both_happen():
    line = Line("delayed", "state_frozen")
    assert {message.p_WB for message in line.hit()} == {(5.0, 0.0, 2.0)}
    late = [line.delays()[message.header.seq] for message in line.hit()]
    np.testing.assert_allclose(late, DELAY, atol=0.021)


def relayed(codec, value, kind: str, number: int = 0, **port) -> list:
    """Returns a message as it comes through a relay with a fault, and "command" if one does."""
    near, far, heard, random = lcm.LCM("memq://"), lcm.LCM("memq://"), [], np.random.default_rng(0)
    faults = (Fault(kind, begin=0.0, duration=1.0, fraction=1.0, size=1.0),)
    relay = Relay(near, far, [codec], [CommandCodec()], faults, random, **port)
    far.subscribe(codec.channel, lambda _, data: heard.append(codec.message.decode(data)))
    near.subscribe(CommandCodec.channel, lambda _, data: heard.append("command"))
    near.publish(codec.channel, encoded(codec, value, number, 7))
    far.publish(CommandCodec.channel, encoded(CommandCodec(), [9.8, 0.0, 0.0, 0.0]))
    relay.step(0.5)
    while far.handle_timeout(0) or near.handle_timeout(0):
        pass
    return heard


@pytest.mark.parametrize(
    ("kind", "tracked"), [("body_lost", [False]), ("body_dropped", []), ("grid_dropped", [True])]
)
def test_motion_capture_loses_the_body_or_messages(kind, tracked):
    *messages, command = relayed(MotionCaptureCodec("a"), [1.0, 2, 3, 1, 0, 0, 0], kind)
    assert [message.tracked for message in messages] == tracked and command == "command"


def test_a_vehicle_that_left_offboard_mode_hears_no_commands():
    (status,) = relayed(VehicleStatusCodec(), [1.0, 1.0], "offboard_left")
    assert (status.armed, status.offboard) == (True, False)


def test_grids_travel_as_packets_of_the_sensor():
    codec = DepthGridCodec(16, 9, 5.0, "policy_camera")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as inbox:
        inbox.bind(("127.0.0.1", 0))
        inbox.settimeout(2.0)
        for kind, number in (("grid_dropped", 2), ("body_lost", 3)):  # only the second arrives
            relayed(codec, np.full(144, 0.25), kind, number, grid_port=inbox.getsockname()[1])
        assert inbox.recv(65536) == struct.pack("<IIQ144f", 0x544F4632, 3, 7000, *[0.25] * 144)


def test_faults_interfaces_and_policies_alternate_and_repeat():
    count = 2 * len(FAULTY_POLICIES) * len(KINDS)
    trials = [Trial.sample(n, np.random.default_rng([0, n])) for n in range(count)]
    for number, trial in enumerate(trials):
        kinds = [fault.kind for fault in trial.faults]
        assert KINDS[number % len(KINDS)] in kinds and len(set(kinds)) == len(kinds)
        grids = any(kind.startswith("grid") for kind in kinds)
        assert trial.policy == "diffaero_tof" or not grids
    assert {trial.setpoints for trial in trials} == {"velocity", "body_rates"}
    assert {trial.policy for trial in trials} == set(FAULTY_POLICIES)
    pairs = sum(len(trial.faults) == 2 for trial in trials)
    assert 0.3 * count < pairs < 0.7 * count
    assert trials[3] == Trial.sample(3, np.random.default_rng([0, 3])) != trials[3 + len(KINDS)]


def test_a_campaign_is_safe_resumes_and_repeats(tmp_path, set_fields, capsys, monkeypatch):
    monkeypatch.setattr("splatpilot.analysis.faults.revision", lambda: "this")
    fields = "seed=37", "trials=2", "worlds=1", "scenario.world.length=10", "scenario.world.width=6"
    words = ["hardware", "faults", *set_fields(*fields, "scenario.start_radius=0.05"), "--jobs=1"]
    whole, again = tmp_path / "whole", tmp_path / "again"
    assert main([*words, "--out", str(whole)]) == 0
    rows = (whole / "trials.jsonl").read_text().splitlines(keepends=True)
    assert [json.loads(row)["seed"] for row in rows if json.loads(row)["safe"]] == [37, 38]
    again.mkdir()
    shutil.copy(whole / "config.yaml", again)
    (again / "trials.jsonl").write_text(rows[0])
    assert main([*words, "--out", str(again)]) == 0
    assert (again / "trials.jsonl").read_text() == "".join(rows)
    summary = json.loads((again / "summary.json").read_text())
    assert (summary["trials"], summary["safe"]) == (2, 2)
    for other in ("seed=1", "trials=0"):
        assert main([*words, *set_fields(other), "--out", str(again)]) == 1
    (again / "trials.jsonl").write_text(json.dumps(json.loads(rows[0]) | {"revision": "other"}))
    assert main([*words, "--out", str(again)]) == 1
    assert "revision of" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("policy", "setpoints", "kinds", "when"),
    [
        ("diffaero", "velocity", ["policy_nonsense"], 0.5),  # accelerations
        ("agile_autonomy", "velocity", ["policy_nonsense"], 0.5),  # hypotheses
        ("straight", "body_rates", ["dropped", "state_frozen"], 1.0),
    ],
)
def test_a_vehicle_survives(forest, policy, setpoints, kinds, when):
    scenario, world = replace(forest[0], policy=sp.policy_named(policy, 2.0)), forest[1]
    trial = Trial(tuple(Fault(kind, when, when, when, 1.0) for kind in kinds), policy, setpoints)
    row = fly_trial(scenario, world, trial, FlightLimits(max_speed=2.5), 0)
    assert row["safe"] and row["min_clearance"] >= 0.09
    assert policy == "straight" or lcmt_bridge_status.NOT_FINITE in row["reasons"]


@pytest.fixture(scope="module")
def forest() -> tuple[sp.Scenario, sp.World]:
    scenario = sp.Scenario(world=ForestConfig(length=10.0, width=6.0))
    return scenario, sp.make_world(scenario.world, 0)


def test_accidents_are_counted():
    row = {"faults": [{"kind": "dropped"}], "safe": True, "outcome": "hover"}
    summary = summarize([row, {**row, "safe": False, "outcome": "collision"}])
    assert (summary["trials"], summary["safe"]) == (2, 1)
    assert summary["kinds"]["dropped"]["outcomes"] == {"collision": 1, "hover": 1}
