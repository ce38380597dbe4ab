"""What a bag holds as a recording: its cameras, their calibration and place, inertial data and truth."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.geometry import are_rotations, invert
from vislam.core.messages import Array
from vislam.core.recording import Problems
from vislam.datasets.bags.bag import Bag
from vislam.datasets.bags.choice import NONE, BagOptions, Choice, ImageFacts, chosen, topics_there
from vislam.datasets.bags.decoding import (
    COMPRESSED,
    OLD_TRANSFORMS,
    POSES,
    TRANSFORMS,
    VIDEOS,
    header_ns,
    need_rosbags,
    pose_numbers,
    why_unreadable,
)
from vislam.datasets.bags.films import codec_of, why_no_video
from vislam.datasets.bags.listing import Entry, Listing, fitting
from vislam.datasets.bags.stored import Topic
from vislam.datasets.bags.streams import BagStreams, ImageTopic, messages_of
from vislam.datasets.bags.transforms import Frames, rigid
from vislam.datasets.calibrated import joined_rig
from vislam.datasets.foreign_cameras import ros_camera
from vislam.datasets.formats.truth import Truth, trajectory_of
from vislam.datasets.images import DepthFormat, ImageList
from vislam.datasets.imu_files import read_noise
from vislam.datasets.plausibility import imu_facts, mean_force, unit_doubt
from vislam.datasets.stream import FRAME_HOLE_S, KnownCamera, Survey, TopicSummary
from vislam.datasets.tables import Row, in_time_order
from vislam.imu import ImuNoise
from vislam.trajectory import Trajectory
from vislam.vision.depth_registration import DepthCamera

_LOG = logging.getLogger(__name__)
_LOOKED_AT_NS = 20_000_000_000  # of the inertial samples, to see whether their units can be
_VIDEOS = ("CompressedVideo", "FFMPEGPacket")
_CALIBRATION = "--calibration.camera FILE"
_NOISE = "--calibration.imu-noise FILE"


class _Bag(NamedTuple):
    """A bag, what is in it, where its sensors sit, and the lens of depth that is not registered."""

    bag: Bag
    listing: Listing
    frames: Frames
    own: DepthCamera | None


@dataclass(slots=True)
class _Found:
    """What is put together on the way."""

    problems: Problems = field(default_factory=Problems)
    errors: list[DataError] = field(default_factory=list)
    lacking: dict[str, DataError] = field(default_factory=dict)


def survey_bag(path: Path, options: BagOptions) -> Survey:
    """Return what a bag holds, with the topics that are given or else guessed; what is wrong is in `errors`.

    Raises DataError when `rosbags` is not installed.
    """
    need_rosbags()
    found = _Found()
    try:
        bag = Bag(path)
        listing = Listing(bag, options.stamps == "log", found.problems)
    except DataError as error:
        return Survey("bag", path, errors=(error,))
    try:
        frames = _frames(listing)
        choice, own = _with_lens(chosen(listing, options, frames), listing, frames, options, found.problems)
    except DataError as error:
        return Survey("bag", path, topics=_topics(listing, {}), problems=found.problems, errors=(error,))
    return _survey(path, _Bag(bag, listing, frames, own), choice, options, found)


def _survey(path: Path, whole: _Bag, choice: Choice, options: BagOptions, found: _Found) -> Survey:
    bag, listing, frames, own = whole
    images = [_images(facts, f"cam{k}", found.problems) for k, facts in enumerate(choice.cameras)]
    depth = None if choice.depth is None else _images(choice.depth, "depth0", found.problems)
    by_log_time = options.stamps == "log"
    body = _frame_id(listing, choice.imu) or (choice.cameras[0].frame if choice.cameras else "")
    samples = tuple(None if entry is None else entry.topic for entry in (choice.imu, choice.mag))
    streams = BagStreams(
        bag, [topic for _, topic in images], None if depth is None else depth[1], (samples[0], samples[1]), by_log_time,
        _forces(listing, choice, frames, body), own,
    )  # fmt: skip
    if not images and options.cam0 != NONE and (lacks := _without_images(path, listing, choice)) is not None:
        found.errors.append(lacks)
    noise = None
    if choice.imu is not None:
        noise = _noise(path, choice.imu, found)
        _check_imu(streams, [listed for listed, _ in images], path, found)
    known = _known_cameras(listing, choice, frames, body, found)
    rig = joined_rig(known, has_depth=depth is not None)
    mag_frame = _frame_id(listing, choice.mag)
    T_body_mag = frames.between(body, mag_frame) if mag_frame else None
    if choice.mag is not None and T_body_mag is None:
        found.problems.count(f"{choice.mag.topic.name}: no transform to the body, its axes are taken as the body's")
    return Survey(
        format="bag",
        root=path,
        cameras=tuple(listed for listed, _ in images),
        depth=None if depth is None else depth[0],
        depth_format=DepthFormat(own=own),
        rig=rig,
        streams=streams,
        imu_noise=noise,
        R_body_mag=np.eye(3) if T_body_mag is None else T_body_mag[:3, :3],
        truth=None if choice.truth is None else _truth(bag, choice.truth, frames, body),
        topics=_topics(listing, choice.roles() | _places(listing)),
        known_cameras=known,
        lacking=found.lacking,
        problems=found.problems,
        errors=tuple(found.errors),
    )


def _without_images(path: Path, listing: Listing, choice: Choice) -> DataError | None:
    """Return why a bag without images that can be read is not run, and what it is good for; None if its IMU runs it."""
    kinds = {name: entry.topic.schema or entry.topic.type for name, entry in listing.entries.items()}
    videos = {name: words for name, entry in listing.entries.items() if (words := _video(entry, listing))}
    if choice.imu is not None and not videos and not any("Image" in kind for kind in kinds.values()):
        return None
    poses = [entry.topic.name for entry in listing.of_type(*POSES)]
    steps = [f"{name} is {words}: record CompressedImage (JPEG)" for name, words in list(videos.items())[:1]]
    if choice.imu is not None:
        steps.append("cam0=none runs without them")
    elif poses:
        steps.append(f"its poses can be evaluated: vislam eval {path} --topic {poses[0]} --reference FILE")
    return DataError("; ".join([f"{path} has no camera images that can be read", topics_there(listing), *steps]))


def _video(entry: Entry, listing: Listing) -> str:
    """Return what a topic of video is that cannot be read, and why; empty for others."""
    if entry.topic.type not in (COMPRESSED, *VIDEOS):
        return "video of a kind that is not read" if entry.topic.type.endswith(_VIDEOS) else ""
    codec = next((str(message.format)[:20] for message in listing.first_messages(entry)), "no codec")
    if entry.topic.type == COMPRESSED and not codec_of(codec):
        return ""
    return f"{codec} {why_no_video() or 'video that cannot be decoded'}"


def _forces(listing: Listing, choice: Choice, frames: Frames, body: str) -> tuple[Topic, Array] | None:
    """Return the topic of an accelerometer that is apart from its gyroscope, and its rotation [3, 3] in the body."""
    if choice.forces is None or choice.imu is None:
        return None
    T_body_forces = frames.between(body, _frame_id(listing, choice.forces))
    _LOG.warning(
        "imu0 is the rates of %s with the forces of %s, interpolated at their stamps%s",
        choice.imu.topic.name, choice.forces.topic.name,
        "" if T_body_forces is not None else "; no transform between their frames: taken as of the same axes",
    )  # fmt: skip
    return choice.forces.topic, np.eye(3) if T_body_forces is None else T_body_forces[:3, :3]


def _noise(path: Path, imu: Entry, found: _Found) -> ImuNoise | None:
    """Return the noise model in the file beside a bag; without one it is lacking."""
    beside = path.with_name(f"{path.name if path.is_dir() else path.stem}.imu.yaml")
    if beside.is_file():
        try:
            return read_noise(beside, imu.topic.name)
        except DataError as error:
            found.lacking["imu_noise"] = error
            return None
    found.lacking["imu_noise"] = DataError(
        f"{path}: a bag does not state the noise of its IMU ({imu.topic.name}); give {_NOISE}, or write {beside}; "
        "see docs/formats.md"
    )
    return None


def _topics(listing: Listing, roles: dict[str, str]) -> tuple[TopicSummary, ...]:
    unused = {one.topic.name: f"not used; poses, for truth={one.topic.name}" for one in listing.of_type(*POSES)}
    return tuple(
        TopicSummary(
            name, entry.topic.schema or entry.topic.type, entry.count, entry.rate_hz,
            roles.get(name, why_unreadable(entry.topic) or unused.get(name, "not used")),
        )
        for name, entry in sorted(listing.entries.items())
    )  # fmt: skip


def _places(listing: Listing) -> dict[str, str]:
    return {entry.topic.name: "places of sensors" for entry in listing.of_type(TRANSFORMS, OLD_TRANSFORMS)}


def _images(facts: ImageFacts, name: str, problems: Problems) -> tuple[ImageList, ImageTopic]:
    """Return the list of a camera's images, and where they lie, in time order."""
    t_ns, places = facts.entry.stamps_and_places()
    rows: Iterator[Row[int]] = zip(t_ns.tolist(), range(len(t_ns)), strict=True)
    kept = np.array([row for _, row in in_time_order(rows, problems, name, hole_s=FRAME_HOLE_S)], dtype=np.int64)
    topic = ImageTopic(facts.entry.topic, facts.compressed, t_ns[kept], places[kept], facts.size_px, facts.is_video)
    return ImageList(name, Path(facts.name.strip("/")), topic.t_ns, tuple(map(str, topic.t_ns.tolist()))), topic


