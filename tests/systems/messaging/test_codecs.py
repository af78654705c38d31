"""From arrays to messages and back."""

import numpy as np
import pytest
from drake import lcmt_header

from splatpilot.systems.messaging.codecs import (
    CommandCodec,
    DepthGridCodec,
    HypothesesCodec,
    MotionCaptureCodec,
    StateCodec,
    StatusCodec,
    VehicleStatusCodec,
    VelocitySetpointCodec,
)
from splatpilot.systems.policies.hypotheses import no_plan

UNIT = [0.5, -0.5, 0.5, 0.5]
EPOCH = 1_800_000_000.0
PLAN = np.concatenate([[2.5, 1, 2, 3], UNIT, np.linspace(-3, 3, 60), [0.3, 0.1]])
SIGNALS = [
    (StateCodec(), [1.0, 2, 3, 4, 5, 6, *UNIT, 7, 8, 9]),
    (CommandCodec(), [9.81, 0.1, -0.2, 0.3]),
    (VelocitySetpointCodec(), [1.0, -2, 0.5, 1.5]),
    (VelocitySetpointCodec(), [1.0, -2, 0.5, np.nan]),
    (HypothesesCodec(2), PLAN),
    (MotionCaptureCodec("drone"), [1.0, 2, 3, *UNIT]),
    (DepthGridCodec(2, 3, 5.0, "tof"), [0.0, 0.25, 0.5, 0.75, 1.0, 0.125]),
    (StatusCodec(), [1.0, 0.0, 0.01, np.inf, 2, 3, 4]),
    (VehicleStatusCodec(), [1.0, 0.0]),
]


def sent(codec, value, epoch=EPOCH):
    """The message of a value as it arrives."""
    header = lcmt_header()
    header.seq, header.utime, header.frame_name = 3, 1_800_000_002_000_000, codec.frame
    message = codec.pack(np.asarray(value, dtype=float), header, epoch)
    return codec.message.decode(message.encode())


@pytest.mark.parametrize(("codec", "value"), SIGNALS, ids=lambda v: type(v).__name__)
def test_what_is_sent_arrives(codec, value):
    """An array survives its message, and so do time, number and frame."""
    message = sent(codec, value)
    assert codec.size == len(value)
    np.testing.assert_allclose(codec.unpack(message, EPOCH), value, rtol=0, atol=3e-7)
    assert (message.header.seq, message.header.utime) == (3, 1_800_000_002_000_000)
    assert message.header.frame_name == codec.frame


def test_fields_have_their_names():
    """The parts of state, command and plan are where the message types say."""
    state = sent(StateCodec(), SIGNALS[0][1])
    assert state.p_WB == (1, 2, 3)
    assert state.v_WB == (4, 5, 6)
    assert state.q_WB == tuple(UNIT)
    assert state.w_WB_B == (7, 8, 9)
    command = sent(CommandCodec(), [9.81, 0.1, -0.2, 0.3])
    assert (command.thrust, command.w_cmd_B) == (9.81, (0.1, -0.2, 0.3))
    plan = sent(HypothesesCodec(2), PLAN)
    assert plan.plan_utime == 1_800_000_002_500_000
    assert plan.waypoints_P[1][0] == tuple(PLAN[8 + 30 : 8 + 33])
    assert plan.costs == (0.3, 0.1)


def test_plans_keep_their_time_between_clocks():
    """A plan is as old for who receives it as for who made it, whatever their time 0."""
    codec = HypothesesCodec(2)
    there = codec.unpack(sent(codec, PLAN, epoch=EPOCH), epoch=EPOCH - 100.0)
    assert there[0] == pytest.approx(102.5, abs=1e-6)


@pytest.mark.parametrize(
    ("codec", "unknown"), [(HypothesesCodec(3), no_plan(3)), (VehicleStatusCodec(), [np.nan] * 2)]
)
def test_what_is_unknown_is_no_message(codec, unknown):
    assert codec.pack(np.array(unknown), lcmt_header(), EPOCH) is None


def test_each_sender_has_a_session_of_its_own():
    codec, other = StateCodec(), StateCodec()
    sessions = [sent(each, SIGNALS[0][1]).session for each in (codec, codec, other)]
    assert sessions[0] == sessions[1] != sessions[2]


def change(field, value):
    return lambda message: setattr(message, field, value)


@pytest.mark.parametrize(
    ("codec", "value", "harm", "reason"),
    [
        (*SIGNALS[0], change("p_WB", [0.0, np.nan, 0.0]), "must be finite"),
        (*SIGNALS[0], change("q_WB", [0.0, 0.0, 0.0, 0.0]), "length 0.0; it must be 1"),
        (*SIGNALS[0], change("q_WB", [np.nan, 0.0, 0.0, 0.0]), "it must be 1"),
        (*SIGNALS[1], change("thrust", np.inf), "must be finite"),
        (*SIGNALS[2], change("heading", np.inf), "heading is inf"),
        (*SIGNALS[2], change("v_WB", [np.nan, 0.0, 0.0]), "must be finite"),
        (*SIGNALS[4], change("waypoint_period", 0.2), "0.2 s apart"),
        (*SIGNALS[4], change("costs", [0.0, np.nan]), "must be finite"),
        (*SIGNALS[5], change("body", "chair"), "the body is 'chair'; it must be 'drone'"),
        (*SIGNALS[5], change("tracked", False), "does not see 'drone'"),
        (*SIGNALS[6], change("width", 3), "they must be"),
        (*SIGNALS[6], change("max_range", 4.0), "range of 4.0 m; .* with 5.0 m"),
        (*SIGNALS[6], change("values", [0.0, 0.0, 0.0, 0.0, 0.0, 1.5]), "must be 0 to 1"),
    ],
)
def test_content_of_no_use_is_refused(codec, value, harm, reason):
    """A message of the right type whose content cannot be flown by says what is wrong."""
    message = sent(codec, value)
    harm(message)
    with pytest.raises(ValueError, match=reason):
        codec.unpack(message, EPOCH)


def test_another_number_of_hypotheses_is_refused():
    """Both ends have the same number of hypotheses."""
    with pytest.raises(ValueError, match="there are 2 hypotheses; there must be 3"):
        HypothesesCodec(3).unpack(sent(HypothesesCodec(2), PLAN), EPOCH)
