"""Steps of exposure: the tracks go on, and where nothing steps nothing changes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_frontends import motions, recording, run, usual

from vislam.config import FrontEndConfig
from vislam.core.geometry import invert, se3_log
from vislam.core.messages import Frame, ImageU8, Tracking
from vislam.datasets import open_dataset
from vislam.frontend import make_frontend
from vislam.vision.brightness import matched

_STEPS = (1.0, 0.4, 1.6, 0.7)  # factors of exposure, one after the other
_PLACES = np.stack(np.meshgrid(np.arange(20.0, 300.0, 15.0), np.arange(20.0, 220.0, 15.0)), axis=-1).reshape(-1, 2)


def exposed(image: ImageU8, gain: float, offset: float = 0.0) -> ImageU8:
    return np.clip(np.rint(image * gain + offset), 0, 255).astype(np.uint8)


def stepped(frame: Frame, gain: float) -> Frame:
    return replace(frame, images=tuple(exposed(image, gain) for image in frame.images))


@pytest.mark.parametrize("kind", ["mono", "stereo", "rgbd"])
def test_steps_of_exposure_do_not_lose_tracks(kind: str) -> None:
    _, frames, poses = recording(kind)
    changing = [stepped(f, _STEPS[f.index // 6 % 4]) for f in frames]
    results = run(kind, changing)
    assert all(r.vo.tracking is Tracking.OK for r in results)
    assert min(r.vo.inliers for r in results) > 0.5 * min(r.vo.inliers for r in usual(kind))
    errors = [se3_log(invert(true) @ T) for true, T, r in motions(results, changing, poses)]
    assert np.rad2deg(max(np.linalg.norm(e[:3]) for e in errors)) < 0.4
    if kind != "mono":
        assert max(np.linalg.norm(e[3:]) for e in errors) < 0.012


def test_a_right_camera_with_an_exposure_of_its_own_still_gives_depth() -> None:
    _, frames, _ = recording("stereo")
    uneven = [replace(f, images=(f.images[0], exposed(f.images[1], 0.5))) for f in frames[:3]]
    plain, first = usual("stereo")[0].observations, run("stereo", uneven)[0].observations
    assert plain.depth_m is not None and first.depth_m is not None
    assert np.isfinite(first.depth_m).mean() > 0.9 * np.isfinite(plain.depth_m).mean()


@given(gain=st.floats(0.3, 1.5), offset=st.floats(-15.0, 30.0), off_px=st.floats(-4.0, 4.0))
def test_an_image_is_made_as_bright_as_another(gain: float, offset: float, off_px: float) -> None:
    """Patches need not be where they are expected to the pixel; a third more or less is left as it is."""
    image = np.clip(recording("mono")[1][0].images[0], 40, 150)
    other = exposed(image, gain, offset)
    alike = matched(image, other, _PLACES, _PLACES + off_px, 21)
    difference = np.abs(alike.astype(float) - other).mean()
    assert difference < (0.35 if alike is image else 0.12) * np.median(other) + 1.0


@given(gain=st.floats(0.93, 1.07), off_px=st.floats(-3.0, 3.0))
def test_images_that_are_about_alike_are_left_alone(gain: float, off_px: float) -> None:
    image = recording("mono")[1][0].images[0]
    assert matched(image, exposed(image, gain), _PLACES, _PLACES + off_px, 21) is image


def test_clipped_dark_and_unexpected_patches_tell_nothing() -> None:
    image = recording("mono")[1][0].images[0]
    assert matched(image, np.zeros_like(image), _PLACES, _PLACES, 21) is image
    assert matched(image, np.full_like(image, 255), _PLACES, _PLACES, 21) is image
    assert matched(image, exposed(image, 0.5), _PLACES, np.full_like(_PLACES, np.nan), 21) is image
    assert matched(image, exposed(image, 0.5), _PLACES[:0], _PLACES[:0], 21) is image
    half = exposed(image, 1.7)  # about half of it clips: what does not still tells the factor
    assert (half == 255).mean() > 0.2
    alike = matched(image, half, _PLACES, _PLACES, 21)
    assert np.median(np.abs(alike[half < 255].astype(float) - half[half < 255])) < 8.0


@pytest.mark.data
@pytest.mark.parametrize("name", ["euroc:euroc_mh01_17s", "tum:tum_fr1_desk"])
def test_real_recordings_go_on_through_steps_of_exposure(data_root: Path, name: str) -> None:
    kind, folder = name.split(":")
    real = open_dataset(f"{kind}:{data_root / folder}")
    front_end = make_frontend(FrontEndConfig(described_features=100), real.rig, seed=0)
    lost, begun_ns = 0, None
    for frame in (e for e in real.events() if isinstance(e, Frame)):
        begun_ns = frame.t_ns if begun_ns is None else begun_ns
        seconds = (frame.t_ns - begun_ns) * 1e-9
        if seconds > 6.0:
            break
        result = front_end.track(stepped(frame, _STEPS[int(seconds / 1.5) % 4]), None)
        lost += result.vo.tracking is Tracking.LOST and "no depth has" not in result.reason
    assert lost == 0
