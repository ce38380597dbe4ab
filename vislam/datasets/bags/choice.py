"""Which topic of a bag is which sensor: as given, or guessed from types, names, sizes and rates."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, Literal

from vislam.core.camera import MOST_CAMERAS
from vislam.core.errors import DataError
from vislam.datasets.bags.decoding import (
    CAMERA_INFO,
    IMAGE,
    IMAGES,
    IMU,
    MAGNETIC,
    POSES,
    why_unreadable,
)
from vislam.datasets.bags.films import codec_of, film_size, why_no_video
from vislam.datasets.bags.listing import Entry, Listing
from vislam.datasets.bags.pictures import is_depth, size_px
from vislam.datasets.bags.transforms import Frames

NONE = "none"
_PAIRS = (
    ("left", "right"), ("cam0", "cam1"), ("cam_0", "cam_1"), ("camera0", "camera1"), ("camera_0", "camera_1"),
    ("infra1", "infra2"), ("fisheye1", "fisheye2"), ("image_0", "image_1"), ("image0", "image1"),
)  # fmt: skip
_REGISTERED = ("aligned", "registered", "to_color", "to_rgb")
_SAME_COUNT = 0.1  # two cameras of a pair differ by less in how many images they gave
_NAMED = 30  # topics that an error names


@dataclass(frozen=True, slots=True)
class BagOptions:
    """Options of a bag behind its path, as `bag:drive.mcap,cam0=/left/image_raw,imu=none`."""

    cam0: str | None = None  # topics; none: leave it out
    cam1: str | None = None
    further: str | None = None  # topics of more cameras, with + between them: followed each by itself
    depth: str | None = None
    imu: str | None = None
    mag: str | None = None
    truth: str | None = None
    info0: str | None = None  # of the camera's calibration
    info1: str | None = None
    stamps: Literal["header", "log"] = "header"  # log: when the recorder got a message, not when it was measured


@dataclass(frozen=True, slots=True)
class ImageFacts:
    """What the first image of a topic shows."""

    entry: Entry
    compressed: bool
    size_px: tuple[int, int] | None
    encoding: str
    frame: str
    is_video: bool = False

    @property
    def name(self) -> str:
        """The topic's name."""
        return self.entry.topic.name


@dataclass(frozen=True, slots=True)
class Choice:
    """The topics that are taken, None where there is none."""

    cameras: tuple[ImageFacts, ...]
    infos: tuple[Entry | None, ...]  # of each camera
    depth: ImageFacts | None
    depth_info: Entry | None  # of its calibration, where it is not registered
    imu: Entry | None
    forces: Entry | None  # of the IMU, where its own topic has rates alone
    mag: Entry | None
    truth: Entry | None

    def roles(self) -> dict[str, str]:
        """Return what each topic was taken for."""
        taken = {camera.name: f"cam{k}" for k, camera in enumerate(self.cameras)}
        taken |= {info.topic.name: f"calibration of cam{k}" for k, info in enumerate(self.infos) if info is not None}
        if self.depth is not None:
            taken[self.depth.name] = "depth0"
        if self.depth_info is not None:
            taken[self.depth_info.topic.name] = "calibration of depth0"
        rates = "imu0" if self.forces is None else "rates of imu0"
        samples = ((rates, self.imu), ("forces of imu0", self.forces), ("mag0", self.mag), ("truth", self.truth))
        for role, entry in samples:
            if entry is not None:
                taken[entry.topic.name] = role
        return taken


