"""Images in files: sizes from their heads, and nothing decoded that states more than a camera has."""

import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.core.camera import Camera
from vislam.core.encoded_image import decoded, image_size
from vislam.core.errors import DataError
from worlds.mini_recording import HEIGHT, WIDTH, picture


@given(st.integers(1, 300), st.integers(1, 300), st.sampled_from([".png", ".jpg"]), st.booleans())
def test_header_size_is_what_opencv_decodes(width: int, height: int, suffix: str, color: bool) -> None:
    _, data = cv2.imencode(suffix, picture(0, (width, height), color))
    assert image_size(data.tobytes()) == (width, height)


@given(st.binary(max_size=64), st.sampled_from([b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n"]))
def test_any_bytes_give_a_size_or_none(data: bytes, magic: bytes) -> None:
    size = image_size(magic + data)
    assert size is None or len(size) == 2


def forged(data: bytes, width: int, height: int) -> bytes:
    """Return a PNG or JPEG whose head states another size."""
    if data.startswith(b"\x89PNG"):
        head = data[12:16] + width.to_bytes(4, "big") + height.to_bytes(4, "big") + data[24:29]
        return data[:12] + head + zlib.crc32(head).to_bytes(4, "big") + data[33:]
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + height.to_bytes(2, "big") + width.to_bytes(2, "big") + data[at + 4 :]


def test_a_png_whose_chunk_is_longer_than_the_file_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    data = cv2.imencode(".png", picture(1))[1].tobytes()
    assert decoded(data + b"rest", cv2.IMREAD_GRAYSCALE) is not None
    monkeypatch.setattr(cv2, "imdecode", None)  # which takes as much memory as a chunk states
    for damaged in (data[:33] + b"@" + data[34:], data[:33] + data[35:], data[:-4], data[:33]):
        assert decoded(damaged, cv2.IMREAD_GRAYSCALE) is None


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_an_image_that_states_more_than_any_camera_is_not_decoded(suffix: str) -> None:
    data = cv2.imencode(suffix, picture(1))[1].tobytes()
    assert decoded(data, cv2.IMREAD_COLOR).shape == (HEIGHT, WIDTH, 3)
    assert decoded(data, cv2.IMREAD_COLOR, (WIDTH, HEIGHT + 1)) is None
    huge = forged(data, 32_000, 32_000)
    assert image_size(huge) == (32_000, 32_000)
    assert decoded(huge, cv2.IMREAD_COLOR) is None
    assert decoded(data[:100], cv2.IMREAD_COLOR) is None


def test_pixels_beyond_4k_need_bytes() -> None:
    empty = cv2.imencode(".png", np.zeros((4096, 8192), np.uint8))[1].tobytes()
    assert decoded(empty, cv2.IMREAD_GRAYSCALE) is None
    assert decoded(empty + bytes(8192 * 4096 // 8), cv2.IMREAD_GRAYSCALE).shape == (4096, 8192)
    dark = cv2.imencode(".jpg", np.zeros((2160, 3840), np.uint8))[1].tobytes()
    assert decoded(dark, cv2.IMREAD_GRAYSCALE).shape == (2160, 3840)


@pytest.mark.parametrize("suffix", [".bmp", ".webp", ".tiff", ".pgm"])
def test_other_formats_are_not_decoded(suffix: str) -> None:
    assert decoded(cv2.imencode(suffix, picture(1))[1].tobytes(), cv2.IMREAD_COLOR) is None


def test_a_jpeg_whose_size_a_marker_without_length_hides_is_none() -> None:
    data = cv2.imencode(".jpg", picture(1))[1].tobytes()
    fake = b"\xff\xd0\x00\x02" + b"\xff\xc0\x00\x0b\x08\x00\x08\x00\x08\x01"
    assert image_size(data[:2] + fake + data[2:]) is None


def test_a_camera_has_at_most_8k_images() -> None:
    assert Camera(7680, 4320, 50.0, 50.0, 31.5, 23.5).width == 7680
    with pytest.raises(DataError, match="at most 33554432 pixels, got 32000x32000"):
        Camera(32_000, 32_000, 50.0, 50.0, 31.5, 23.5)
