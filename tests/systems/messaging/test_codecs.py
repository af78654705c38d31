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
STATE, COMMAND, SETPOINT = (StateCodec(), CommandCodec(), VelocitySetpointCodec())
PLAN, POSE = HypothesesCodec(2), MotionCaptureCodec("drone")
GRID, STATUS, VEHICLE = (DepthGridCodec(2, 3, 5.0, "tof"), StatusCodec(), VehicleStatusCodec())

SIGNALS = {
    STATE: [1.0, 2, 3, 4, 5, 6, *UNIT, 7, 8, 9],
    COMMAND: [9.81, 0.1, -0.2, 0.3],
    SETPOINT: [1.0, -2, 0.5, 1.5],
    VelocitySetpointCodec(): [1.0, -2, 0.5, np.nan],
    PLAN: [2.5, 1, 2, 3, *UNIT, *np.linspace(-3, 3, 60), 0.3, 0.1],
    POSE: [1.0, 2, 3, *UNIT],
    GRID: [0.0, 0.25, 0.5, 0.75, 1.0, 0.125],
    STATUS: [1.0, 0.0, 0.01, np.inf, 2, 3, 4],
    VEHICLE: [1.0, 0.0],
}
FIELDS = {
    STATE: {"p_WB": (1, 2, 3), "v_WB": (4, 5, 6), "q_WB": tuple(UNIT), "w_WB_B": (7, 8, 9)},
    COMMAND: {"thrust": 9.81, "w_cmd_B": (0.1, -0.2, 0.3)},
    SETPOINT: {"v_WB": (1.0, -2.0, 0.5), "heading": 1.5},
    PLAN: {"plan_utime": 1_800_000_002_500_000, "costs": (0.3, 0.1)},
    POSE: {"body": "drone", "tracked": True, "p_WB": (1, 2, 3), "q_WB": tuple(UNIT)},
    STATUS: {"mode": 1, "state_age": 0.01, "num_gaps": 2, "num_overruns": 4},
    VEHICLE: {"armed": True, "offboard": False},
}


def sent(codec):
    """The message of the codec's value as it arrives."""
    header = lcmt_header()
    header.seq, header.utime, header.frame_name = 3, 1_800_000_002_000_000, codec.frame
    value = np.asarray(SIGNALS[codec], dtype=float)
    return codec.message.decode(codec.pack(value, header, EPOCH).encode())


@pytest.mark.parametrize("codec", SIGNALS, ids=lambda codec: type(codec).__name__)
def test_a_signal_arrives_as_it_was_sent(codec):
    message, value = sent(codec), SIGNALS[codec]
    assert codec.size == len(value)
    np.testing.assert_allclose(codec.unpack(message, EPOCH), value, rtol=0, atol=3e-7)
    assert (message.header.seq, message.header.utime) == (3, 1_800_000_002_000_000)
    assert message.header.frame_name == codec.frame
    fields = FIELDS.get(codec, {})
    assert {name: getattr(message, name) for name in fields} == fields


def test_plans_keep_their_time_between_clocks():
    message = sent(PLAN)
    assert message.waypoints_P[1][0] == tuple(SIGNALS[PLAN][8 + 30 : 8 + 33])
    assert PLAN.unpack(message, epoch=EPOCH - 100.0)[0] == pytest.approx(102.5, abs=1e-6)


@pytest.mark.parametrize(
    ("codec", "unknown"), [(HypothesesCodec(3), no_plan(3)), (VEHICLE, [np.nan] * 2)]
)
def test_an_unknown_value_is_not_sent(codec, unknown):
    assert codec.pack(np.array(unknown), lcmt_header(), EPOCH) is None


def test_each_sender_has_a_session_of_its_own():
    assert sent(STATE).session == sent(STATE).session != sent(COMMAND).session