def chosen(listing: Listing, options: BagOptions, frames: Frames) -> Choice:
    """Return which topic is which sensor; raises DataError for one that was given and is not there or of no use."""
    images = [_facts(listing, entry) for entry in listing.of_type(*IMAGES)]
    usual = [facts for facts in images if facts.size_px is not None]
    colors = [facts for facts in usual if not _looks_like_depth(facts)]
    depths = [facts for facts in usual if _looks_like_depth(facts)]
    guessed = _guessed_cameras(colors, depths, listing)
    cam0 = _image(listing, images, "cam0", options.cam0, guessed[0] if guessed else None)
    of_guess = guessed[1] if len(guessed) > 1 and cam0 is guessed[0] else _other_of(cam0, colors)
    chosen_depth = _image(listing, images, "depth", options.depth, None)
    cam1 = _image(listing, images, "cam1", options.cam1, None if chosen_depth else of_guess)
    cameras = tuple(camera for camera in (cam0, cam1) if camera is not None and cam0 is not None)
    if options.further:
        more = (_image(listing, images, "further", topic, None) for topic in options.further.split("+"))
        cameras = _one_each((*cameras, *(camera for camera in more if camera is not None)))
    depth = chosen_depth
    if depth is None and options.depth is None and cam0 is not None and len(cameras) == 1:
        fitting = [facts for facts in depths if _registered(facts, cam0)]
        fitting += [facts for facts in depths if _info_of_depth(listing, facts, cam0, frames) is not None]
        depth = next(iter(fitting), None)
    depth_info = None if depth is None or cam0 is None else _info_of_depth(listing, depth, cam0, frames)
    if depth is not None and cam0 is not None and depth_info is None and depth.size_px != cam0.size_px:
        raise DataError(
            f"depth={depth.name}: its images are not of the size of {cam0.name}, so they need a CameraInfo beside them "
            f"and transforms from {cam0.frame or 'an unnamed frame'} to {depth.frame or 'an unnamed frame'}; or "
            "register depth, or leave it out: depth=none"
        )
    infos = tuple(
        _entry(listing, f"info{k}", given, (CAMERA_INFO,), _info(listing, camera, len(cameras)))
        for k, (camera, given) in enumerate(zip_longest(cameras, (options.info0, options.info1)[: len(cameras)]))
    )
    mags = listing.of_type(MAGNETIC)
    return Choice(
        cameras,
        infos,
        depth if cam0 is not None else None,
        depth_info,
        *_imu(listing, options.imu),
        _entry(listing, "mag", options.mag, (MAGNETIC,), max(mags, key=lambda entry: entry.count, default=None)),
        _entry(listing, "truth", options.truth, POSES, None),
    )


def _one_each(cameras: tuple[ImageFacts, ...]) -> tuple[ImageFacts, ...]:
    """Return cameras; raises DataError for one that comes twice, for more than a rig has, or without a first one."""
    names = [camera.name for camera in cameras]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise DataError(f"{twice} is named as two cameras; name each once: cam0, cam1, further")
    if len(cameras) > MOST_CAMERAS:
        raise DataError(
            f"a rig has {MOST_CAMERAS} cameras at most, {len(cameras)} are named; leave some out of further"
        )
    return cameras


def topics_there(listing: Listing, types: Iterable[str] = ()) -> str:
    """Return the names of the topics of some types, or of all, for errors."""
    wanted = set(types)
    names = sorted(name for name, entry in listing.entries.items() if not wanted or entry.topic.type in wanted)
    listed = ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
    return f"there are {listed}" if names else "there is none"


def wanted_topic(listing: Listing, role: str, name: str, types: tuple[str, ...]) -> Entry:
    """Return a topic that was given; raises DataError naming those that would fit."""
    entry = listing.entries.get(name) or listing.entries.get(f"/{name}")
    kinds = " or ".join(type_.rsplit("/", 1)[-1] for type_ in types)
    if entry is None:
        raise DataError(f"{role}={name}: no such topic; of {kinds} {topics_there(listing, types)}")
    if entry.topic.type not in types:
        raise DataError(f"{role}={name}: {kinds} is asked, it is {entry.topic.type}; {topics_there(listing, types)}")
    if why := why_unreadable(entry.topic):
        raise DataError(f"{role}={name}: {why}")
    return entry


def _entry(
    listing: Listing, role: str, given: str | None, types: tuple[str, ...], guessed: Entry | None
) -> Entry | None:
    if given is None or given == NONE:
        return None if given == NONE else guessed
    return wanted_topic(listing, role, given, types)


def _image(
    listing: Listing, images: list[ImageFacts], role: str, given: str | None, guessed: ImageFacts | None
) -> ImageFacts | None:
    entry = _entry(listing, role, given, IMAGES, None if guessed is None else guessed.entry)
    if entry is None:
        return None
    facts = next(facts for facts in images if facts.entry is entry)
    if facts.size_px is None:
        raise DataError(f"{role}={facts.name}: none of its first images can be read")
    return facts


def _facts(listing: Listing, entry: Entry) -> ImageFacts:
    compressed = entry.topic.type != IMAGE
    first = next(listing.first_messages(entry), None)
    if compressed and first is not None and codec_of(str(first.format)):  # also as a CompressedImage
        size = None if why_no_video() else film_size(listing.first_messages(entry), len(entry.places))
        return ImageFacts(entry, True, size, str(first.format), str(first.header.frame_id), True)
    for message in listing.first_messages(entry):
        size = size_px(message, compressed)
        if size is not None:
            encoding: Any = message.format if compressed else message.encoding
            return ImageFacts(entry, compressed, size, str(encoding), str(message.header.frame_id))
    return ImageFacts(entry, compressed, None, "", "")


