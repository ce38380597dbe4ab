"""From evidence to a verdict: trusted, doubtful with reasons, or lost. Pure: the same evidence, the same verdict."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from vislam.config import VerdictConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.streams import Happening
from vislam.runs.verdict.evidence import Evidence, Moved

# of the camera's clock as given: drivers that stamp on arrival are off by up to 30 ms
_CLOCK_SIGMA_S = 0.015
_STAMP_SIGMA_S = 0.03  # of readings of what drives: stamped on arrival, and averages over their period
_DRIVEN_SIGMA = 0.04  # relative, of turns by wheels: tracks and radii are known to 3 % each; or the slip stated
_TURN_SCALE_SIGMA = 0.004  # relative, of focal length (Kalibr: 0.2 %) and of a calibrated gyro (0.3 %)
_FORCE_SCALE_SIGMA = 0.01  # relative, of accelerometer and of baseline or depth, all calibrated
# white noise of inertial data, in the quietest half second; what is stated does not matter, for estimators learn it.
# Flights of EuRoC have 0.1 and 0.05; beyond these two, inertial data show less than vision between two keyframes
_GYRO_NOISE_DEG = 1.0  # after a second
_ACCEL_NOISE_M_S = 0.3  # after a second
_RATE_ERROR = 0.2  # relative, of the inertial rate against that stated: clocks are good to 3 %
_MIN_COVERAGE = 0.5  # of the frames that must have a pose; below, the run is lost
_LOST_SHARE = 0.1  # of the frames that vision may lose: it finds its keyframe again, and nothing drifted ...
LOST_S = 1.0  # ... but not after so long without: a cheap IMU alone is off by a centimetre to a decimetre then
_DEGRADED_SHARE = 0.2  # of the frames on which vision may lean weakly
_MISSING_SHARE = 0.1  # of the frames that may never arrive: patches are followed over twice the interval then
_REPEATED_FRAMES = 3  # images equal to the last bit in motion: one may be a hiccup, a stuck driver sends many
_REFUSED_SHARE = 0.1  # of visual measurements that the filter may refuse: more than outliers explain
# what readings of a sensor share may make the variance of many so much larger; alike for no longer than two of its
# seconds, they may show how the body moves meanwhile
_SHARED_EXCESS, _SHARED_S = 2.0, 2.0
_CONTRADICTING_SHARE = 0.25  # of verified loops that the graph may refuse, as `graph/joining.py` does
_UNIFORM_S = 20.0  # one camera without motion that shows scale: biases have walked away by then
_SIGMA_M = 1.0  # of the filter's position at its worst: no controller can use it
# rms between filter and graph over what both admit: independent models would differ by 1
_APART_SIGMAS = 3.0
_APART_SHARE = 0.005  # of the way: closer together than this they agree, whatever their covariances
_MIN_FRAMES = 30  # before shares of them mean anything
_FEW_LOST = 2  # frames, that any run may lose
_SCALE_SIGMA = 0.025  # relative, of one camera's metres: one run of twenty is off by more than 5 %
_MIN_LOOPS = 8
_MIN_KEYFRAMES = 10
_SOON_S = 0.05  # that things may wait without a remark
_OWN_SHARE = 0.7  # of the time in which vision works that it has a core; below, other work has it
_CALIBRATE = "run `vislam calibrate camera-imu`"


class Trust(StrEnum):
    """What a run is worth, as far as it can judge itself."""

    TRUSTED = "trusted"
    DOUBTFUL = "doubtful"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a run is worth, why, and what it found out about its sensors.

    `reasons` are empty of a run that is trusted. `moved` is what calibration found beyond its own sigmas: corrected,
    no doubt of itself.
    """

    state: Trust
    reasons: tuple[str, ...] = ()
    moved: tuple[str, ...] = ()


def verdict_sentence(entry: Mapping[str, Any]) -> str:
    """Return a verdict as one sentence without the full stop, from its entry of metrics.json."""
    reasons = [str(reason) for reason in entry.get("reasons") or ["nothing in the run contradicts itself"]]
    return f"{str(entry.get('state', 'unknown')).capitalize()}: {'; '.join(reasons)}"