def _frames(listing: Listing) -> Frames:
    """Return the frames of the bag: those that are static first, then those that never change."""
    frames = Frames()
    topics = listing.of_type(TRANSFORMS, OLD_TRANSFORMS)
    for entry in sorted(topics, key=lambda entry: "static" not in entry.topic.name):
        for message in listing.first_messages(entry):
            frames.learn(message)
    return frames


def _frame_id(listing: Listing, entry: Entry | None) -> str:
    if entry is None:
        return ""
    return next((str(message.header.frame_id) for message in listing.first_messages(entry)), "")


def _known_cameras(
    listing: Listing, choice: Choice, frames: Frames, body: str, found: _Found
) -> tuple[KnownCamera, ...]:
    """Return what the bag states of each camera: its lens, and where it sits in the body."""
    infos = [None if info is None else next(listing.first_messages(info), None) for info in choice.infos]
    known: list[KnownCamera] = []
    for k, (facts, info) in enumerate(zip(choice.cameras, infos, strict=True)):
        lens = None
        try:
            lens = _lens(facts, info)
        except DataError as error:
            found.lacking.setdefault("camera", error)
        T_body_cam = frames.between(body, facts.frame) if body and facts.frame else None
        if T_body_cam is None and choice.imu is None and k == 0:
            T_body_cam = np.eye(4)
        if k == 1 and (T_body_cam is None or facts.frame == choice.cameras[0].frame):
            T_body_cam = _beside(known[0].T_body_cam, infos, choice)
        if T_body_cam is None:
            how = f"no transform from {facts.frame or 'its unnamed frame'} to {body or 'an unnamed body'} in the bag"
            lacks = DataError(f"cam{k} ({facts.name}): {how}; give {_CALIBRATION} with T_cam_imu")
            found.lacking.setdefault("camera", lacks)
        known.append(KnownCamera(lens, T_body_cam))
    return tuple(known)


