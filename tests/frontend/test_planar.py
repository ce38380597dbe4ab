"""The planar front end on a drawn hall with exact truth, and everything in which it must not fail silently."""

import hashlib
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from vislam.config import FrontEndConfig, PlanarConfig
from vislam.core.camera import Rig
from vislam.core.errors import UsageError
from vislam.core.geometry import invert, se3_log
from vislam.core.messages import Array, Frame, Tracking
from vislam.frontend import TrackResult, make_frontend, mode_for
from vislam.frontend.planar.odometry import PlanarFrontEnd
from worlds.floor import FRAME_NS, HEIGHT_M, Drive, FloorWorld, rig

PLANAR = PlanarConfig(height_m=HEIGHT_M)
CONFIG = FrontEndConfig(mode="planar", planar=PLANAR, described_features=300)
KNOWN = 1e-3  # rad/s, of the gyro's bias


@dataclass(frozen=True)
class Driven:
    """What a front end made of a drive."""

    results: list[TrackResult]
    poses: Array  # where it thinks the cart was, from the true first pose on
    frontend: PlanarFrontEnd


@cache
def drawn(shake_deg: float = 0.0, seconds: float = 3.0, contrast: float = 45.0) -> tuple[Drive, tuple[Frame, ...]]:
    drive = Drive(seconds=seconds, shake_deg=shake_deg)
    return drive, tuple(FloorWorld(rig(), contrast).frames(drive))


def run(
    drive: Drive, frames: tuple[Frame, ...], config: FrontEndConfig = CONFIG, rig_: Rig | None = None,
    gyro: bool = True, bias_rad_s: Array | None = None,
) -> Driven:  # fmt: skip
    frontend = make_frontend(config, rig_ or rig(), seed=3)
    assert isinstance(frontend, PlanarFrontEnd)
    results, poses, key = [], [], drive.poses[0]
    for i, frame in enumerate(frames):
        span = drive.gyro(i, bias_rad_s) if gyro else None
        result = frontend.track(frame, span, KNOWN if gyro else np.inf)
        T = key if result.vo.T_keyframe_body is None else key @ result.vo.T_keyframe_body
        poses.append(T)
        if result.keyframe is not None:
            key = T
        results.append(result)
    return Driven(results, np.array(poses), frontend)


@cache
def usual() -> Driven:
    return run(*drawn())


def end_error(drive: Drive, driven: Driven) -> tuple[float, float]:
    """Error of the last pose over the way, and of its heading in degrees."""
    way = np.linalg.norm(np.diff(drive.poses[:, :3, 3], axis=0), axis=1).sum()
    off = se3_log(invert(drive.poses[-1]) @ driven.poses[-1])
    return float(np.linalg.norm(off[3:5]) / way), float(np.rad2deg(abs(off[2])))


def test_joint_odometry_is_good_to_a_few_thousandths() -> None:
    drive, frames = drawn()
    driven = usual()
    assert all(r.vo.tracking is Tracking.OK and r.vo.has_scale for r in driven.results)
    error, yaw_deg = end_error(drive, driven)
    assert error < 0.005 and yaw_deg < 0.2
    without = end_error(drive, run(drive, frames, gyro=False))
    assert without[0] < 0.01 and without[1] < 0.3
    split = run(drive, frames, replace(CONFIG, planar=replace(PLANAR, method="split")), gyro=False)
    error, yaw_deg = end_error(drive, split)
    assert error < 0.03 and yaw_deg < 1.5 and all(r.vo.T_keyframe_body is not None for r in split.results)


def test_covariances_cover_the_errors() -> None:
    drive, driven = drawn()[0], usual()
    key, squares = None, []
    for T, r in zip(drive.poses, driven.results, strict=True):
        if key is not None and r.vo.T_keyframe_body is not None:
            e = se3_log(invert(invert(key) @ T) @ r.vo.T_keyframe_body)
            squares.append(e @ np.linalg.solve(r.vo.covariance, e) / 6.0)
        if r.keyframe is not None:
            key = T
    assert 0.02 < np.median(squares) < 2.0 and np.mean(squares) < 2.0


def test_the_gyro_undoes_what_springs_do() -> None:
    drive, frames = drawn(shake_deg=0.3)
    by_gyro, alone = run(drive, frames), run(drive, frames, gyro=False)
    assert end_error(drive, by_gyro)[0] < 0.006
    stiff = replace(CONFIG, planar=replace(PLANAR, vibration_deg=0.001, vibration_known_deg=0.001))
    assert end_error(drive, run(drive, frames, stiff, gyro=False))[0] > end_error(drive, by_gyro)[0]
    assert end_error(drive, alone)[0] < 0.02


def test_a_wrong_tilt_corrects_itself() -> None:
    drive, frames = drawn()
    told = replace(CONFIG, planar=replace(PLANAR, tilt_deg=17.4, roll_deg=-0.4))
    driven = run(drive, frames, told)
    found = driven.frontend.calibration
    assert abs(found["tilt_deg"] - 18.0) < min(0.25, 3.0 * found["tilt_sigma_deg"]) and abs(found["roll_deg"]) < 0.2
    assert found["tilt_sigma_deg"] < 0.15 and found["height_m"] == HEIGHT_M
    assert end_error(drive, driven)[0] < 0.01
    stiff = {"tilt_sigma_deg": 1e-4, "tilt_walk_deg": 0.0, "vibration_deg": 1e-4, "vibration_known_deg": 1e-4}
    trusted = replace(told, planar=replace(told.planar, heave_m=1e-6, **stiff))
    assert end_error(drive, run(drive, frames, trusted))[0] > 0.02  # 0.7 deg are 3.5 % of scale


