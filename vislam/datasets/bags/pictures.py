"""Images in messages as vislam has them: grey, colour as BGR, depth in metres; sizes are compared first of all."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Camera
from vislam.core.encoded_image import image_size
from vislam.core.messages import ImageF32, ImageU8
from vislam.datasets.images import (
    DepthFormat,
    SixteenBits,
    UnreadableImageError,
    check_size_px,
    decode_raw_depth,
    decode_stored,
    grey_and_color,
)

_DEPTH_UNITS_PER_M = 1000.0  # as ROS defines 16UC1
_DEPTH_HEAD = struct.Struct("<iff")  # of `compressedDepth`: kind, and what turns its numbers into an inverse depth
_UNREADABLE = "image message that cannot be read"


class _Layout(NamedTuple):
    """How the pixels of an encoding lie."""

    channels: int
    dtype: str
    to_bgr: int | None = None  # OpenCV's code; None: grey already, or BGR


_RGB, _RGBA, _BGRA = cv2.COLOR_RGB2BGR, cv2.COLOR_RGBA2BGR, cv2.COLOR_BGRA2BGR
# OpenCV names a pattern by its second row
_BAYER = {
    "rggb": cv2.COLOR_BayerBG2BGR, "bggr": cv2.COLOR_BayerRG2BGR,
    "gbrg": cv2.COLOR_BayerGR2BGR, "grbg": cv2.COLOR_BayerGB2BGR,
}  # fmt: skip
ENCODINGS: dict[str, _Layout] = {
    "mono8": _Layout(1, "u1"), "8UC1": _Layout(1, "u1"), "mono16": _Layout(1, "u2"), "16UC1": _Layout(1, "u2"),
    "bgr8": _Layout(3, "u1"), "8UC3": _Layout(3, "u1"), "rgb8": _Layout(3, "u1", _RGB),
    "bgra8": _Layout(4, "u1", _BGRA), "8UC4": _Layout(4, "u1", _BGRA), "rgba8": _Layout(4, "u1", _RGBA),
    "bgr16": _Layout(3, "u2"), "rgb16": _Layout(3, "u2", _RGB),
    "yuv422": _Layout(2, "u1", cv2.COLOR_YUV2BGR_UYVY), "uyvy": _Layout(2, "u1", cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": _Layout(2, "u1", cv2.COLOR_YUV2BGR_YUY2), "yuyv": _Layout(2, "u1", cv2.COLOR_YUV2BGR_YUY2),
    **{f"bayer_{name}8": _Layout(1, "u1", code) for name, code in _BAYER.items()},
    **{f"bayer_{name}16": _Layout(1, "u2", code) for name, code in _BAYER.items()},
    "32FC1": _Layout(1, "f4"),
}  # fmt: skip
_DEPTHS = ("16UC1", "mono16", "32FC1")


def is_depth(encoding: str) -> bool:
    """Return whether images of an encoding (or a compressed format) hold depth."""
    return encoding in ("16UC1", "32FC1") or "compressedDepth" in encoding


def size_px(message: Any, compressed: bool) -> tuple[int, int] | None:
    """Return width and height of an image message; None where it is damaged."""
    if not compressed:
        return int(message.width), int(message.height)
    data = message.data.tobytes()
    return image_size(data[_DEPTH_HEAD.size :] if "compressedDepth" in message.format else data)


def stored_pixels(message: Any, camera: Camera, path: Path) -> NDArray[Any]:
    """Return the pixels of an Image [H, W, channels] as they are stored; raises as `grey_or_color`."""
    layout = ENCODINGS.get(message.encoding)
    if layout is None or layout.dtype == "f4":
        raise UnreadableImageError(f"image encoded as '{message.encoding[:20]}', which is no camera's here", path)
    return _pixels(message, layout, camera, path)


def grey_or_color(message: Any, camera: Camera, path: Path, bits: SixteenBits) -> tuple[ImageU8, ImageU8 | None]:
    """Return an Image as grey [H, W] and, if it has colour, as BGR [H, W, 3]; `bits` are its topic's.

    Raises UnreadableImageError when it is damaged, DataError when it is not of the camera's size.
    """
    pixels, layout = bits.reduced(stored_pixels(message, camera, path)), ENCODINGS[message.encoding]
    if layout.channels == 1 and layout.to_bgr is None:
        return np.array(pixels[:, :, 0], dtype=np.uint8, order="C"), None
    try:
        bgr = pixels if layout.to_bgr is None else cv2.cvtColor(np.ascontiguousarray(pixels), layout.to_bgr)
        return grey_and_color(np.ascontiguousarray(bgr, dtype=np.uint8))
    except cv2.error as error:  # as of half a pair of pixels
        raise UnreadableImageError(_UNREADABLE, path) from error


def depth_m(message: Any, camera: Camera, path: Path) -> ImageF32:
    """Return an Image as depth in metres [H, W], 0 where there is none; raises as `grey_or_color`."""
    if message.encoding not in _DEPTHS:
        raise UnreadableImageError(f"depth image encoded as '{message.encoding[:20]}'", path)
    layout = ENCODINGS[message.encoding]
    pixels = _pixels(message, layout, camera, path)[:, :, 0]
    if layout.dtype == "u2":
        return DepthFormat(_DEPTH_UNITS_PER_M).in_m(pixels.astype(np.uint16))
    return np.where(np.isfinite(pixels) & (pixels > 0.0), pixels, np.float32(0.0)).astype(np.float32)


def unpacked_pixels(message: Any, camera: Camera, path: Path) -> NDArray[Any]:
    """Return the image of a CompressedImage (JPEG or PNG) as it is stored; raises as `grey_or_color`."""
    return decode_stored(message.data.tobytes(), camera, path)


def unpacked_depth_m(message: Any, camera: Camera, path: Path) -> ImageF32:
    """Return a CompressedImage as depth in metres: a PNG of 16 bits, also as `compressedDepth` makes it."""
    data = message.data.tobytes()
    a = b = 0.0
    if "compressedDepth" in message.format:
        if len(data) < _DEPTH_HEAD.size:
            raise UnreadableImageError(_UNREADABLE, path)
        _, a, b = _DEPTH_HEAD.unpack_from(data)
        data = data[_DEPTH_HEAD.size :]
    raw = decode_raw_depth(data, camera, path)
    if not message.format.startswith("32FC1"):
        return DepthFormat(_DEPTH_UNITS_PER_M).in_m(raw)
    numbers = raw.astype(np.float32)
    with np.errstate(all="ignore"):
        depth = np.float32(a) / (numbers - np.float32(b))
    usable = (numbers > 0.0) & np.isfinite(depth) & (depth > 0.0)
    return np.where(usable, depth, np.float32(0.0)).astype(np.float32)


def _pixels(message: Any, layout: _Layout, camera: Camera, path: Path) -> NDArray[Any]:
    """Return a message's pixels [H, W, channels] as they lie, without the ends of its rows."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    check_size_px((width, height), camera, path)
    dtype = np.dtype(layout.dtype).newbyteorder(">" if message.is_bigendian else "<")
    row_bytes = width * layout.channels * dtype.itemsize
    if step < row_bytes or len(message.data) < step * (height - 1) + row_bytes:
        raise UnreadableImageError(_UNREADABLE, path)
    strides = (step, layout.channels * dtype.itemsize, dtype.itemsize)
    data = message.data if message.data.flags.c_contiguous else np.ascontiguousarray(message.data)
    return np.ndarray((height, width, layout.channels), dtype, data, 0, strides).astype(
        dtype.newbyteorder("="), copy=False
    )