def judge(evidence: Evidence, config: VerdictConfig) -> Verdict:
    """Return the verdict on a run, or on what there is of it so far."""
    slow, lost = tuple(_slow(evidence, config)), tuple(_lost(evidence, config))
    reasons = tuple(reason for test in _TESTS for reason in test(evidence, config))
    state = Trust.LOST if lost else Trust.DOUBTFUL if slow or reasons else Trust.TRUSTED
    causes = evidence.causes + evidence.moving * evidence.has_imu if lost or reasons else ()
    return Verdict(state, slow + causes + lost + reasons, tuple(_moved(evidence, config)))


def _slow(e: Evidence, _: VerdictConfig) -> Iterator[str]:
    """Say first that the machine did not keep up: much of what else is wrong comes of that."""
    if not _is_slow(e):
        return
    unseen = e.frames_dropped + e.frames_left_out
    mapped = f", {e.map_left_out} of {e.keyframes} keyframes left out of the map" if e.map_left_out else ""
    waited = {"frames for vision": e.late_s, "for the map": e.map_late_s, "keyframes for the graph": e.graph_late_s}
    longest = ", ".join(f"{what} {late_s:.1f} s" for what, late_s in waited.items() if late_s >= _SOON_S)
    waits = f"; what waited longest: {longest}" if longest else ""
    looked = worked = ""
    if e.frames_offered:
        seen = f"({e.frames_dropped} dropped, {e.frames_left_out} left out in time)"
        looked = f"{unseen} of {e.frames_offered} frames were not looked at {seen}, "
        worked = f"; vision worked {e.busy:.0%} of the time, with {e.core:.0%} of a core"
    others = "other work had its core, so end that first; then " if e.core < _OWN_SHARE * e.busy else ""
    samples = "; for samples, --live.realtime-priority 50" if _misses_samples(e) else ""
    yield (
        f"the machine is too slow for its sensors: {looked}{e.samples_missed} of {e.samples + e.samples_missed} "
        f"inertial samples missed{mapped}{waits}{worked}: {others}give it less to do (--profile pi, a lower rate of "
        f"the camera, --map.no-enabled, --view.no-enabled){samples}"
    )


def _is_slow(e: Evidence) -> bool:
    unseen = e.frames_dropped + e.frames_left_out
    is_blind = e.frames_offered >= _MIN_FRAMES and unseen > _MISSING_SHARE * e.frames_offered
    is_thin = e.keyframes >= _MIN_KEYFRAMES and e.map_left_out > _MISSING_SHARE * e.keyframes
    return is_blind or is_thin or _misses_samples(e)


def _misses_samples(e: Evidence) -> bool:
    return e.samples_missed > _MISSING_SHARE * (e.samples + e.samples_missed)


def _lost(e: Evidence, _: VerdictConfig) -> Iterator[str]:
    why = e.lost_reason or e.start_reason or "vision was lost"
    if e.frames and e.coverage < _MIN_COVERAGE:
        why = why if e.frames_lost > _MIN_COVERAGE * e.frames else e.start_reason or why
        yield f"only {e.coverage:.0%} of the frames have a pose ({why})"
    elif not e.has_imu and e.frames_lost > (1.0 - _MIN_COVERAGE) * e.frames:
        yield f"vision placed only {e.frames - e.frames_lost} of {e.frames} frames ({why})"


def _streams(e: Evidence, _: VerdictConfig) -> Iterator[str]:
    """Name what happened to sensors: much of what else is wrong comes of that."""
    for event in e.events:
        first = "axes (T_BS, or its inverse), " if Happening.CONTRADICTING.words in event else ""
        yield f"{event}: look at the sensor's {first}cable, driver and clock, and the machine's load"
    if e.dark_s > LOST_S:
        yield f"images were dark for {e.dark_s:.1f} s: look at the lens, the light and the exposure"


