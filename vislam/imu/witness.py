"""Whether inertial samples show the motion that a camera sees: other axes, another unit or another clock do not.

Two things are compared over a quarter of a second; what is usual in a run, and how well vision knows where it is at the
time, set how far apart they may be: by how much the body turned, and, where vision has metres, gravity in vision's
frame: what the body's acceleration, as three places in a row show it, leaves of the force that the accelerometer felt.
That is one vector for as long as vision goes on unbroken. Which of the two is wrong shows in the tracks: a camera that
follows who walks into its view contradicts good samples, after many tracks did not agree with the others; bad samples
come while the tracks agree as ever.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from vislam.core.geometry import interpolate, so3_log
from vislam.core.messages import Array, ImuSpan, Tracking, VoMeasurement
from vislam.core.quantiles import median
from vislam.imu.gyro_turns import gyro_rotation
from vislam.imu.series import subtract_bias

_NS = 1_000_000_000
_BASE_NS = _NS // 4  # over which motion is compared: places are known to millimetres, and gravity then to 0.1 m/s^2
_LONGEST_NS = 2 * _BASE_NS  # between two frames; more is a stretch without sight
_USUAL_OF, _FEWEST = 41, 11  # comparisons that say what is usual, and how many there have to be
_UNUSUAL = 10.0  # times the usual difference: vision errs by a few times of it where it blurs
_TURN_RAD, _TURN_SHARE = np.deg2rad(0.5), 0.1  # that blurred images may be off by, and as much of the turn itself
_LARGE_RAD = np.deg2rad(3.0)  # of a turn that shows how the camera stands on the body
_MISTAKEN = 2.0  # times that without metres: a turn looks much like a motion to the side
_FORCE_M_S2, _FORCE_SHARE = 1.0, 0.1  # the same of gravity: a place is off by a centimetre then
# without metres, mean acceleration over half a second is not seen: as much may be, and as many times the usual
_UNSEEN_M_S2, _UNSEEN = 5.0, 5.0
_SURE = 3.0  # times what vision itself states as sigma, where that is more
_CALM = 3.0  # times the usual difference up to which nothing has begun yet
_ENOUGH_S = 0.5  # of contradiction more than of agreement, for samples not to be believed ...
_MOST_WEIGHT = 4.0  # ... where they are off by no more than they may be; one by more counts at most that many times
_MOST_S = 2.0  # of agreement, for them to be believed again
_VOTE_S = 0.1  # that one frame counts at most
_LATELY_NS = _NS  # in which tracks have to agree as ever before samples are doubted
_MORE, _FEW = 2.0, 0.05  # times the usual share of outliers, and a share beyond that, that is no more than usual


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A frame where vision had the body, and what the samples since the one before it show."""

    t_ns: int
    T_vo_body: Array  # [4, 4]
    R_gyro: Array  # [3, 3] turn of the body
    force_m_s2: Array  # [3] mean, in vision's frame
    sigma_rad: float  # of vision's turn since its keyframe
    sigma_m: float  # of its way


class Outliers:
    """Owns which share of the tracks of the last frames did not agree on vision's motion."""

    def __init__(self) -> None:
        """Start before the first frame."""
        self._shares, self._means = deque[tuple[int, float]](), deque[tuple[int, float]]()
        self._usual = deque[float](maxlen=_USUAL_OF)

    def add(self, t_ns: int, share: float, is_usual: bool) -> None:
        """Take that of a frame; `is_usual`: nothing is doubted."""
        if is_usual:
            self._usual.append(share)
        _slide(self._shares, t_ns, share, _BASE_NS)
        _slide(self._means, t_ns, sum(one for _, one in self._shares) / len(self._shares), _LATELY_NS)

    @property
    def were_few(self) -> bool:
        """Whether there were lately no more than usual, all the time."""
        most = _MORE * np.mean(self._usual) + _FEW if self._usual else 0.0
        return bool(max(mean for _, mean in self._means) <= most)


