"""Defaults of live runs and of the viewer."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LiveConfig:
    """Live sensors: processes, and the pose that they publish for control."""

    name: str = "vislam-pose"  # of the shared memory, /dev/shm/NAME, and of the socket NAME.sock
    send_to: tuple[str, ...] = ("unix",)  # a datagram per sample to: unix[:PATH], udp:HOST:PORT
    allow_remote: bool = False  # let send_to, mavlink and ROS 2 reach other machines
    ros2_domain: int | None = None  # /odom and /tf over DDS, in this domain; needs cyclonedds
    mavlink: str | None = None  # udp:HOST:PORT that gets ODOMETRY; needs pymavlink
    bridge_rate_hz: float = 50.0  # of both at most: what autopilots want; control near by takes the datagrams
    base_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # what a controller steers, in body axes
    vision_timeout_s: float = 0.3  # without a correction for so long it is dead reckoning; a lost frame says so at once
    drift_sigma_m: float = 0.3  # position sigma gained since vision was lost, above which the pose is invalid
    velocity_sigma_m_s: float = 0.5  # above which it is invalid
    imu_timeout_s: float = 0.1  # without a sample for so long the pose is old: invalid
    heartbeat_s: float = 0.05  # between poses while there are no samples, so that a reader sees why
    event_s: float = 0.5  # so long a passing sensor event stays in the health word
    rest_speed_m_s: float = 0.1  # without vision, still inertial data mean rest only below this speed and its sigma
    keyframe_queue: int = 8  # keyframes that may wait for the back end; when half of that wait, fewer are made
    crowded_spacing: float = 2.0  # factor on the distances between keyframes then
    realtime_priority: int = 0  # 1 to 99: SCHED_FIFO for the fast process, where the system permits; 0: as others


@dataclass(frozen=True, slots=True)
class ViewConfig:
    """The Rerun recording of a run."""

    enabled: bool = True
    every_frames: int = 2  # images are logged for one frame in so many: halves the cost, and nobody sees it
    image_width_px: int = 320  # a JPEG of this width costs 1.5 ms and 9 kB; VGA costs three times that
    jpeg_quality: int = 75
    cloud_points: int = 4000  # per keyframe, from depth; sparse features are all kept
    max_range_m: float = 8.0  # farther depth is noise that hides the scene
    map_every_s: float = 5.0  # octree and grid are written again so often at most
    map_voxels: int = 20_000  # at most in each, larger maps get coarser ones; 16 bytes each