def _vision(e: Evidence, _: VerdictConfig) -> Iterator[str]:
    is_long = e.frames >= _MIN_FRAMES
    if e.frames_lost > max(_LOST_SHARE * e.frames, _FEW_LOST) or e.longest_loss_s > LOST_S:
        why = f", mostly because {e.lost_reason}" if e.lost_reason else ""
        yield (
            f"vision lost {e.frames_lost} of {e.frames} frames, {e.longest_loss_s:.1f} s at once{why}: look at "
            "tracking.csv for when"
        )
    if is_long and e.frames_degraded > _DEGRADED_SHARE * e.frames:
        by_depth = f", {e.frames_by_depth} of them placed by depth alone" if e.frames_by_depth else ""
        yield (
            f"vision was weak in {e.frames_degraded} of {e.frames} frames{by_depth}: more light, texture or a sharper "
            "lens"
        )
    if is_long and e.frames_missing > _MISSING_SHARE * (e.frames + e.frames_missing) and not _is_slow(e):
        yield (
            f"{e.frames_missing} of {e.frames + e.frames_missing} frames never arrived: look at the camera's cable, "
            "its driver and the load of the machine"
        )
    if e.frames_repeated >= _REPEATED_FRAMES:
        yield f"{e.frames_repeated} images repeat the one before while the body moves: the camera's driver is stuck"
    if e.moving and not e.has_imu:  # an IMU would know the motion of the body
        more = f", and {len(e.moving) - 1} times more" if len(e.moving) > 1 else ""
        yield f"{e.moving[0]}{more}: do not trust the way since then, and keep the camera off what moves"
    if e.submaps_apart:
        why = f" ({e.apart_reason})" if e.apart_reason else ""
        yield f"{e.submaps_apart} submaps are joined with nothing{why}: return to where the camera has been"


def _start(e: Evidence, _: VerdictConfig) -> Iterator[str]:
    if not e.is_started:
        yield f"gravity was not found, so inertial data were of no use: {e.start_reason}"
    elif e.start_failures > 1:
        yield (
            f"vision and inertial data contradicted each other in {e.start_failures} attempts to start: check axes and "
            f"units of the IMU, then {_CALIBRATE}"
        )
    elif not e.is_confirmed:
        yield "the start was not confirmed before the end: scale may err by more than its sigma; go on longer"
    if e.scale_sigma > _SCALE_SIGMA:
        known = f"known to {100.0 * e.scale_sigma:.1f} % (1 sigma) only"
        known = known if math.isfinite(e.scale_sigma) else "not known yet"
        yield f"one camera's metres are {known}: move with more changes of speed, or use a second camera or depth"


def _filter(e: Evidence, c: VerdictConfig) -> Iterator[str]:
    if e.soft_resets:
        yield (
            f"vision contradicted the filter for so long that it gave up its certainty {e.soft_resets} times: look for "
            "something that moves through the image, and check calibration and time offset"
        )
    for name, count in e.regained.items():
        yield (
            f"the filter refused readings of {name} until enough agreed that it moved to them, {count} times: it was "
            "surer than it was right; look for stretches without sight, and for an IMU that is worse than stated"
        )
    if e.offered >= _MIN_FRAMES and e.refused > _REFUSED_SHARE * e.offered:
        yield f"the filter refused {e.refused} of {e.offered} visual measurements as impossible"
    for kind, (count, nis, degrees) in e.innovations.items():
        # frames that share a keyframe share its errors: no more of them are independent than there are keyframes
        share = min(e.keyframes / count, 1.0) if count else 0.0
        independent = max(round(share * degrees), 1)
        if share * nis > chi_square_limit(c.probability, independent):
            yield (
                f"innovations of {kind.replace('_', ' ')} are {nis / degrees:.1f} times what the stated noise "
                "explains: calibrate, or state more noise"
            )
    for name, (excess, sigmas, lasts_s) in e.shared_errors.items():
        if excess > _SHARED_EXCESS and lasts_s > _SHARED_S:
            given = f"{max(sigmas):.2g}" if len(set(sigmas)) == 1 else f"[{', '.join(f'{s:.2g}' for s in sigmas)}]"
            yield (
                f"readings of {name} err together for {lasts_s:.0f} s, and the mean of many has {excess:.1f} times the "
                f"variance that the filter takes it to have: give [sensors.{name}] correlated_sigma = {given} and "
                f"correlation_s = {lasts_s:.0f}, at least"
            )
    if e.sigma_m > _SIGMA_M:
        alone = ", for an IMU alone does not see the way: add wheels, fixes or a camera" if e.is_alone else ""
        yield f"the filter's position was uncertain by {e.sigma_m:.1f} m (1 sigma) at its worst{alone}"
    if e.uniform_s > _UNIFORM_S:
        yield (
            f"uniform motion for {e.uniform_s:.0f} s, in which one camera's scale is held by the IMU's biases alone: "
            "accelerate now and then, or use a second camera or depth"
        )