class MotionWitness:
    """Owns the last frames, what is usual between vision and samples, and the votes against the samples.

    Attributes:
        until_ns: samples after this time are no information; None: all are believed.
        since_ns: when the newest contradiction began; 0: there was none.
        doubted_ns: when samples last contradicted what was seen; 0: never.
        turns: the last large ones of the body, [3, 3] by gyroscope and by vision.
    """

    def __init__(self) -> None:
        """Believe, before the first frame."""
        self.until_ns: int | None = None
        self.since_ns = self.doubted_ns = 0
        self.turns = deque[tuple[Array, Array]](maxlen=_USUAL_OF)
        self._calm_ns = 0, 0  # the newest frame at which nothing had begun, and the one before it
        self._frames: list[_Seen] = []
        self._turns_rad, self._forces_m_s2 = deque[float](maxlen=_USUAL_OF), deque[float](maxlen=_USUAL_OF)
        self._gravity = deque[Array](maxlen=_USUAL_OF)  # [3] m/s^2, in vision's frame while that is one
        self._outliers = Outliers()
        self._against_s = 0.0
        self._is_vision_doubted = False  # since it contradicts samples, until both agree

    def see(
        self, vo: VoMeasurement, outliers: float, T_vo_body: Array, samples: Callable[[int, int], ImuSpan | None],
        biases: tuple[Array, Array],
    ) -> None:  # fmt: skip
        """Compare a frame.

        Args:
            vo: what vision made of it.
            outliers: the share of tracks that do not agree on it.
            T_vo_body: [4, 4] where vision has the body.
            samples: gives those between two times, None where there are none.
            biases: of gyroscope and accelerometer, [3] each.
        """
        if vo.T_keyframe_body is None:
            self._frames.clear()
            self._gravity.clear()
            return
        self._outliers.add(vo.t_ns, outliers, self._against_s == 0.0 and not self._is_vision_doubted)
        if vo.tracking is Tracking.OK:
            last = self._frames[-1] if self._frames else None
            span = None if last is None or vo.t_ns - last.t_ns > _LONGEST_NS else samples(last.t_ns, vo.t_ns)
            sigmas = [float(np.sqrt(np.trace(vo.covariance[k : k + 3, k : k + 3]))) for k in (0, 3)]
            if last is None or span is None:
                self._frames = [_Seen(vo.t_ns, T_vo_body, np.eye(3), np.zeros(3), *sigmas)]
                return
            span = subtract_bias(span, *biases)
            force = interpolate(last.T_vo_body, T_vo_body, 0.5)[:3, :3] @ span.accel_m_s2.mean(axis=0)
            self._frames.append(_Seen(vo.t_ns, T_vo_body, gyro_rotation(span), force, *sigmas))
            self._compare(vo.has_scale)

    def doubt(self, until_ns: int, t_ns: int) -> None:
        """Disbelieve samples after a time, as what is known of their stamps at `t_ns` asks for."""
        if self.until_ns is None:
            self.until_ns, self.since_ns = until_ns, until_ns + 1
        self.doubted_ns, self._against_s = t_ns, max(self._against_s, _ENOUGH_S)

    @property
    def doubts(self) -> bool:
        """Whether samples contradict now what is seen."""
        return self._against_s > 0.0

    def _compare(self, is_metric: bool) -> None:
        """Vote on the newest frame, if it and those before it show enough."""
        middle = _before(self._frames, len(self._frames) - 1)
        first = _before(self._frames, middle) if middle > 0 else -1
        if middle < 0:
            return
        self._frames, middle, first = self._frames[max(first, 0) :], middle - max(first, 0), min(first, 0)
        R_gyro, R_seen = _turns(self._frames[middle:])
        off_rad, *turns = (float(np.linalg.norm(so3_log(R))) for R in (R_gyro.T @ R_seen, R_gyro, R_seen))
        turn_rad = max(turns)
        if turns[0] > _LARGE_RAD:
            self.turns.append((R_gyro, R_seen))
        may_rad = (_TURN_RAD if is_metric else _MISTAKEN * _TURN_RAD) + _TURN_SHARE * turn_rad
        sigma_rad = float(np.hypot(self._frames[middle].sigma_rad, self._frames[-1].sigma_rad))
        off, is_calm = self._off(off_rad, self._turns_rad, max(may_rad, _SURE * sigma_rad))
        is_informative = turn_rad > 2.0 * _TURN_RAD
        if first == 0:
            gravity, own_m_s2, sigma_m_s2 = _mean_gravity(self._frames), 0.0, 0.0
            if is_metric:
                gravity, own_m_s2, sigma_m_s2 = _gravity(self._frames, middle)
            if self._gravity:
                off_m_s2 = float(np.linalg.norm(gravity - np.median(self._gravity, axis=0)))
                may_m_s2 = _FORCE_M_S2 + _FORCE_SHARE * own_m_s2 if is_metric else _UNSEEN_M_S2
                times = _UNUSUAL if is_metric else _UNSEEN
                may_m_s2 = max(may_m_s2, _SURE * sigma_m_s2)
                by_force, is_force_calm = self._off(off_m_s2, self._forces_m_s2, may_m_s2, times)
                off, is_calm, is_informative = max(off, by_force), is_calm and is_force_calm, True
            if off <= 1.0 and self.until_ns is None:
                self._gravity.append(gravity)
        if is_calm:
            self._calm_ns = self._frames[-1].t_ns, self._frames[-2].t_ns
        if off <= 1.0:
            self._agree(is_informative)
        else:
            self._contradict(min(off, _MOST_WEIGHT))

    def _off(self, off: float, usual: deque[float], least: float, times: float = _UNUSUAL) -> tuple[float, bool]:
        """Return a difference over what it may be, above 1 where it is not usual, and whether nothing has begun yet.

        One that is usual is taken note of.
        """
        middle = median(np.array(usual)) if usual else np.inf
        ratio = off / max(times * middle, least) if len(usual) >= _FEWEST else 0.0
        if ratio <= 1.0 and self.until_ns is None:
            usual.append(off)
        return ratio, off <= _CALM * middle

    @property
    def _vote_s(self) -> float:
        return min((self._frames[-1].t_ns - self._frames[-2].t_ns) / _NS, _VOTE_S)

    def _agree(self, is_informative: bool) -> None:
        self._is_vision_doubted = self._is_vision_doubted and not is_informative
        self._against_s = max(self._against_s - self._vote_s * is_informative, 0.0)
        if self._against_s == 0.0:
            self.until_ns = None

    def _contradict(self, weight: float) -> None:
        """Vote against the samples, unless it is vision that is to be doubted."""
        t_ns = self._frames[-1].t_ns
        if self.until_ns is None and not self._outliers.were_few:
            self._is_vision_doubted, self._against_s = True, 0.0
        if self._is_vision_doubted:
            return
        if self._against_s == 0.0:
            self.since_ns = next(frame.t_ns for frame in self._frames if frame.t_ns > self._calm_ns[0])
        self.doubted_ns = t_ns
        self._against_s += self._vote_s * weight
        if self._against_s >= _ENOUGH_S and self.until_ns is None:
            self.until_ns = self._calm_ns[1]
        self._against_s = _MOST_S if self.until_ns is not None else self._against_s


