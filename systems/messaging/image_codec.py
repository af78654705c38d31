"""Images in messages: Drake's own `lcmt_image_array`, with one image."""

import zlib

import numpy as np
from drake import lcmt_image, lcmt_image_array
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.messaging.codecs import Codec


class ImageCodec(Codec):
    """An image (height, width, channels), sent with zlib, and understood without it too."""

    message = lcmt_image_array
    _format: int
    _type: int

    def __init__(self, image: ImageDepth32F | ImageRgba8U, frame: str):
        """
        Args:
            image: one of the size of those that travel.
            frame: the name of the camera.
        """
        self.image, self.frame = image, frame

    def pack(self, value, header, epoch):
        image = lcmt_image()
        image.header = header
        image.height, image.width, _ = value.shape
        # Compressed, because Drake reads but a quarter of depth images that are not.
        image.data = zlib.compress(value.astype(value.dtype.newbyteorder("<")).tobytes(), level=1)
        image.size, image.row_stride = len(image.data), value.nbytes // image.height
        image.pixel_format, image.channel_type = self._format, self._type
        image.compression_method = lcmt_image.COMPRESSION_METHOD_ZLIB
        message = self.stamped(header)
        message.num_images, message.images = 1, [image]
        return message

    def unpack(self, message, epoch):
        if message.num_images != 1:
            raise ValueError(f"there are {message.num_images} images; there must be one")
        [image] = message.images
        assert self.image is not None
        pixels = np.asarray(self.image.data)
        is_so = image.width, image.height, image.pixel_format, image.channel_type
        should_be = self.image.width(), self.image.height(), self._format, self._type
        if is_so != should_be:
            raise ValueError(
                f"width, height, pixel format and channel type are {is_so}; they must be "
                f"{should_be}"
            )
        data = bytes(image.data)
        if image.compression_method == lcmt_image.COMPRESSION_METHOD_ZLIB:
            try:
                data = zlib.decompressobj().decompress(data, pixels.nbytes)
            except zlib.error as error:
                raise ValueError(f"the image is compressed, and damaged: {error}") from None
        elif image.compression_method != lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED:
            raise ValueError(
                f"the compression method is {image.compression_method}; send images as they are, "
                "or with zlib"
            )
        if len(data) != pixels.nbytes:
            raise ValueError(f"the image has {len(data)} bytes; it must have {pixels.nbytes}")
        order = ">" if image.bigendian else "<"
        return np.frombuffer(data, pixels.dtype.newbyteorder(order)).reshape(pixels.shape)


class DepthImageCodec(ImageCodec):
    """Planar depth [m] as float32."""

    channel, port = "DEPTH_IMAGE", "depth_image_32f"
    _format, _type = lcmt_image.PIXEL_FORMAT_DEPTH, lcmt_image.CHANNEL_TYPE_FLOAT32

    def unpack(self, message, epoch):
        depth = super().unpack(message, epoch)
        if not (depth >= 0.0).all():
            raise ValueError("depths are negative or not numbers; they must be at least 0 m")
        return depth


class ColorImageCodec(ImageCodec):
    """Red, green, blue and opacity, 8 bits each."""

    channel, port = "COLOR_IMAGE", "color_image"
    _format, _type = lcmt_image.PIXEL_FORMAT_RGBA, lcmt_image.CHANNEL_TYPE_UINT8