@pytest.mark.parametrize(
    ("codec", "field", "value", "reason"),
    [
        (STATE, "p_WB", [0.0, np.nan, 0.0], "must be finite"),
        (STATE, "w_WB_B", [0.0, np.inf, 0.0], "must be finite"),
        (STATE, "q_WB", [0.0, 0.0, 0.0, 0.0], "must be a unit quaternion"),
        (STATE, "q_WB", [np.nan, 0.0, 0.0, 0.0], "must be a unit quaternion"),
        (COMMAND, "thrust", np.inf, "must be finite"),
        (SETPOINT, "heading", np.inf, "heading must be finite or NaN, got inf"),
        (SETPOINT, "v_WB", [np.nan, 0.0, 0.0], "must be finite"),
        (PLAN, "waypoint_period", 0.2, "waypoint_period must be 0.1, got 0.2"),
        (PLAN, "costs", [0.0, np.nan], "must be finite"),
        (PLAN, "num_hypotheses", 3, "num_hypotheses must be 2, got 3"),
        (POSE, "body", "chair", "the body must be 'drone', got 'chair'"),
        (POSE, "tracked", False, "body 'drone' must be tracked"),
        (POSE, "q_WB", [2.0, 0.0, 0.0, 0.0], "must be a unit quaternion"),
        (GRID, "width", 3, "width must be 2"),
        (GRID, "encoding", 0, "encoding must be 2"),
        (GRID, "max_range", 4.0, "max_range must be 5.0, got 4.0"),
        (GRID, "values", [0.0, 0.0, 0.0, 0.0, 0.0, 1.5], "got 0.0 to 1.5"),
    ],
)
def test_invalid_content_is_refused(codec, field, value, reason):
    message = sent(codec)
    setattr(message, field, value)
    with pytest.raises(ValueError, match=reason):
        codec.unpack(message, EPOCH)


DEPTH_IMAGE, COLOR_IMAGE = ImageDepth32F(5, 3), ImageRgba8U(4, 2)
DEPTH_IMAGE.mutable_data.flat = [np.inf, *np.linspace(0.1, 9.0, 14)]
COLOR_IMAGE.mutable_data.flat = np.arange(32)
DEPTH, COLOR = DepthImageCodec(DEPTH_IMAGE, "camera"), ColorImageCodec(COLOR_IMAGE, "camera")
IMAGES = [
    (DEPTH, DEPTH_IMAGE, PixelType.kDepth32F, "depth_image"),
    (COLOR, COLOR_IMAGE, PixelType.kRgba8U, "color_image"),
]


def packed(codec, image) -> lcmt_image_array:
    header = lcmt_header()
    header.frame_name = codec.frame
    return codec.pack(np.asarray(image.data), header, 0.0)


@pytest.mark.parametrize(("codec", "image", "pixel", "port"), IMAGES)
def test_drake_reads_ours(codec, image, pixel, port):
    lcm = DrakeLcm("memq://")
    builder = DiagramBuilder()
    subscriber = builder.AddSystem(
        LcmSubscriberSystem.Make("C", lcmt_image_array, lcm, use_cpp_serializer=True)
    )
    reader = builder.AddSystem(LcmImageArrayToImages())
    builder.Connect(subscriber.get_output_port(), reader.get_input_port())
    simulator = Simulator(builder.Build())
    lcm.Publish("C", packed(codec, image).encode())
    lcm.HandleSubscriptions(0)
    simulator.AdvanceTo(0.01)
    context = reader.GetMyContextFromRoot(simulator.get_context())
    np.testing.assert_array_equal(reader.GetOutputPort(port).Eval(context).data, image.data)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(("codec", "image", "pixel", "port"), IMAGES)
def test_ours_reads_drakes(codec, image, pixel, port, compressed):
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
    np.testing.assert_array_equal(codec.unpack(message, 0.0), image.data)


def raw(data: bytes) -> dict:
    method = lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED
    return {"data": data, "size": len(data), "compression_method": method}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (raw(bytes(30)), "must be 60, got 30"),
        (raw(bytes(56) + b"\0\0\xc0\x7f"), "depths must be at least 0 m"),
        (raw(bytes(56) + b"\0\0\x80\xbf"), "depths must be at least 0 m"),
        ({"data": b"\0" * 20}, "compressed image is invalid"),
        ({"data": packed(DEPTH, DEPTH_IMAGE).images[0].data[:20]}, "bytes of the image must be 60"),
        ({"compression_method": 3}, "must be none or zlib, got 3"),
        ({"width": 6}, r"must be \(5, 3, 5, 6\), got \(6, 3, 5, 6\)"),
        ({"channel_type": 5}, "must be"),
    ],
)
def test_other_images_are_refused(changes, reason):
    message = packed(DEPTH, DEPTH_IMAGE)
    for name, value in changes.items():
        setattr(message.images[0], name, value)
    with pytest.raises(ValueError, match=reason):
        DEPTH.unpack(message, 0.0)