def test_height_is_pure_scale() -> None:
    drive, frames = drawn()
    low = run(drive, frames, replace(CONFIG, planar=replace(PLANAR, height_m=0.9 * HEIGHT_M)))
    ways = [np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum() for T in (low.poses, usual().poses)]
    assert ways[0] / ways[1] == pytest.approx(0.9, abs=0.01)


@pytest.mark.parametrize("contrast", [0.0, 1.5])
def test_a_floor_without_texture_is_lost_and_says_so(contrast: float) -> None:
    drive, frames = drawn(contrast=contrast, seconds=1.0)
    driven = run(drive, frames)
    assert all(r.vo.tracking is Tracking.LOST for r in driven.results)
    assert "texture" in driven.results[0].reason


def test_texture_that_ends_is_noticed_and_found_again() -> None:
    drive, frames = drawn()
    blank = [replace(f, images=(np.full_like(f.images[0], 110),)) if 30 <= f.index < 45 else f for f in frames]
    driven = run(drive, tuple(blank))
    lost = [r.vo.tracking is Tracking.LOST for r in driven.results]
    assert all(lost[30:45]) and not any(lost[:30]) and not any(lost[50:])
    assert all(r.reason for r, is_lost in zip(driven.results, lost, strict=True) if is_lost)


def test_a_gyro_that_contradicts_the_floor_is_noticed() -> None:
    drive, frames = drawn()
    driven = run(drive, frames, bias_rad_s=np.array([0.0, 0.0, 0.15]))
    lost = [r for r in driven.results if r.vo.tracking is Tracking.LOST]
    assert len(lost) > len(frames) // 3 and any("gyroscope" in r.reason for r in lost)


def test_something_that_moves_over_the_floor_is_left_out() -> None:
    drive, frames = drawn()
    rng = np.random.default_rng(4)
    cloth = rng.integers(20, 230, (60, 60), dtype=np.uint8).repeat(2, axis=0).repeat(2, axis=1)
    walked = []
    for f in frames:
        image = f.images[0].copy()
        left = 20 + 4 * f.index % 180
        image[110:230, left : left + 90] = cloth[:, :90]
        walked.append(replace(f, images=(image,)))
    driven = run(drive, tuple(walked))
    assert end_error(drive, driven)[0] < 0.02
    assert sum(r.vo.tracking is Tracking.LOST for r in driven.results) <= 3


def test_at_rest_it_stays() -> None:
    drive = Drive(seconds=2.0, speed_m_s=0.0, turn_rad_s=0.0)
    driven = run(drive, tuple(FloorWorld(rig()).frames(drive)))
    off = [se3_log(invert(drive.poses[0]) @ T) for T in driven.poses]
    assert np.abs(np.array(off)[:, 3:]).max() < 1e-3 and np.rad2deg(np.abs(np.array(off)[:, 2]).max()) < 0.05


def test_tracks_on_the_floor_bring_their_depth() -> None:
    drive, driven = drawn()[0], usual()
    T_body_cam, cam = rig().T_body_cams[0], rig().cameras[0]
    errors = []
    for T, r in zip(drive.poses, driven.results, strict=True):
        depth = r.observations.depth_m
        assert depth is not None and len(depth) == len(r.observations.track_ids)
        known = np.isfinite(depth)
        points = cam.unproject(r.observations.pixels_px[known]) * depth[known, None]
        errors.append((points @ (T @ T_body_cam)[:3, :3].T + (T @ T_body_cam)[:3, 3])[:, 2])
    heights = np.concatenate(errors)
    assert len(heights) > 1000 and np.quantile(np.abs(heights), 0.95) < 0.02  # they are where the floor is
    keyframes = [r.keyframe for r in driven.results if r.keyframe is not None][3:]
    with_points = [np.isfinite(k.points_body_m).all(axis=1).sum() for k in keyframes if k.points_body_m is not None]
    assert min(with_points) >= 12  # enough for a loop in metres


def test_two_runs_give_identical_bytes() -> None:
    def digest(driven: Driven) -> str:
        sha = hashlib.sha256()
        for r in driven.results:
            for part in (r.vo.T_keyframe_body, r.vo.covariance, r.observations.pixels_px):
                sha.update(b"-" if part is None else np.ascontiguousarray(part).tobytes())
        return sha.hexdigest()

    assert digest(usual()) == digest(run(*drawn()))


def test_it_goes_on_where_it_was() -> None:
    driven, frames = usual(), drawn()[1]
    learned = driven.frontend.learned
    again = PlanarFrontEnd(CONFIG, rig(), 3)
    again.begin_at(17, learned)
    first = again.track(frames[0], None)
    assert first.keyframe is not None and first.keyframe.id == 17
    assert again.calibration == pytest.approx(driven.frontend.calibration, rel=1e-3)
    assert first.observations.track_ids.min() >= learned.next_track_id


def test_a_known_height_chooses_it() -> None:
    one = rig()
    assert mode_for(FrontEndConfig(), one) == "mono" and mode_for(FrontEndConfig(planar=PLANAR), one) == "planar"
    with pytest.raises(UsageError, match=r"height"):
        make_frontend(FrontEndConfig(mode="planar"), one, 0)


def test_long_gaps_and_lost_frames_do_not_end_it() -> None:
    _, frames = drawn()
    gappy = [f for f in frames if not 20 <= f.index < 26]
    frontend = make_frontend(CONFIG, rig(), 3)
    results = [frontend.track(f, None) for f in gappy]
    assert results[-1].vo.T_keyframe_body is not None
    assert (gappy[20].t_ns - gappy[19].t_ns) // FRAME_NS == 7
