"""What speaks for and against a run without any truth: numbers only, each of which may be unknown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from vislam.runs.verdict.agreement import ForceAgreement, TurnAgreement

_LEAST_KNOWN = 0.2  # of the variance of the prior that a measurement took away

Innovations = Mapping[str, tuple[int, float, int]]  # by kind: how many, the sum of their NIS, of their degrees

# by sensor: how many times as large as the filter takes it the variance of many readings is, and what they err by
# together: sigmas in the units of the residual, and seconds
SharedErrors = Mapping[str, tuple[float, tuple[float, ...], float]]


@dataclass(frozen=True, slots=True)
class Moved:
    """A number of the calibration as the run measured it."""

    by: float  # from what was given
    sigma: float  # of that

    @staticmethod
    def measured(by: float, sigma: float, prior_sigma: float) -> Moved | None:
        """Return what was measured, for an estimate [by, sigma] that a prior around zero has drawn towards zero.

        The prior states the same as what the verdict holds against the measurement; counted twice, it would hide it.
        None where hardly anything was measured.
        """
        known = 1.0 - (sigma / prior_sigma) ** 2
        return None if known < _LEAST_KNOWN else Moved(by / known, sigma / known**0.5)


@dataclass(frozen=True, slots=True)
class Driven:
    """What a run found out about a sensor of what drives, against what was stated of it."""

    name: str
    own: dict[str, tuple[float, float, Moved | None]]  # by variable: what was stated, its sigma, what was measured
    turn: Moved | None = None  # of its turns over the gyroscope's, from 1
    slip: float = 0.0  # in turns, as stated
    delay: Moved | None = None  # s, of its stamps behind the IMU's


@dataclass(frozen=True, slots=True)
class Apart:
    """How far filter and graph are from each other, each moved onto the other by yaw and position."""

    rms_m: float
    sigmas: float  # rms over the sigmas that both admit
    path_m: float


@dataclass(frozen=True, slots=True)
class Evidence:
    """The evidence of a run so far. Defaults are those of a run about which nothing is known and nothing wrong."""

    events: tuple[str, ...] = ()  # in streams of sensors, that leave less to go on
    causes: tuple[str, ...] = ()  # events that are no doubt by themselves, but explain others
    moving: tuple[str, ...] = ()  # events: something moved by itself before the camera
    # vision
    mode: str = ""
    is_alone: bool = False  # the IMU: there is neither a camera nor a further sensor
    frames: int = 0
    frames_lost: int = 0
    longest_loss_s: float = 0.0
    lost_reason: str = ""  # why vision lost most of them
    frames_degraded: int = 0
    frames_by_depth: int = 0  # of those: placed by depth alone
    frames_missing: int = 0  # that an even rate would have brought
    frames_repeated: int = 0  # equal to the one before in motion, several in a row, though not dark
    dark_s: float = 0.0  # longest time in which images showed nothing
    coverage: float = 1.0  # share of the frames that have a pose
    submaps_apart: int = 0  # submaps that no loop has joined with the first
    apart_reason: str = ""  # why the newest loop to one of them did not
    # how a live run kept up
    frames_offered: int = 0  # by the camera
    frames_dropped: int = 0  # of them, that were not taken in time
    frames_left_out: int = 0  # of them, left out for want of time
    samples: int = 0
    samples_missed: int = 0  # inertial ones, that their rate would have brought
    late_s: float = 0.0  # most that a frame waited
    busy: float = 0.0  # share of the time in which vision worked
    core: float = 0.0  # of a core that it had
    graph_late_s: float = 0.0  # most that a keyframe waited for the graph
    map_late_s: float = 0.0  # most that a frame waited for the map
    map_left_out: int = 0  # keyframes that the map left out for want of time
    # the start
    has_imu: bool = False
    is_started: bool = True  # gravity was found, or there is no IMU
    start_reason: str = ""  # how it was found, or why not
    start_failures: int = 0  # attempts in which sensors contradicted each other
    starts_taken_back: int = 0  # that poses were published of already
    is_confirmed: bool = True  # the start, by what came after it
    scale_sigma: float = 0.0  # relative, of one camera's metres at the end; 0: they are known, or there are none
    # the filter
    innovations: Innovations = field(default_factory=dict)  # that were accepted
    shared_errors: SharedErrors = field(default_factory=dict)  # of further sensors
    keyframes: int = 0
    refused: int = 0  # visual measurements
    offered: int = 0
    soft_resets: int = 0
    regained: dict[str, int] = field(default_factory=dict)  # sensors that it believed again after it refused them
    sigma_m: float = 0.0  # of its position at its worst
    uniform_s: float = 0.0  # longest stretch of one camera without motion that shows scale
    # filter, graph, loops
    apart: Apart | None = None
    loops_accepted: int = 0
    loops_contradicting: int = 0
    # calibration
    clock: Moved | None = None  # s, what is to be added to the camera's stamps
    rotation: Moved | None = None  # deg, of the camera on the body
    turns: TurnAgreement | None = None
    forces: ForceAgreement | None = None
    driven: tuple[Driven, ...] = ()
    misplaced_depth: str = ""  # where depth is that does not lie where it is stated to be
    # inertial data
    gyro_noise: float | None = None  # rad/s/sqrt(Hz), white noise in the quietest half second
    accel_noise: float | None = None  # m/s^2/sqrt(Hz)
    rate_hz: float | None = None
    rate_told_hz: float | None = None
    max_gap_s: float = 0.1  # between samples, that is no outage
    saturated: tuple[str, ...] = ()
    force_m_s2: float | None = None  # usual norm of what the accelerometer reads
    gravity_m_s2: float = 9.81