def _graph(e: Evidence, _: VerdictConfig) -> Iterator[str]:
    apart = e.apart
    if apart is not None and apart.sigmas > _APART_SIGMAS and apart.rms_m > _APART_SHARE * apart.path_m:
        yield (
            f"filter and graph are {apart.rms_m:.2f} m apart over {apart.path_m:.0f} m of way, {apart.sigmas:.1f} "
            "times what both admit: one of them is wrong"
        )
    offered = e.loops_accepted + e.loops_contradicting
    if offered >= _MIN_LOOPS and e.loops_contradicting > _CONTRADICTING_SHARE * offered:
        yield f"{e.loops_contradicting} of {offered} verified loops contradict the trajectory: look at loops.csv"


def _calibration(e: Evidence, c: VerdictConfig) -> Iterator[str]:
    turns, forces = e.turns, e.forces
    if e.misplaced_depth:
        yield e.misplaced_depth
    if turns is not None and (apart_deg := math.degrees(turns.worst_rad)) > _GYRO_NOISE_DEG:
        yield (
            f"one in ten turns between keyframes is {apart_deg:.1f} degrees or more apart by vision and by gyroscope: "
            "look at the gyroscope's axes, cable and driver, and for what moves through the image"
        )
        return  # what a calibration would be measured by contradicts itself
    if e.rotation is not None and _beyond(e.rotation, c.rotation_sigma_deg, 3, c):
        yield f"the camera is turned by {e.rotation.by:.1f} degrees against its file: calibrate ({_CALIBRATE})"
    if e.clock is not None and _beyond(e.clock, _CLOCK_SIGMA_S, 1, c):
        yield f"{_clock_words(e.clock)}, beyond any driver's delay: set --init.time-offset-s, or {_CALIBRATE}"
    if turns is not None and _beyond(Moved(turns.scale_error, turns.scale_sigma), _TURN_SCALE_SIGMA, 1, c):
        yield (
            f"vision sees turns {_percent(turns.scale_error)} than the gyroscope: focal length or gyro scale is wrong: "
            "calibrate camera and gyroscope"
        )
    if forces is None:
        return
    if _beyond(Moved(forces.scale - 1.0, forces.scale_sigma), _FORCE_SCALE_SIGMA, 1, c):
        yield (
            f"the accelerometer's metres are {_percent(forces.scale - 1.0)} than those of vision: check baseline or "
            "depth scale, and calibrate the accelerometer"
        )
    gravity = Moved(forces.gravity_m_s2 - e.gravity_m_s2, forces.gravity_sigma_m_s2)
    if _beyond(gravity, _FORCE_SCALE_SIGMA * e.gravity_m_s2, 1, c):
        yield f"gravity along the way is {forces.gravity_m_s2:.2f} m/s2: calibrate the accelerometer"


def _inertial(e: Evidence, c: VerdictConfig) -> Iterator[str]:
    turn_deg = math.degrees(e.gyro_noise or 0.0)  # in a second, as densities are per root of it
    if turn_deg > _GYRO_NOISE_DEG:
        yield f"gyroscope noise is {turn_deg:.1f} deg after a second, even at its quietest: mount it on something soft"
    if (speed := e.accel_noise or 0.0) > _ACCEL_NOISE_M_S:
        yield f"accelerometer noise is {speed:.2f} m/s after a second, even at its quietest: mount it on something soft"
    off = 0.0 if e.rate_hz is None or not e.rate_told_hz else abs(e.rate_hz / e.rate_told_hz - 1.0)
    if (period_s := 0.0 if e.rate_hz is None else 1.0 / e.rate_hz) > e.max_gap_s:
        yield (
            f"inertial samples come every {period_s:.2f} s and more than {e.max_gap_s:.2f} s is an outage: filter and "
            "graph went without them, and without the readings between them; state their rate in the IMU's sensor file "
            "(3 Hz at least), or raise --machine.max-gap-s"
        )
    elif off > _RATE_ERROR and not _misses_samples(e):
        yield f"inertial samples come at {e.rate_hz:.0f} Hz, stated were {e.rate_told_hz:.0f}: look for what loses them"
    if e.saturated:
        yield f"saturated: {', '.join(e.saturated)}; set a wider range in the sensor, or move more gently"
    if e.force_m_s2 is not None and _beyond(Moved(e.force_m_s2 - e.gravity_m_s2, 0.0), c.accel_bias_sigma_m_s2, 1, c):
        yield (
            f"the accelerometer reads {e.force_m_s2:.2f} m/s2 where gravity is {e.gravity_m_s2:.2f}: check its unit, "
            "then `vislam calibrate imu`"
        )


