"""The noise of tracks is measured while running: on points of known noise, and on drawn images."""

from dataclasses import replace

import numpy as np
import pytest
from test_frontends import recording, run

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera
from vislam.core.messages import Frame, Observations, no_observations
from vislam.frontend import make_frontend
from vislam.frontend.pixel_noise import NoiseUsed, PixelNoise
from vislam.sim import open_points

UNIT = Camera(100, 100, 1.0, 1.0, 50.0, 50.0)  # a pixel is as long as a distance on z = 1
NOWHERE = np.zeros((200, 2))


def measured_px(rig: str, pixel_sigma_px: float, told_px: float = 1.0) -> float:
    points = open_points("handheld-room", seed=1, rig=rig, duration_s=8.0, pixel_sigma_px=pixel_sigma_px)
    front_end = make_frontend(FrontEndConfig(track_sigma_px=told_px), points.rig, 0)
    results = [front_end.track(event, None) for event in points.events() if isinstance(event, Frame)]
    assert results[0].sigma_px == told_px  # nothing seen yet
    return results[-1].sigma_px


@pytest.mark.parametrize("rig", ["mono", "stereo", "rgbd"])
@pytest.mark.parametrize("pixel_sigma_px", [0.2, 0.5, 1.0])
def test_the_noise_of_given_tracks_is_found_whatever_was_told(rig: str, pixel_sigma_px: float) -> None:
    assert measured_px(rig, pixel_sigma_px) == pytest.approx(pixel_sigma_px, rel=0.2)


@pytest.mark.parametrize("kind", ["mono", "stereo", "rgbd"])
def test_drawn_corners_scatter_little_and_more_in_noisier_images(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vislam.frontend.pixel_noise._USUAL_PX", 0.04)  # as if no image had ever been noisier
    world, frames, _ = recording(kind)
    rng = np.random.default_rng(3)

    def noisy(frame: Frame) -> Frame:
        grey = [np.clip(i + rng.normal(0.0, 12.0, i.shape), 0, 255).astype(np.uint8) for i in frame.images]
        return replace(frame, images=tuple(grey))

    clean, worse = run(kind, frames), run(kind, [noisy(f) for f in frames])
    assert 0.02 < clean[-1].sigma_px < 0.35
    assert worse[-1].sigma_px > 1.3 * clean[-1].sigma_px
    factors = [np.mean([result.observations.noise for result in results]) for results in (clean, worse)]
    print(f"{kind}: {factors[0]:.2f} and {factors[1]:.2f} times the noise told")
    assert factors[1] > 1.2 * factors[0]
    assert world is not None


def test_outliers_and_single_bad_frames_hardly_move_it() -> None:
    rng, noise = np.random.default_rng(5), PixelNoise(1.0)
    for frame in range(150):
        distances = rng.normal(0.0, 0.3, 200)
        distances[:20] = rng.uniform(-20.0, 20.0, 20)
        distances[30:40] = np.nan
        noise.learn(distances * (5.0 if frame % 30 == 7 else 1.0), UNIT, NOWHERE)
    assert noise.sigma_px == pytest.approx(0.3, rel=0.3)


def test_few_tracks_or_few_frames_leave_what_was_told() -> None:
    rng, noise = np.random.default_rng(5), PixelNoise(0.7)
    for _ in range(9):
        noise.learn(rng.normal(0.0, 0.2, 100), UNIT, NOWHERE[:100])
    for _ in range(50):
        noise.learn(rng.normal(0.0, 0.2, 20), UNIT, NOWHERE[:20])
    assert noise.sigma_px == 0.7 and not noise.is_learnt
    noise.learn(rng.normal(0.0, 0.2, 100), UNIT, NOWHERE[:100])
    assert noise.is_learnt and noise.sigma_px < 0.3


def test_a_frame_tells_its_own_noise_where_it_shows_enough_tracks() -> None:
    rng, noise = np.random.default_rng(6), PixelNoise(1.0)
    assert noise.frame_px == 1.0
    for _ in range(20):
        noise.learn(rng.normal(0.0, 0.3, 200), UNIT, NOWHERE)
    noise.learn(rng.normal(0.0, 1.2, 200), UNIT, NOWHERE)
    assert noise.frame_px == pytest.approx(1.2, rel=0.2) and noise.sigma_px < 0.4
    noise.learn(np.full(200, np.nan), UNIT, NOWHERE)
    assert noise.frame_px == noise.sigma_px


@pytest.mark.parametrize(("scatter_px", "over"), [(0.1, 1.0), (0.4, 1.0), (1.2, 3.0)])
def test_tracks_count_as_noisier_than_told_when_they_scatter_more_than_usual(scatter_px: float, over: float) -> None:
    rng, noise = np.random.default_rng(7), PixelNoise(1.0)
    assert noise.over_usual == 1.0  # nothing seen yet
    for _ in range(60):
        noise.learn(rng.normal(0.0, scatter_px, 200), UNIT, NOWHERE)
    learnt = noise.over_usual
    assert learnt == pytest.approx(over, rel=0.3)
    noise.learn(rng.normal(0.0, 4.0 * scatter_px, 200), UNIT, NOWHERE)
    assert noise.over_usual == pytest.approx(max(10.0 * scatter_px, 1.0), rel=0.2)  # a blurred frame says so itself
    noise.learn(rng.normal(0.0, scatter_px, 20), UNIT, NOWHERE[:20])
    assert noise.over_usual == pytest.approx(over, rel=0.3)


@pytest.mark.parametrize("rig", ["mono", "stereo", "rgbd"])
def test_given_tracks_count_as_told(rig: str) -> None:
    points = open_points("handheld-room", seed=1, rig=rig, duration_s=4.0, pixel_sigma_px=1.0)
    front_end = make_frontend(FrontEndConfig(), points.rig, 0)
    results = [front_end.track(event, None) for event in points.events() if isinstance(event, Frame)]
    assert results[-1].sigma_px > 0.7
    assert {result.observations.noise for result in results} == {1.0}


def test_what_was_used_is_told_beside_what_was_told() -> None:
    used = NoiseUsed()
    assert used.summary({"graph": 1.0}) == {}
    for noise in (1.0, 2.0, 3.0):
        used.add(0.5, Observations(np.arange(2), np.zeros((2, 2)), noise=noise))
    used.add(0.5, no_observations())
    used.add(float("nan"), Observations(np.arange(2), np.zeros((2, 2)), noise=9.0))
    assert used.summary({"graph": 1.5}) == {"measured_px": 0.5, "graph": {"told_px": 1.5, "used_px": 3.0}}
