"""Rest and motion in images, with noisy pixels: slow motion of every kind is seen, noise and wrong tracks are not."""

from collections.abc import Callable

import numpy as np
import pytest

from vislam.core.camera import Camera
from vislam.core.geometry import so3_exp, transform, transform_points
from vislam.core.messages import Array, Observations
from vislam.frontend.stillness import Stillness

CAMERA = Camera(752, 480, 458.0, 457.0, 367.0, 248.0)
FRAME_NS = 50_000_000
MOTIONS: dict[str, Callable[[float], Array]] = {
    "sideways": lambda t: transform(np.eye(3), np.array([0.05 * t, 0.0, 0.0])),
    "forward": lambda t: transform(np.eye(3), np.array([0.0, 0.0, 0.12 * t])),
    "pan": lambda t: transform(so3_exp(np.array([0.0, 0.01 * t, 0.0])), np.zeros(3)),
    "roll": lambda t: transform(so3_exp(np.array([0.0, 0.0, 0.03 * t])), np.zeros(3)),
    "orbit": lambda t: transform(so3_exp(np.array([0.0, -0.15 * t / 3.0, 0.0])), np.array([0.15 * t, 0.0, 0.0])),
    "shake": lambda t: transform(so3_exp(np.array([0.01 * np.sin(40.0 * t), 0.0, 0.0])), np.zeros(3)),
}


def film(
    path: Callable[[float], Array],
    seconds: float,
    sigma_px: float,
    seed: int,
    points: int = 150,
    slipped: float = 0.04,
    frame_ns: int = FRAME_NS,
) -> list[tuple[int, Observations]]:
    """Return what a tracker gives along a path: white noise, jumps of a frame, slips, misses."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([20.0, 20.0], [730.0, 460.0], (points, 2))
    xyz = CAMERA.unproject(pixels) * rng.uniform(1.5, 8.0, points)[:, None]
    slip_at = np.where(rng.random(points) < slipped, rng.uniform(0.0, seconds, points), np.inf)
    slip_by = rng.uniform(-40.0, 40.0, (points, 2))
    frames = []
    for k in range(int(seconds * 1e9 / frame_ns)):
        t_s = k * frame_ns * 1e-9
        seen = CAMERA.project(transform_points(np.linalg.inv(path(t_s)), xyz)) + rng.normal(0.0, sigma_px, (points, 2))
        seen[t_s > slip_at] += slip_by[t_s > slip_at]
        jumps = rng.random(points) < 0.015
        seen[jumps] += rng.uniform(-60.0, 60.0, (int(jumps.sum()), 2))
        kept = rng.random(points) > 0.02
        frames.append((7_000_000_000 + k * frame_ns, Observations(np.flatnonzero(kept), seen[kept])))
    return frames


def answers(frames: list[tuple[int, Observations]]) -> list[bool]:
    """Return what `Stillness` says at every frame."""
    stillness = Stillness()
    return [stillness.add(*frame) for frame in frames]


@pytest.mark.parametrize("sigma_px", [0.05, 0.3, 1.0, 1.5])
@pytest.mark.parametrize("frame_ns", [FRAME_NS, 2 * FRAME_NS, FRAME_NS // 3])
def test_rest_is_seen_through_noise(sigma_px: float, frame_ns: int) -> None:
    said = answers(film(lambda t: np.eye(4), 4.0, sigma_px, 11, frame_ns=frame_ns))
    assert not any(said[:2])
    assert np.mean(said[2:]) > 0.97


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("sigma_px", [0.05, 1.0])
def test_slow_motion_is_no_rest(name: str, sigma_px: float) -> None:
    said = answers(film(MOTIONS[name], 4.0, sigma_px, 12))
    assert np.mean(said[11:]) < (0.02 if name != "shake" else 0.2), f"{np.mean(said[11:]):.3f}"


@pytest.mark.parametrize("sigma_px", [0.05, 1.0])
def test_motion_after_rest_is_seen_within_a_third_of_a_second(sigma_px: float) -> None:
    def start(t: float) -> Array:
        return transform(np.eye(3), np.array([0.25 * max(t - 2.0, 0.0) ** 2, 0.0, 0.0]))

    said = answers(film(start, 3.0, sigma_px, 13))
    assert np.mean(said[2:40]) > 0.97
    assert not any(said[47:])


def test_rest_after_motion_is_seen_within_the_window() -> None:
    def stop(t: float) -> Array:
        return transform(np.eye(3), np.array([0.3 * min(t - 2.0, 0.0), 0.0, 0.0]))

    said = answers(film(stop, 4.0, 1.0, 14))
    assert not any(said[11:40])
    assert np.mean(said[52:]) > 0.97


def test_motion_that_cannot_be_told_is_no_rest() -> None:
    few = film(lambda t: np.eye(4), 1.0, 0.3, 15, points=9)
    assert not any(answers(few))
    frames = film(lambda t: np.eye(4), 1.0, 0.3, 16)
    renamed = [(t, Observations(seen.track_ids + 1000 * k, seen.pixels_px)) for k, (t, seen) in enumerate(frames)]
    assert not any(answers(renamed))
    assert not any(answers([(t, Observations(seen.track_ids[:0], seen.pixels_px[:0])) for t, seen in frames]))
    late = [(t + (3_000_000_000 if k >= 10 else 0), seen) for k, (t, seen) in enumerate(frames)]
    assert answers(late)[9:13] == [True, False, False, True]


def resting(frames: list[tuple[int, Observations]]) -> list[bool]:
    """Return whether `Stillness` sees a rest go on, at every frame."""
    stillness, said = Stillness(), []
    for frame in frames:
        stillness.add(*frame)
        said.append(stillness.resting)
    return said


@pytest.mark.parametrize("sigma_px", [0.3, 1.0])
def test_a_long_rest_is_not_interrupted(sigma_px: float) -> None:
    """Few tracks, many of which slip onto other corners on the way."""
    frames = film(lambda t: np.eye(4), 30.0, sigma_px, 18, points=70, slipped=0.3, frame_ns=2 * FRAME_NS)
    assert all(resting(frames)[2:])


@pytest.mark.parametrize("sigma_px", [0.3, 1.0])
def test_a_creep_too_slow_for_the_window_ends_the_rest(sigma_px: float) -> None:
    frames = film(lambda t: transform(np.eye(3), np.array([0.004 * max(t - 2.0, 0.0), 0.0, 0.0])), 6.0, sigma_px, 19)
    assert np.mean(answers(frames)[40:]) > 0.97, "no longer too slow for the window; take a slower one"
    said = resting(frames)
    assert all(said[2:40])
    assert not all(said[40:])
    left = 40 + said[40:].index(False)
    assert not any(said[left : left + 10])


def test_a_slow_start_ends_the_rest_no_later_than_a_centimetre_away() -> None:
    frames = film(lambda t: transform(np.eye(3), np.array([0.025 * max(t - 2.0, 0.0) ** 2, 0.0, 0.0])), 5.0, 1.0, 20)
    said = resting(frames)
    assert all(said[2:40])
    assert not any(said[53:])  # 0.65 s: 1.06 cm


def test_numbers_behind_the_answer() -> None:
    stillness = Stillness()
    for frame in film(lambda t: transform(np.eye(3), np.array([0.0, 0.1 * t, 0.0])), 1.0, 0.7, 17):
        stillness.add(*frame)
    assert 0.6 < stillness.noise_px < 0.8
    assert 4.0 < stillness.moved_px < 8.0  # 0.05 m at 1.5 to 8 m
    assert stillness.parallax_px > 1.0