def _slide(window: deque[tuple[int, float]], t_ns: int, value: float, length_ns: int) -> None:
    window.append((t_ns, value))
    while window[0][0] <= t_ns - length_ns:
        window.popleft()


def _before(frames: Sequence[_Seen], k: int) -> int:
    """Return the newest frame that is long enough before frame `k`; -1: there is none."""
    return next((i for i in range(k - 1, -1, -1) if frames[k].t_ns - frames[i].t_ns >= _BASE_NS), -1)


def _turns(frames: Sequence[_Seen]) -> tuple[Array, Array]:
    """Return the turns [3, 3] over some frames by gyroscope and by vision."""
    R_gyro = np.eye(3)
    for frame in frames[1:]:
        R_gyro = R_gyro @ frame.R_gyro
    return R_gyro, np.ascontiguousarray(frames[0].T_vo_body[:3, :3].T @ frames[-1].T_vo_body[:3, :3])


def _mean_gravity(frames: Sequence[_Seen]) -> Array:
    """Return gravity [3] as the forces between some frames show it, were the body's velocity the same at both ends."""
    felt_m_s = np.sum([b.force_m_s2 * (b.t_ns - a.t_ns) for a, b in pairwise(frames)], axis=0)
    return np.asarray(-felt_m_s / (frames[-1].t_ns - frames[0].t_ns))


def _gravity(frames: Sequence[_Seen], middle: int) -> tuple[Array, float, float]:
    """Return gravity [3] as three places and the forces between them show it, and the body's own acceleration (m/s^2).

    The third value is what the places are unsure of, as sigma of gravity. The change of the mean velocity from the
    first part to the second is the acceleration under a hat that stands on both, with its top at the middle frame.
    """
    low, top, high = frames[0], frames[middle], frames[-1]
    before_s, after_s = (top.t_ns - low.t_ns) / _NS, (high.t_ns - top.t_ns) / _NS
    p_low, p_top, p_high = (frame.T_vo_body[:3, 3] for frame in (low, top, high))
    change_m_s, felt_m_s = (p_high - p_top) / after_s - (p_top - p_low) / before_s, np.zeros(3)
    for a, b in pairwise(frames):
        at_s = ((a.t_ns - low.t_ns) + (b.t_ns - low.t_ns)) / (2.0 * _NS)
        weight = min(at_s / before_s, (before_s + after_s - at_s) / after_s)
        felt_m_s += weight * (b.t_ns - a.t_ns) / _NS * b.force_m_s2
    area_s = 0.5 * (before_s + after_s)
    sigma_m_s = np.linalg.norm(
        [low.sigma_m / before_s, top.sigma_m * (1.0 / before_s + 1.0 / after_s), high.sigma_m / after_s]
    )
    own_m_s2, sigma_m_s2 = np.array([np.linalg.norm(change_m_s), sigma_m_s]) / area_s
    return (change_m_s - felt_m_s) / area_s, float(own_m_s2), float(sigma_m_s2)
