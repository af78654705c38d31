"""Images in Drake's messages; Drake's own systems are the other end."""

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

from splatpilot.systems.messaging.codecs import ColorImageCodec, DepthImageCodec


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
    """Drake's LcmImageArrayToImages gives the image that was sent, infinities included."""
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
    """What Drake's ImageToLcmImageArrayT sends, compressed or not, arrives."""
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
        (raw(bytes(30)), "the image has 30 bytes; it must have 60"),
        (raw(bytes(56) + b"\0\0\xc0\x7f"), "not numbers"),
        (raw(bytes(56) + b"\0\0\x80\xbf"), "negative"),
        (lambda image: setattr(image, "data", image.data[:20]), "it must have 60"),
        (lambda image: setattr(image, "data", b"\0" * 20), "compressed, and damaged"),
        (lambda image: setattr(image, "compression_method", 3), "compression method is 3"),
        (lambda image: setattr(image, "width", 6), r"\(6, 3, 5, 6\); they must be \(5, 3, 5, 6\)"),
        (lambda image: setattr(image, "channel_type", 5), "they must be"),
    ],
)
def test_other_images_are_refused(harm, reason):
    """An image of another size or kind, or damaged, says what is wrong."""
    codec = DepthImageCodec(depth_image(), "camera")
    message = packed(codec, depth_image())
    harm(message.images[0])
    with pytest.raises(ValueError, match=reason):
        codec.unpack(message, 0.0)