def _with_lens(
    choice: Choice, listing: Listing, frames: Frames, options: BagOptions, problems: Problems
) -> tuple[Choice, DepthCamera | None]:
    """Return the choice with lens and place of depth that is not registered; without depth that was not asked for.

    Raises DataError where it was asked for and its calibration is none.
    """
    if choice.depth is None or choice.depth_info is None:
        return choice, None
    T_color_depth = frames.between(choice.cameras[0].frame, choice.depth.frame)
    info = next(listing.first_messages(choice.depth_info), None)
    try:
        lens = _lens(choice.depth, info, "register it, or leave it out: depth=none")
    except DataError as error:
        if options.depth is not None:
            raise
        problems.count(f"depth is left out: {error}")
        return replace(choice, depth=None, depth_info=None), None
    return choice, None if T_color_depth is None else DepthCamera(lens, T_color_depth)


def _lens(facts: ImageFacts, info: Any, next_step: str = f"give {_CALIBRATION}") -> Camera:
    where = facts.name
    if info is None:
        raise DataError(f"{where}: no CameraInfo beside its images; {next_step}")
    K, P = _matrix(info, "k", (3, 3)), _matrix(info, "p", (3, 4))
    name, coefficients = str(info.distortion_model), [float(x) for x in getattr(info, "d", getattr(info, "D", ()))]
    if _is_rectified(facts):
        K, name, coefficients = P[:, :3], "none", []
    if not (np.all(np.isfinite(K)) and K[0, 0] > 0.0 and K[1, 1] > 0.0):
        raise DataError(f"{where}: its CameraInfo is not calibrated (focal lengths of 0); {next_step}")
    assert facts.size_px is not None
    size = (int(info.width), int(info.height))
    if size != facts.size_px:
        sizes = f"CameraInfo is for {size[0]}x{size[1]}, its images are {facts.size_px[0]}x{facts.size_px[1]}"
        raise DataError(f"{where}: its {sizes}; {next_step}")
    try:
        return ros_camera(size, K, name, coefficients, where)
    except DataError as error:
        raise DataError(f"{error}; {next_step}") from error


