"""The camera's time offset from rotations: found from either side, its sigma honest, applied only when it counts."""

from dataclasses import replace
from itertools import takewhile

import numpy as np
import pytest

from vislam import open_dataset
from vislam.config import ImuConfig, InitConfig, MachineConfig, from_data
from vislam.core.clock import StageClock
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import Frame, VoMeasurement
from vislam.frontend.camera_clock import CameraClock
from vislam.frontend.time_offset import TimeOffset
from vislam.imu import ImuBuffer
from vislam.pipeline.front import Front, odometry
from worlds.motion import NS, T0_NS
from worlds.start import Start


def estimate(start: Start, config: InitConfig, motions: list[VoMeasurement] | None = None) -> TimeOffset:
    found = TimeOffset(config)
    for k, (vo, _, _) in enumerate(start.frames):
        found.add(vo.t_ns, vo if motions is None else motions[k])
        wanted = found.wanted_ns()
        if wanted is not None and k % 5 == 0:
            span = start.buffer.span(max(wanted[0], T0_NS), min(wanted[1], vo.t_ns + 5_000_000))
            assert span is not None
            found.solve(span)
    return found


@pytest.mark.parametrize("offset_s", [0.03, -0.03, 0.0])
def test_offset_comes_back_honestly(offset_s: float) -> None:
    errors, sigmas = [], []
    for seed in range(8):
        found = estimate(Start("moving", seed, offset_s=offset_s, duration_s=5.0), InitConfig()).estimate
        errors.append(found.offset_s - offset_s)
        sigmas.append(found.sigma_s)
    ratio = np.array(errors) / np.array(sigmas)
    print(f"errors {np.round(1e3 * np.array(errors), 2)} ms, sigmas {np.round(1e3 * np.array(sigmas), 2)} ms")
    assert np.sqrt(np.mean(np.square(errors))) < 2e-3
    assert 0.2 < np.sqrt(np.mean(ratio**2)) < 1.6
    assert np.abs(ratio).max() < 3.5


def test_misaligned_axes_come_back() -> None:
    start, turn = Start("moving", 3, duration_s=5.0), np.array([0.01, -0.006, 0.008])
    R = transform(so3_exp(turn), np.zeros(3))
    motions = [replace(vo, T_keyframe_body=R @ vo.T_keyframe_body @ R.T) for vo, _, _ in start.frames]
    found = estimate(start, InitConfig(), motions).estimate
    print(found.R_correction, found.R_correction_sigma)
    np.testing.assert_array_less(np.abs(found.R_correction - turn), 4.0 * found.R_correction_sigma)
    assert found.R_correction_sigma.max() < 0.01
    np.testing.assert_allclose(found.gyro_bias_rad_s, start.gyro_bias, atol=5e-3)


def test_without_turning_nothing_is_claimed() -> None:
    config = InitConfig()
    found = estimate(Start("uniform", 0, offset_s=0.02), config).estimate
    assert found.sigma_s > 0.8 * config.time_offset_sigma_s
    assert abs(found.offset_s) < config.time_offset_sigma_s


def test_a_hole_longer_than_what_is_looked_at_begins_again() -> None:
    start = Start("moving", 3, duration_s=5.0)
    found = estimate(start, InitConfig())
    last = start.frames[-1][0]
    found.add(last.t_ns + 12 * NS, replace(last, t_ns=last.t_ns + 12 * NS))
    assert found.wanted_ns() is None


def test_switched_off_nothing_is_estimated() -> None:
    found = estimate(Start("moving", 0, offset_s=0.02), InitConfig(time_offset=False, time_offset_s=0.004))
    assert found.estimate.offset_s == 0.004
    assert found.sigma_s == 0.0


def follow(start: Start, config: InitConfig, is_started: bool = False) -> tuple[CameraClock, list[int]]:
    """Let a clock see a whole start; inertial data come as they would, to just behind the frame."""
    clock, buffer, stamps = CameraClock(config), ImuBuffer(ImuConfig(), MachineConfig()), []
    samples = iter(start.samples)
    for k, (vo, _, _) in enumerate(start.frames):
        frame = clock.in_imu_time(Frame(vo.t_ns, k, ()))
        while buffer.newest_t_ns is None or buffer.newest_t_ns <= frame.t_ns:
            buffer.add(next(samples))
        stamps.append(frame.t_ns)
        clock.follow(replace(vo, t_ns=frame.t_ns), buffer, is_started)
    return clock, stamps