def _looks_like_depth(facts: ImageFacts) -> bool:
    return is_depth(facts.encoding) or ("depth" in facts.name.lower() and facts.encoding in ("mono16", "16UC1; png"))


def _guessed_cameras(colors: list[ImageFacts], depths: list[ImageFacts], listing: Listing) -> tuple[ImageFacts, ...]:
    """Return the camera or the pair that a run most likely wants: with registered depth, else a pair, else the best."""
    ranked = sorted(colors, key=lambda facts: _rank(facts, listing))
    for facts in ranked:
        if any(_registered(depth, facts) and _is_registered(depth) for depth in depths):
            return (facts,)
    for facts in ranked:
        if (other := _other_of(facts, colors)) is not None:
            return facts, other
    return tuple(ranked[:1])


def _rank(facts: ImageFacts, listing: Listing) -> tuple[bool, bool, bool, int, int, str]:
    without_info = _info(listing, facts, 2) is None
    return facts.compressed, without_info, "rect" in facts.name, -facts.entry.count, len(facts.name), facts.name


def _other_of(first: ImageFacts | None, colors: list[ImageFacts]) -> ImageFacts | None:
    """Return the right camera of a left one, by name, size and number of images."""
    if first is None:
        return None
    names = {first.name.replace(a, b) for a, b in _PAIRS if a in first.name}
    for facts in colors:
        same = abs(facts.entry.count - first.entry.count) <= _SAME_COUNT * max(facts.entry.count, first.entry.count)
        if facts.name in names and facts is not first and facts.size_px == first.size_px and same:
            return facts
    return None


def _registered(depth: ImageFacts, color: ImageFacts) -> bool:
    return depth.size_px == color.size_px and (depth.frame == color.frame or _is_registered(depth))


def _is_registered(depth: ImageFacts) -> bool:
    return any(word in depth.name for word in _REGISTERED)


def _info_of_depth(listing: Listing, depth: ImageFacts, cam0: ImageFacts, frames: Frames) -> Entry | None:
    """Return the calibration of depth that is not registered; None where it is, or where lens or place are unknown."""
    if _registered(depth, cam0):
        return None
    info = _info(listing, depth, 2)
    is_placed = bool(cam0.frame and depth.frame) and frames.between(cam0.frame, depth.frame) is not None
    return info if info is not _info(listing, cam0, 1) and is_placed else None


def _info(listing: Listing, camera: ImageFacts, cameras: int) -> Entry | None:
    """Return the calibration beside a camera's images, or the only one there is."""
    infos = listing.of_type(CAMERA_INFO)
    parts = camera.name.split("/")
    for depth in range(len(parts) - 1, 0, -1):
        name = "/".join([*parts[:depth], "camera_info"])
        if (found := next((info for info in infos if info.topic.name == name), None)) is not None:
            return found
    return infos[0] if len(infos) == 1 and cameras == 1 else None


def _imu(listing: Listing, given: str | None) -> tuple[Entry | None, Entry | None]:
    """Return the topic of an IMU, and that of its forces where rates and forces are apart, as RealSense has them."""
    imus = sorted(listing.of_type(IMU), key=_imu_rank, reverse=True)
    measured = {entry.topic.name: _measured(listing, entry) for entry in imus}
    best = sorted(imus, key=lambda entry: not all(measured[entry.topic.name]))  # those of one rank keep their order
    taken = _entry(listing, "imu", given, (IMU,), best[0] if best else None)
    if taken is None or all(measured[taken.topic.name]):
        return taken, None
    rates = next((entry for entry in imus if measured[entry.topic.name] == (True, False)), None)
    forces = next((entry for entry in imus if measured[entry.topic.name] == (False, True)), None)
    if rates is None or forces is None:
        return taken, None
    return (taken, forces) if measured[taken.topic.name][0] else (rates, taken)


def _measured(listing: Listing, entry: Entry) -> tuple[bool, bool]:
    """Return whether the first messages of a topic hold rates and forces; what is not measured is zero."""
    first = list(listing.first_messages(entry))
    triples = [[getattr(m, name) for m in first] for name in ("angular_velocity", "linear_acceleration")]
    rates, forces = (any(v.x != 0.0 or v.y != 0.0 or v.z != 0.0 for v in values) for values in triples)
    return rates, forces


def _imu_rank(entry: Entry) -> tuple[bool, float, int]:
    rate_hz = entry.rate_hz
    return "filter" not in entry.topic.name, 0.0 if math.isnan(rate_hz) else rate_hz, -len(entry.topic.name)
