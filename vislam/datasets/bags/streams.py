"""The streams of a bag while it is run: inertial rows, the field, and the images of each frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.messages import Array, ImageF32, ImageU8
from vislam.core.recording import Problems
from vislam.datasets.bags import pictures
from vislam.datasets.bags.bag import Bag
from vislam.datasets.bags.decoding import decoded, field_ut
from vislam.datasets.bags.films import Film
from vislam.datasets.bags.listing import fitting, stamp
from vislam.datasets.bags.stored import HEAD_BYTES, DamagedError, Found, Place, Topic
from vislam.datasets.images import SixteenBits, UnreadableImageError, grey_and_color
from vislam.datasets.imu_pairs import paired
from vislam.datasets.loaders import FrameTable, LoadedImages, load_cameras
from vislam.datasets.tables import Row, in_time_order
from vislam.vision.depth_registration import DepthCamera

_ENOUGH = 20  # messages, and most of them unusable, settle it
Values = Callable[[Any], list[float]]


@dataclass(frozen=True, slots=True, eq=False)
class ImageTopic:
    """The images of one topic, as its camera's list has them."""

    topic: Topic
    compressed: bool
    t_ns: NDArray[np.int64]  # [N]
    places: NDArray[np.int64]  # [N, 4]
    size_px: tuple[int, int] | None  # of the first
    is_video: bool


class BagStreams:
    """What a run reads of a bag: the values of a recording that are messages of one file, not files of their own."""

    def __init__(
        self,
        bag: Bag,
        cameras: Sequence[ImageTopic],
        depth: ImageTopic | None,
        samples: tuple[Topic | None, Topic | None],
        by_log_time: bool,
        forces: tuple[Topic, Array] | None = None,
        own: DepthCamera | None = None,
    ) -> None:
        """Take the topics of images, of inertial samples and of the field.

        `forces` is the topic of an accelerometer that is apart, and its rotation [3, 3] in the body; then those of the
        inertial samples are rates alone. `own` is the lens of depth that is not registered.
        """
        self._bag = bag
        self._cameras, self._depth = tuple(cameras), depth
        self._imu, self._mag = samples
        self._forces = forces
        self._by_log_time, self._own = by_log_time, own

    @property
    def size_bytes(self) -> int:
        """How large the bag is."""
        return self._bag.size_bytes

    @property
    def has_imu(self) -> bool:
        """Whether there are inertial samples."""
        return self._imu is not None

    def imu_rows(self, problems: Problems) -> Iterator[Row[list[float]]]:
        """Yield stamp, rates and forces as they were stored; raises DataError when most cannot be used."""
        if self._imu is None:
            return iter(())
        if self._forces is None:
            return topic_rows(self._bag, self._imu, _inertial, self._by_log_time, problems)
        topic, R_body_forces = self._forces

        def turned(message: Any) -> list[float]:
            return (R_body_forces @ _inertial(message)[3:]).tolist()

        rates = topic_rows(self._bag, self._imu, lambda message: _inertial(message)[:3], self._by_log_time, problems)
        forces = topic_rows(self._bag, topic, turned, self._by_log_time, problems)
        ordered = (in_time_order(rows, problems, of) for rows, of in ((rates, self._imu.name), (forces, topic.name)))
        return paired(next(ordered), next(ordered), problems, self._bag.path.name)

    def mag_rows(self, problems: Problems) -> Iterator[Row[list[float]]]:
        """Yield stamp and field in µT; as `imu_rows`."""
        return (
            iter(()) if self._mag is None else topic_rows(self._bag, self._mag, field_ut, self._by_log_time, problems)
        )

    def open_loader(self, rig: Rig, frames: FrameTable, cameras: int | None) -> BagLoader:
        """Return what loads the images of frames, of the first `cameras` only if given."""
        return BagLoader(self._bag, frames, self._cameras[:cameras], self._depth, rig, self._own)

    def repeats(self, camera: int) -> Iterator[bool]:
        """Yield for each image of a camera but the first whether it equals the one before to the byte."""
        topic, before = self._cameras[camera], b""
        for row in range(len(topic.t_ns)):
            data = b""
            with suppress(UnreadableImageError):  # which is reported elsewhere
                data = _message(self._bag, topic, row)[0].data.tobytes()
            if row:
                yield data == before != b""
            before = data