@pytest.mark.parametrize(("offset_s", "frame_ns"), [(0.03, 50_000_000), (-0.03, 50_000_000), (-0.03, 20_000_000)])
def test_time_advances_while_the_clock_is_corrected(offset_s: float, frame_ns: int) -> None:
    start = Start("moving", 6, offset_s=offset_s, frame_ns=frame_ns, duration_s=6.0)
    clock, stamps = follow(start, InitConfig())
    print(f"{offset_s}: applied {1e3 * clock.applied_s:.2f} ms in {clock.changes} steps")
    assert np.diff(stamps).min() > 0
    assert abs(clock.applied_s - offset_s) < 2e-3
    assert clock.changes > 0


def test_a_good_clock_is_left_alone() -> None:
    for seed in range(6):
        clock, stamps = follow(Start("moving", seed, duration_s=5.0), InitConfig())
        assert clock.changes == 0, seed
        assert stamps == [vo.t_ns for vo, _, _ in Start("moving", seed, duration_s=5.0).frames]


def test_tracks_that_err_alike_for_a_while_do_not_move_the_clock() -> None:
    """Rotations of a quarter of a second that look late, as where tracks slip together: one estimate is not enough."""
    changes = 0
    for seed in range(6):
        start, late = Start("moving", seed, duration_s=1.6), Start("moving", seed, duration_s=1.6, offset_s=-0.06)
        start.frames[20:26] = [
            (replace(right[0], T_keyframe_body=wrong[0].T_keyframe_body), *right[1:])
            for right, wrong in zip(start.frames[20:26], late.frames[20:26], strict=True)
        ]
        changes += follow(start, InitConfig())[0].changes
    assert changes == 0


@pytest.mark.data
@pytest.mark.parametrize(("mode", "offset_s"), [("mono", -0.03), ("stereo", 0.03)])
def test_a_real_camera_with_shifted_stamps(data_root, mode: str, offset_s: float) -> None:
    """Eight seconds of flight whose frames are stamped wrongly: the offset comes back, and so does time."""
    recording = open_dataset(str(data_root / "euroc_mh01_17s"))
    front = Front(from_data({"frontend": {"mode": mode}}, "test"), recording.rig, recording.imu_noise, StageClock())
    first_ns = next(iter(recording.events())).t_ns
    flown = takewhile(lambda value: value.t_ns - first_ns <= 8 * NS, recording.events())
    shifted = (replace(v, t_ns=v.t_ns - round(offset_s * NS)) if isinstance(v, Frame) else v for v in flown)
    stamps = [step.frame.t_ns for step in odometry(front, shifted)]
    found = front.camera_clock
    print(f"{mode}: {1e3 * found.applied_s:.2f} of {1e3 * offset_s:.0f} ms after {front.begun.settled}")
    assert np.diff(stamps).min() > 0
    assert front.begun.settled is not None
    # stereo sees this recording's own clock 1 ms off; mono, with another set of points, 0.3 ms
    assert abs(found.applied_s - offset_s) < 2e-3
    assert found.estimate.sigma_s < 1.5e-3


def with_drift(start: Start, drift: float) -> Start:
    """Stamp the frames of a start with a clock that runs too fast by this rate."""
    begin = start.frames[0][0].t_ns
    start.frames[:] = [
        (replace(vo, t_ns=begin + round((vo.t_ns - begin) * (1.0 + drift))), *rest) for vo, *rest in start.frames
    ]
    return start


@pytest.mark.parametrize("drift", [0.02, -0.02, 0.0])
def test_a_clock_of_its_own_is_followed(drift: float) -> None:
    """Delay and drift together: after 20 s the stamps would be off by 0.4 s."""
    for seed in range(3):
        start = with_drift(Start("moving", seed, offset_s=0.03, duration_s=20.0), drift)
        begin = start.frames[0][0].t_ns
        clock, stamps = follow(start, InitConfig(clock_drift=True))
        true_ns = [begin + (vo.t_ns - begin) / (1.0 + drift) + 0.03 * NS for vo, _, _ in start.frames[: len(stamps)]]
        off_ms = (np.array(stamps) - true_ns)[len(stamps) // 2 :] * 1e-6
        print(f"{drift}, seed {seed}: off by {np.abs(off_ms).max():.1f} ms, drift {clock.drift:.4f}")
        assert np.diff(stamps).min() > 0
        assert np.abs(off_ms).max() < 12.0 and np.sqrt(np.mean(off_ms**2)) < 6.0
        assert clock.drift == pytest.approx(-drift / (1.0 + drift), abs=max(4.0 * clock.drift_sigma, 1e-3))


def test_a_clock_that_is_the_host_s_has_no_drift() -> None:
    clock, _ = follow(Start("moving", 1, offset_s=0.03, duration_s=6.0), InitConfig())
    assert clock.drift == 0.0 and clock.drift_sigma == 0.0
