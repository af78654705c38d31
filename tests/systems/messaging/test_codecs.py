"""Codecs."""

import numpy as np
import pytest
from drake import lcmt_header, lcmt_image, lcmt_image_array
from pydrake.common.value import Value
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import LcmPublisherSystem, LcmSubscriberSystem
from pydrake.systems.primitives import ConstantValueSource
from pydrake.systems.sensors import (
    ImageDepth32F,
    ImageRgba8U,
    ImageToLcmImageArrayT,
    LcmImageArrayToImages,
    PixelType,
)

from splatpilot.systems.messaging.codecs import (
    ColorImageCodec,
    CommandCodec,
    DepthGridCodec,
    DepthImageCodec,
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
    message = sent(codec, value)
    assert codec.size == len(value)
    np.testing.assert_allclose(codec.unpack(message, EPOCH), value, rtol=0, atol=3e-7)
    assert (message.header.seq, message.header.utime) == (3, 1_800_000_002_000_000)
    assert message.header.frame_name == codec.frame


def test_fields_have_their_names():
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
        (*SIGNALS[0], change("q_WB", [0.0, 0.0, 0.0, 0.0]), "must be a unit quaternion, got"),
        (*SIGNALS[0], change("q_WB", [np.nan, 0.0, 0.0, 0.0]), "must be a unit quaternion"),
        (*SIGNALS[1], change("thrust", np.inf), "must be finite"),
        (*SIGNALS[2], change("heading", np.inf), "heading must be finite or NaN, got inf"),
        (*SIGNALS[2], change("v_WB", [np.nan, 0.0, 0.0]), "must be finite"),
        (*SIGNALS[4], change("waypoint_period", 0.2), "waypoint_period must be 0.1, got 0.2"),
        (*SIGNALS[4], change("costs", [0.0, np.nan]), "must be finite"),
        (*SIGNALS[5], change("body", "chair"), "the body must be 'drone', got 'chair'"),
        (*SIGNALS[5], change("tracked", False), "body 'drone' must be tracked"),
        (*SIGNALS[6], change("width", 3), "must be"),
        (*SIGNALS[6], change("max_range", 4.0), "5.0\\), got .* 4.0"),
        (
            *SIGNALS[6],
            change("values", [0.0, 0.0, 0.0, 0.0, 0.0, 1.5]),
            "got 0.0 to 1.5",
        ),
    ],
)
def test_content_of_no_use_is_refused(codec, value, harm, reason):
    message = sent(codec, value)
    harm(message)
    with pytest.raises(ValueError, match=reason):
        codec.unpack(message, EPOCH)


def test_another_number_of_hypotheses_is_refused():
    with pytest.raises(ValueError, match="num_hypotheses must be 3, got 2"):
        HypothesesCodec(3).unpack(sent(HypothesesCodec(2), PLAN), EPOCH)


def depth_image() -> ImageDepth32F:
    image = ImageDepth32F(5, 3)
    image.mutable_data[..., 0] = np.linspace(0.0, 9.0, 15).reshape(3, 5)
    image.mutable_data[0, 0, 0] = np.inf
    return image


def color_image() -> ImageRgba8U:
    image = ImageRgba8U(4, 2)
    image.mutable_data[:] = np.arange(32, dtype=np.uint8).reshape(2, 4, 4)
    return image


CASES = [
    (DepthImageCodec, depth_image(), PixelType.kDepth32F, "depth_image"),
    (ColorImageCodec, color_image(), PixelType.kRgba8U, "color_image"),
]


def packed(codec, image) -> lcmt_image_array:
    header = lcmt_header()
    header.frame_name = codec.frame
    return codec.pack(np.asarray(image.data), header, 0.0)


@pytest.mark.parametrize(("make", "image", "pixel", "port"), CASES)
def test_drake_reads_ours(make, image, pixel, port):
    lcm = DrakeLcm("memq://")
    builder = DiagramBuilder()
    subscriber = builder.AddSystem(
        LcmSubscriberSystem.Make("C", lcmt_image_array, lcm, use_cpp_serializer=True)
    )
    reader = builder.AddSystem(LcmImageArrayToImages())
    builder.Connect(subscriber.get_output_port(), reader.get_input_port())
    simulator = Simulator(builder.Build())
    lcm.Publish("C", packed(make(image, "camera"), image).encode())
    lcm.HandleSubscriptions(0)
    simulator.AdvanceTo(0.01)
    context = reader.GetMyContextFromRoot(simulator.get_context())
    np.testing.assert_array_equal(reader.GetOutputPort(port).Eval(context).data, image.data)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(("make", "image", "pixel", "port"), CASES)
def test_ours_reads_drakes(make, image, pixel, port, compressed):
    lcm, heard = DrakeLcm("memq://"), []
    lcm.Subscribe("C", heard.append)
    builder = DiagramBuilder()
    writer = builder.AddSystem(ImageToLcmImageArrayT(do_compress=compressed))
    source = builder.AddSystem(ConstantValueSource(Value(image)))
    builder.Connect(source.get_output_port(), writer.DeclareImageInputPort[pixel]("camera"))
    publisher = builder.AddSystem(
        LcmPublisherSystem.Make("C", lcmt_image_array, lcm, 0.1, use_cpp_serializer=True)
    )
    builder.Connect(writer.image_array_t_msg_output_port(), publisher.get_input_port())
    Simulator(builder.Build()).Initialize()
    lcm.HandleSubscriptions(0)
    message = lcmt_image_array.decode(heard[0])
    np.testing.assert_array_equal(make(image, "camera").unpack(message, 0.0), image.data)


def raw(data):
    """Changes an image to one that is not compressed."""

    def harm(image):
        image.data, image.size = data, len(data)
        image.compression_method = lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED

    return harm


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (raw(bytes(30)), "must be 60, got 30"),
        (raw(bytes(56) + b"\0\0\xc0\x7f"), "depths must be at least 0 m"),
        (raw(bytes(56) + b"\0\0\x80\xbf"), "depths must be at least 0 m"),
        (lambda image: setattr(image, "data", image.data[:20]), "must be 60"),
        (lambda image: setattr(image, "data", b"\0" * 20), "compressed image is invalid"),
        (
            lambda image: setattr(image, "compression_method", 3),
            "must be none or zlib, got 3",
        ),
        (lambda image: setattr(image, "width", 6), r"must be \(5, 3, 5, 6\), got \(6, 3, 5, 6\)"),
        (lambda image: setattr(image, "channel_type", 5), "must be"),
    ],
)
def test_other_images_are_refused(harm, reason):
    codec = DepthImageCodec(depth_image(), "camera")
    message = packed(codec, depth_image())
    harm(message.images[0])
    with pytest.raises(ValueError, match=reason):
        codec.unpack(message, 0.0)