class BagLoader:
    """Loads frames from the messages of a bag, those of video in rising order."""

    def __init__(
        self, bag: Bag, frames: FrameTable, cameras: tuple[ImageTopic, ...], depth: ImageTopic | None,
        rig: Rig, own: DepthCamera | None = None,
    ) -> None:  # fmt: skip
        self._bag, self._frames, self._cameras, self._depth, self._rig = bag, frames, cameras, depth, rig
        self._depth_camera = rig.cameras[0] if own is None else own.camera
        self.bits: Sequence[SixteenBits] = [
            SixteenBits(len(topic.t_ns), partial(self._stored, k)) for k, topic in enumerate(cameras)
        ]
        videos = [topic for topic in cameras if topic.is_video]
        self._films = {topic.topic.name: Film(_reader(bag, topic), len(topic.t_ns)) for topic in videos}
        self.workers = 1 if videos else 2

    def load(self, i: int) -> LoadedImages:
        """Return the images of frame `i`; raises DataError when an image is not of the calibrated size."""
        rows = self._frames.camera_rows[i].tolist()[: len(self._cameras)]
        loaded = load_cameras(self._rig, rows, self._grey_or_color)
        depth_row = int(self._frames.depth_rows[i])
        if not loaded.images or self._depth is None or depth_row < 0:
            return loaded
        try:
            return replace(loaded, depth_m=self._depth_m(self._depth, depth_row))
        except UnreadableImageError as error:
            return replace(loaded, trouble=error)

    def close(self) -> None:
        """Nothing is held that the recording does not hold."""

    def _stored(self, camera: int, row: int) -> NDArray[Any]:
        topic = self._cameras[camera]
        message, path = _message(self._bag, topic, row)
        pixels = pictures.unpacked_pixels if topic.compressed else pictures.stored_pixels
        return pixels(message, self._rig.cameras[camera], path)

    def _grey_or_color(self, camera: int, row: int) -> tuple[ImageU8, ImageU8 | None]:
        topic, bits = self._cameras[camera], self.bits[camera]
        if (film := self._films.get(topic.topic.name)) is not None:
            return film.grey_or_color(row, self._rig.cameras[camera], _path(self._bag, topic, row))
        if topic.compressed:
            return grey_and_color(bits.reduced(self._stored(camera, row)))
        message, path = _message(self._bag, topic, row)
        return pictures.grey_or_color(message, self._rig.cameras[camera], path, bits)

    def _depth_m(self, topic: ImageTopic, row: int) -> ImageF32:
        message, path = _message(self._bag, topic, row)
        camera = self._depth_camera
        return (pictures.unpacked_depth_m if topic.compressed else pictures.depth_m)(message, camera, path)


def _path(bag: Bag, topic: ImageTopic, row: int) -> Path:
    return bag.path / topic.topic.name.strip("/") / str(int(topic.t_ns[row]))


def _reader(bag: Bag, topic: ImageTopic) -> Callable[[int], Any]:
    return lambda row: decoded(topic.topic, bag.read(Place(*topic.places[row].tolist()), topic.size_px))


def _message(bag: Bag, topic: ImageTopic, row: int) -> tuple[Any, Path]:
    path = _path(bag, topic, row)
    try:
        return _reader(bag, topic)(row), path
    except (DamagedError, OSError) as error:
        raise UnreadableImageError("image message that cannot be read", path) from error


def messages_of(bag: Bag, topic: Topic, problems: Problems) -> Iterator[tuple[Found, Any]]:
    """Yield the messages of one topic, decoded; those that cannot be are counted.

    Raises DataError when most cannot be used.
    """
    good = bad = 0
    for found in bag.scan(Problems()):  # damage of the file was counted when it was listed
        if found.topic.name != topic.name or found.topic.type != topic.type:
            continue
        try:
            whole = found.place.length == len(found.head) < HEAD_BYTES  # else it may be packed, or go on
            data = found.head if whole else bag.read(found.place)
            message = decoded(topic, data)
            yield found._replace(head=data) if topic.schema else found, message  # whose stamp may lie anywhere
            good += 1
        except (DamagedError, OSError) as error:
            bad += 1
            problems.count(f"{topic.name}: {error}", f"logged at {found.log_ns} ns")
    if bad > good and good + bad >= _ENOUGH:
        raise DataError(f"{bag.path}: {bad} of {good + bad} messages on {topic.name} cannot be read as {topic.type}")


def topic_rows(
    bag: Bag, topic: Topic, values: Values, by_log_time: bool, problems: Problems
) -> Iterator[Row[list[float]]]:
    """Yield stamp and numbers of each message of a topic; what is not finite is left out and counted.

    Raises DataError when most cannot be used.
    """
    good = bad = 0
    for found, message in messages_of(bag, topic, problems):
        t_ns = stamp(found, by_log_time)
        if t_ns is None:
            problems.count(f"{topic.name}: without a stamp, the recorder's time is taken")
            t_ns = fitting(found.log_ns)
        numbers = values(message)
        if all(map(math.isfinite, numbers)):
            good += 1
            yield t_ns, numbers
        else:
            bad += 1
            problems.count(f"{topic.name}: messages with NaN or infinity", f"{t_ns} ns")
    if bad > good and (good + bad >= _ENOUGH or good == 0):
        raise DataError(f"{bag.path}: {bad} of {good + bad} messages on {topic.name} hold NaN or infinity")


def _inertial(message: Any) -> list[float]:
    w, a = message.angular_velocity, message.linear_acceleration
    return [w.x, w.y, w.z, a.x, a.y, a.z]