def _matrix(info: Any, name: str, shape: tuple[int, int]) -> Array:
    """Return a matrix of a CameraInfo, whose fields have small letters since ROS 2."""
    return np.array(getattr(info, name, None) if hasattr(info, name) else getattr(info, name.upper())).reshape(shape)


def _is_rectified(facts: ImageFacts) -> bool:
    return any(part.startswith("image_rect") for part in facts.name.split("/"))


def _beside(T_body_cam0: Array | None, infos: list[Any], choice: Choice) -> Array | None:
    """Return where cam1 sits by the rectification of a calibrated pair; None where there is none."""
    if T_body_cam0 is None or any(info is None for info in infos[:2]):
        return None
    P = _matrix(infos[1], "p", (3, 4))
    rotations = [
        np.eye(3) if _is_rectified(facts) else _matrix(info, "r", (3, 3))
        for facts, info in zip(choice.cameras[:2], infos[:2], strict=True)
    ]
    good = are_rotations(np.array(rotations), 1e-3).all()
    if not good or not np.all(np.isfinite(P)) or P[0, 3] == 0.0 or P[0, 0] <= 0.0:
        return None
    T_cam1_cam0 = np.eye(4)  # p_rect1 = p_rect0 + (P[0, 3] / fx, 0, 0)
    T_cam1_cam0[:3, :3] = rotations[1].T @ rotations[0]
    T_cam1_cam0[:3, 3] = rotations[1].T @ [P[0, 3] / P[0, 0], 0.0, 0.0]
    return T_body_cam0 @ invert(T_cam1_cam0)


def _check_imu(streams: BagStreams, images: list[ImageList], path: Path, found: _Found) -> None:
    """Refuse units that cannot be, and a clock that is not the cameras'."""
    first_ns = last_ns = None

    def some() -> Iterator[Row[list[float]]]:
        nonlocal first_ns, last_ns
        for row in in_time_order(streams.imu_rows(Problems()), Problems(), "imu"):
            first_ns = row[0] if first_ns is None else first_ns
            if row[0] - first_ns > _LOOKED_AT_NS:
                return
            last_ns = row[0]
            yield row

    try:
        facts = imu_facts(some())
        doubt = unit_doubt(facts)
    except DataError as error:
        found.errors.append(error)
        return
    if doubt is None and len(facts.window_t_ns) and mean_force(facts)[0] == 0.0:
        doubt = (
            "its forces are all zero",
            "record the accelerometer in its topic, too (RealSense: unite_imu_method:=2)",
        )
    if doubt is not None:
        found.errors.append(DataError(f"{path}: imu0: {doubt[0]}; {doubt[1]}, or leave it out: imu=none"))
    for listed in images[:1]:
        if first_ns is None or last_ns is None or not len(listed.t_ns):
            continue
        if int(listed.t_ns[-1]) < first_ns or (int(listed.t_ns[0]) - last_ns) > _TWO_CLOCKS_NS:
            found.errors.append(
                DataError(
                    f"{path}: {listed.name} from {listed.t_ns[0] * 1e-9:.1f} to {listed.t_ns[-1] * 1e-9:.1f} s, imu0 "
                    f"from {first_ns * 1e-9:.1f} s: two clocks; stamps=log takes the recorder's times for both"
                )
            )


_TWO_CLOCKS_NS = 3_600_000_000_000 * 24  # images a day behind the first inertial samples


def _truth(bag: Bag, entry: Entry, frames: Frames, body: str) -> Truth:
    """Return a reader of true poses: of the frame that a message names as moving, or of the body itself."""

    def read(problems: Problems) -> Trajectory | None:
        child = ""
        rows: list[Row[list[float]]] = []
        for found, message in messages_of(bag, entry.topic, problems):
            child = child or str(getattr(message, "child_frame_id", ""))
            pose = pose_numbers(message)
            t_ns = header_ns(message.header)
            T = rigid((pose[0], pose[1], pose[2]), (pose[3], pose[4], pose[5], pose[6]))
            if T is None:
                problems.count("truth: poses that are none", f"logged at {found.log_ns} ns")
            else:
                rows.append((fitting(found.log_ns) if t_ns is None else t_ns, pose))
        T_child_body = frames.between(child, body) if child and body else None
        return trajectory_of(rows, problems, np.eye(4) if T_child_body is None else T_child_body)

    return read
