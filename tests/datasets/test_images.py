"""Images: sizes from headers, damage that decoders hide, matching by time, decoding ahead in order."""

import re
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.datasets.images import (
    DepthFormat,
    ImageList,
    UnreadableImageError,
    bits_of,
    decode_ahead,
    frames_ahead,
    match_by_time,
    probe,
    read_depth,
    read_grey_or_color,
)
from worlds.mini_recording import HEIGHT, WIDTH, picture

CAMERA = Camera(WIDTH, HEIGHT, 50.0, 50.0, 31.5, 23.5)


def read(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    images = ImageList("cam0", path.parent, np.zeros(1, np.int64), (path.name,))
    return read_grey_or_color(images, 0, CAMERA, bits_of(images, CAMERA))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_cut_image_is_unreadable_not_grey(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), picture(1))
    grey, color = read(path)
    assert grey.shape == (HEIGHT, WIDTH) and color is None
    data = path.read_bytes()
    for kept in (0, 1, 30, len(data) // 2, len(data) - 3):
        path.write_bytes(data[:kept])
        with pytest.raises(UnreadableImageError, match="unreadable image"):
            read(path)
        with pytest.raises(UnreadableImageError):
            probe(path)


@pytest.mark.parametrize(
    ("at", "put", "error", "said"),
    [
        (200, bytes(60), UnreadableImageError, "unreadable image"),  # in the middle of what is compressed
        (16, (100_000).to_bytes(4, "big") * 2, DataError, r"a.png is 100000x100000 but its calibration is for 64x48"),
    ],
    ids=["damaged", "forged size"],
)
def test_wrong_bytes_in_a_png_are_refused(tmp_path: Path, at: int, put: bytes, error: type, said: str) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), picture(1))
    data = path.read_bytes()
    path.write_bytes(data[:at] + put + data[at + len(put) :])
    with pytest.raises(error, match=said):
        read(path)


def test_color_is_kept_and_made_grey(tmp_path: Path) -> None:
    image = picture(2, color=True)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    grey, color = read(tmp_path / "a.png")
    assert color is not None and np.array_equal(color, image)
    assert np.array_equal(grey, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def test_sixteen_bit_grey_as_in_tum_vi(tmp_path: Path) -> None:
    image = picture(3).astype(np.uint16) * 256
    cv2.imwrite(str(tmp_path / "a.png"), image)
    grey, color = read(tmp_path / "a.png")
    assert color is None and np.array_equal(grey, picture(3))


def test_the_heat_of_a_scene_fills_the_eight_bits_alike_in_all_images(tmp_path: Path) -> None:
    """One image is black, as while the shutter is closed, and one has the sun in it."""
    scenes = [7000 + 6 * picture(seed).astype(np.uint16) for seed in range(20)]
    scenes[3][:] = 0
    scenes[5][:4, :4] = 65535
    for i, scene in enumerate(scenes):
        cv2.imwrite(str(tmp_path / f"{i}.png"), scene)
    images = ImageList("cam0", tmp_path, np.arange(20), tuple(f"{i}.png" for i in range(20)))
    bits = bits_of(images, CAMERA)
    reduced = np.array([read_grey_or_color(images, i, CAMERA, bits)[0] for i in range(20)])
    low, high = (float(word) for word in re.findall(r"\d+", bits.said)[1:])
    dark, bright = np.percentile(scenes[7], (1.0, 99.0))
    assert dark - (bright - dark) < low < dark and bright < high < bright + (bright - dark)
    expected = np.clip((np.array(scenes) - low) / (high - low) * 255.0, 0.0, 255.0)
    assert np.abs(reduced - expected).max() < 1.0
    (tmp_path / "1.png").unlink()
    again = bits_of(images, CAMERA)
    assert again.reduced(scenes[7]).shape == (HEIGHT, WIDTH) and again.said.startswith("; of 16 bits")


def test_depth_is_metres_and_must_be_sixteen_bit(tmp_path: Path) -> None:
    raw = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH)
    cv2.imwrite(str(tmp_path / "d.png"), raw)
    depth_m = read_depth(tmp_path / "d.png", CAMERA, DepthFormat(5000.0))
    assert depth_m.dtype == np.float32
    np.testing.assert_allclose(depth_m, raw / 5000.0, rtol=1e-6)
    cv2.imwrite(str(tmp_path / "e.png"), picture(1))
    with pytest.raises(UnreadableImageError, match="not 16-bit"):
        read_depth(tmp_path / "e.png", CAMERA, DepthFormat(5000.0))


@pytest.mark.parametrize("size", [(640, 480), (3840, 2160), (8192, 4096)])
@pytest.mark.parametrize("cameras", [1, 2, 8])
def test_frames_that_are_held_at_once_take_128_mib_or_are_two(size: tuple[int, int], cameras: int) -> None:
    camera = Camera(*size, 50.0, 50.0, 31.5, 23.5)
    frame_bytes = (cameras + 3 + 4) * size[0] * size[1]
    ahead = frames_ahead([camera] * cameras, camera)
    assert ahead == 4 if size == (640, 480) else 0 <= ahead < 4
    assert (ahead + 2) * frame_bytes <= 2**27 or ahead == 0


def greedy(a: list[int], b: list[int], tolerance: int) -> dict[int, int]:
    """The benchmark's `associate.py`: all pairs by distance, closest first."""
    pairs = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= tolerance)
    out: dict[int, int] = {}
    for _, i, j in pairs:
        if i not in out and j not in out.values():
            out[i] = j
    return out


@given(st.sets(st.integers(0, 10**6), max_size=12), st.sets(st.integers(0, 10**6), max_size=12))
def test_matching_equals_closest_first(a: set[int], b: set[int]) -> None:
    first, second = sorted(a), sorted(b)
    distances = [abs(x - y) for x in first for y in second]
    if len(set(distances)) != len(distances):
        return  # ties may be broken either way
    partner = match_by_time(np.array(first, np.int64), np.array(second, np.int64), 200_000)
    assert {i: int(j) for i, j in enumerate(partner) if j >= 0} == greedy(first, second, 200_000)


def test_decoding_ahead_keeps_order_bounds_and_ends() -> None:
    asked: list[int] = []
    running = threading.active_count()

    def jobs():
        for i in range(1000):
            asked.append(i)
            yield i

    stream = decode_ahead(jobs(), lambda i: i * i, workers=3, ahead=4)
    assert [next(stream) for _ in range(20)] == [i * i for i in range(20)]
    assert len(asked) <= 20 + 4 + 1
    stream.close()
    assert threading.active_count() == running


def test_decoding_ahead_raises_in_its_place() -> None:
    def load(i: int) -> int:
        if i == 3:
            raise DataError("third")
        return i

    stream = decode_ahead(range(10), load)
    assert [next(stream), next(stream), next(stream)] == [0, 1, 2]
    with pytest.raises(DataError, match="third"):
        next(stream)