def _driven(e: Evidence, c: VerdictConfig) -> Iterator[str]:
    for one in e.driven:
        if one.delay is not None and _beyond(one.delay, _STAMP_SIGMA_S, 1, c):
            side = "late" if one.delay.by > 0.0 else "early"
            yield (
                f"the stamps of {one.name} are {abs(one.delay.by):.2f} ± {one.delay.sigma:.2f} s {side} against the "
                "IMU's: stamp readings when they are measured"
            )
        if one.turn is not None and one.turn.by < -1.0 - 4.0 * one.turn.sigma:
            yield f"{one.name} turn the other way than the gyroscope: swap left and right, or check the IMU's axes"
        elif one.turn is not None and _beyond(one.turn, max(_DRIVEN_SIGMA, one.slip), 1, c):
            yield f"{one.name} turn by {_percent(one.turn.by)} angles than the gyroscope: measure track and radii"
        for variable, (stated, sigma, moved) in one.own.items():
            if moved is not None and _beyond(moved, sigma, 1, c):
                yield f"{_own_words(one.name, variable, stated, moved)}: measure it, or state a larger sigma"


def _own_words(name: str, variable: str, stated: float, moved: Moved) -> str:
    return f"{variable} of {name} is {stated + moved.by:.3f} ± {moved.sigma:.3f}, stated was {stated:.3f}"


_TESTS: tuple[Callable[[Evidence, VerdictConfig], Iterator[str]], ...] = (
    _streams, _start, _vision, _calibration, _driven, _inertial, _filter, _graph,
)  # fmt: skip


def _moved(e: Evidence, c: VerdictConfig) -> Iterator[str]:
    """Report what was estimated significantly off, though no farther than its kind usually is: it was corrected."""
    if e.starts_taken_back:
        yield (
            f"{e.starts_taken_back} provisional starts did not survive the seconds after them and were taken back: "
            "poses published before then have another scale and vertical, and stepped"
        )
    if e.clock is not None and _beyond(e.clock, 0.0, 1, c) and not _beyond(e.clock, _CLOCK_SIGMA_S, 1, c):
        yield f"{_clock_words(e.clock)}; corrected, --init.time-offset-s {e.clock.by:.4f} sets it from the start"
    turn = e.rotation
    if turn is not None and _beyond(turn, 0.0, 3, c) and not _beyond(turn, c.rotation_sigma_deg, 3, c):
        yield f"the camera is turned by {turn.by:.2f} ± {turn.sigma:.2f} degrees against its file; corrected"
    for one in e.driven:
        for variable, (stated, sigma, moved) in one.own.items():
            if moved is not None and _beyond(moved, 0.0, 1, c) and not _beyond(moved, sigma, 1, c):
                yield f"{_own_words(one.name, variable, stated, moved)}; corrected"


def _beyond(moved: Moved, stated_sigma: float, degrees: int, config: VerdictConfig) -> bool:
    """Whether a number is farther off than its sigma and that of what was given explain."""
    if not math.isfinite(moved.by) or not math.isfinite(moved.sigma):
        return False
    variance = max(moved.sigma**2 + stated_sigma**2, 1e-24)
    return moved.by**2 / variance > chi_square_limit(config.probability, degrees)


def _clock_words(clock: Moved) -> str:
    side = "early" if clock.by > 0.0 else "late"
    return f"the camera's clock is {1e3 * abs(clock.by):.1f} ± {1e3 * clock.sigma:.1f} ms {side} against the IMU's"


def _percent(error: float) -> str:
    return f"{100.0 * abs(error):.1f} % {'larger' if error > 0.0 else 'smaller'}"
