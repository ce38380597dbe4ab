"""Defaults of live runs, of the viewer and of the verdict."""

from dataclasses import dataclass
from typing import Annotated

from vislam.config.ranges import Count, Finite, Many, NonNegative, Positive, Probability, Range


@dataclass(frozen=True, slots=True)
class LiveConfig:
    """Live sensors: processes, and the pose that they publish for control."""

    name: str = "vislam-pose"  # of the shared memory, /dev/shm/NAME, and of the socket NAME.sock
    send_to: tuple[str, ...] = ("unix",)  # a datagram per sample to: unix[:PATH], udp:HOST:PORT
    group: str | None = None  # its members may read the shared memory, too: a controller of another user's
    allow_remote: bool = False  # let send_to, mavlink and ROS 2 reach other machines
    ros2_domain: Annotated[int, Range(0, 232)] | None = None  # /odom and /tf over DDS, in this domain; needs cyclonedds
    mavlink: str | None = None  # udp:HOST:PORT that gets ODOMETRY; needs pymavlink
    bridge_rate_hz: Positive = 50.0  # of both at most: what autopilots want; control near by takes the datagrams
    base_offset_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)  # what a controller steers, in body axes
    # without a correction for this time it is dead reckoning; a lost frame is reported at once
    vision_timeout_s: NonNegative = 0.3
    drift_sigma_m: NonNegative = 0.3  # position sigma gained since vision was lost, above which the pose is invalid
    velocity_sigma_m_s: NonNegative = 0.5  # above which it is invalid
    event_s: NonNegative = 0.5  # so long a passing sensor event stays in the health word
    keyframe_queue: Count = 8  # keyframes that may wait for the back end; when half of that wait, fewer are made
    map_age_s: Positive = 2.0  # older frames make the map take fewer keyframes: it would fall behind without end
    # 1 to 99: SCHED_FIFO for the fast process, where the system permits; 0: as others
    realtime_priority: Annotated[int, Range(0, 99)] = 0


@dataclass(frozen=True, slots=True)
class ViewConfig:
    """The Rerun recording of a run."""

    enabled: bool = True  # off: no run.rrd
    every_frames: Count = 2  # from one frame with logged images to the next: halves the cost, and looks the same
    image_width_px: Count = 320  # a JPEG of this width costs 1.5 ms and 9 kB; VGA costs three times that
    cloud_points: Count = 4000  # per keyframe, from depth; sparse features are all kept
    map_every_s: Positive = 5.0  # octree and grid are written again so often at most
    map_voxels: Many = 20_000  # at most in each, larger maps get coarser ones; 16 bytes each


@dataclass(frozen=True, slots=True)
class VerdictConfig:
    """When a run is doubted. Sigmas are those of classes of sensors, not of a recording."""

    # of each test to pass where nothing is wrong: some 15 tests, 1 doubt in 60 sound runs
    probability: Probability = 0.999
    # of the camera on the body as calibrated: Kalibr is good to 0.1, a printed mount to 1
    rotation_sigma_deg: NonNegative = 0.5
    accel_bias_sigma_m_s2: NonNegative = 0.2  # as `init.accel_bias_sigma_m_s2`: of a calibrated cheap accelerometer
