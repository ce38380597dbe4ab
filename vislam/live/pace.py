"""Whether vision keeps up with its camera and the map with vision, and less to do for them where they do not.

A camera keeps its newest image only: a machine that is too slow loses frames where chance has it, and takes the time
that inertial samples and the back end need. So frames are left out evenly before: every second one, then three in four.
The map follows behind a queue: so that it is never far behind, it takes fewer keyframes.
"""

from statistics import median

from vislam.core.messages import Frame, ImuSample

_NS = 1_000_000_000
_WINDOW_NS = 2 * _NS  # of frames, after which the pace is looked at again
_OUTAGE_NS = _NS  # without a frame or a sample for longer, the sensor was away
_MOST_DROPPED = 0.1  # of the frames of a window
_LIGHT = 0.35  # of a window that work may take so that twice the frames fit, with a margin
_LIGHT_WINDOWS = 3  # in a row: a window without keyframes is no promise
_SLOWEST = 4
_FIRST_GAPS = 100  # between samples, from which a sensor's own rate is estimated
_SLOWER = 1.2  # than configured, that is another rate and no jitter


class Pace:
    """Decides which frames to take, and counts what the machine did not manage.

    Attributes:
        every: one frame in this many is taken; 1: all.
    """

    def __init__(self, imu_rate_hz: float) -> None:
        """Begin with every frame; samples come at `imu_rate_hz`."""
        self.every = 1
        self._period_ns = _NS / imu_rate_hz
        self._gaps_ns: list[int] = []  # between the first samples
        self._sample_ns: int | None = None
        self._samples = self._missed = 0
        self._last: tuple[int, int] | None = None  # stamp and index of the newest frame
        self._offered = self._dropped = self._left_out = 0
        self._busy_ns = self._cpu_ns = self._span_ns = self._latest_ns = 0
        self._done_ns = 0  # when work on the newest frame ended
        self._begin_ns: int | None = None  # of this window
        self._window = (0, 0, 0)  # frames offered and dropped, and busy time, when it began
        self._light_windows = 0

    def add_sample(self, sample: ImuSample) -> None:
        """Take note of an inertial sample: of those that should have come before it, too."""
        self._samples += 1
        if self._sample_ns is not None and sample.t_ns - self._sample_ns <= _OUTAGE_NS:
            gap_ns = sample.t_ns - self._sample_ns
            self._missed += max(round(gap_ns / self._period_ns) - 1, 0)
            self._learn_period(gap_ns)
        self._sample_ns = sample.t_ns

    def _learn_period(self, gap_ns: int) -> None:
        """Follow a sensor that is slower than configured: what it never sends is not missed."""
        if len(self._gaps_ns) < _FIRST_GAPS:
            self._gaps_ns.append(gap_ns)
            if len(self._gaps_ns) == _FIRST_GAPS and (period_ns := median(self._gaps_ns)) > _SLOWER * self._period_ns:
                self._period_ns, self._missed = period_ns, 0

    def wants(self, frame: Frame) -> bool:
        """Return whether to take a frame that the camera gave."""
        last, self._last = self._last, (frame.t_ns, frame.index)
        if last is None or frame.t_ns - max(last[0], self._done_ns) > _OUTAGE_NS:
            self._begin(frame.t_ns)
            self._offered += 1
            return True
        passed = max(frame.index - last[1], 1)
        self._offered += passed
        self._dropped += passed - 1
        self._span_ns += frame.t_ns - last[0]
        self._review(frame.t_ns)
        is_wanted = frame.index % self.every == 0
        self._left_out += not is_wanted
        return is_wanted

    def took(self, frame: Frame, begun_ns: int, done_ns: int, cpu_ns: int) -> None:
        """Take note of the time (CLOCK_MONOTONIC, as the frame's stamp) that work on a frame took, and of its CPU."""
        self._busy_ns += done_ns - begun_ns
        self._cpu_ns += cpu_ns
        self._done_ns = done_ns
        self._latest_ns = max(self._latest_ns, begun_ns - frame.t_ns)

    @property
    def counters(self) -> dict[str, int]:
        """What was offered and what was managed."""
        return {
            "frames_offered": self._offered,
            "frames_dropped": self._dropped,
            "frames_left_out": self._left_out,
            "samples": self._samples,
            "samples_missed": self._missed,
            "late_ms": round(self._latest_ns * 1e-6),
            "busy_percent": self._percent(self._busy_ns),
            "core_percent": self._percent(self._cpu_ns),
        }

    def _percent(self, spent_ns: int) -> int:
        """Return a share of the time so far, of which the newest frame's own may be no part yet."""
        return min(round(100.0 * spent_ns / self._span_ns), 100) if self._span_ns else 0

    def _begin(self, t_ns: int) -> None:
        self._begin_ns, self._window = t_ns, (self._offered, self._dropped, self._busy_ns)

    def _review(self, t_ns: int) -> None:
        assert self._begin_ns is not None
        length_ns = t_ns - self._begin_ns
        if length_ns < _WINDOW_NS:
            return
        offered, dropped, busy_ns = self._window
        is_light = self._busy_ns - busy_ns < _LIGHT * length_ns
        self._light_windows = self._light_windows + 1 if is_light else 0
        if self._dropped - dropped > _MOST_DROPPED * (self._offered - offered):
            self.every, self._light_windows = min(2 * self.every, _SLOWEST), 0
        elif self._light_windows >= _LIGHT_WINDOWS and self.every > 1:
            self.every, self._light_windows = self.every // 2, 0
        self._begin(t_ns)


class MapPace:
    """Decides which keyframes the map takes, by how old frames are when it comes to them.

    Attributes:
        left_out: keyframes that it did not take.
        latest_s: most that a frame was old.
    """

    def __init__(self, most_s: float) -> None:
        """Take every second keyframe from half of an age on, and none from that age on."""
        self.left_out, self.latest_s = 0, 0.0
        self._most_s = most_s
        self._left_out_last = False

    def wants(self, age_s: float) -> bool:
        """Return whether the map takes a keyframe, when the newest frame it knows of has waited for `age_s`."""
        self.latest_s = max(self.latest_s, age_s)
        every_second = age_s > 0.5 * self._most_s and not self._left_out_last
        self._left_out_last = age_s > self._most_s or every_second
        self.left_out += self._left_out_last
        return not self._left_out_last
