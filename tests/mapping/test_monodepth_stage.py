"""Depth from one camera through the stage and into the map, on the simulated table."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from vislam.config import MapConfig, MonoDepthConfig
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.geometry import se3_exp
from vislam.core.messages import Frame, Keyframe, KeyframePacket, Observations, Tracking, VoMeasurement
from vislam.mapping.depth.mono import MonoDepth, SeenFrame
from vislam.mapping.mapper import Mapper
from vislam.mapping.octree.occupancy import Occupancy
from vislam.trajectory.odometry_keyframe import OdometryKeyframe
from worlds.table import camera, frame, pose

WIDTH = 320
T_BODY_CAM = se3_exp(np.array([0.3, -0.2, 1.1, 0.05, 0.02, -0.03]))
RIG = Rig((camera(WIDTH),), (T_BODY_CAM,))
CONFIG = replace(MonoDepthConfig(), enabled=True, scale=1.0, keyframes=3, sigma_px=0.5, threads=1)
NOTHING = Observations(np.zeros(0, np.int64), np.zeros((0, 2)))
EVERY = 10  # frames between keyframes


def _body(i):
    return pose(i) @ np.linalg.inv(T_BODY_CAM)


def _keyframe(n, begins_submap=False, drift=None):
    """The n-th keyframe with its image; on each way between two, odometry drifts by `drift`."""
    i = n * EVERY
    image = Frame(i * 50_000_000, i, (frame(i, WIDTH)[0],))
    keyframe = Keyframe(n, image.t_ns, image, np.zeros((0, 2)), np.zeros((0, 32), np.uint8), None)
    vo = VoMeasurement(image.t_ns, n, None, np.eye(6), False, Tracking.OK, 0)
    T = _body(0)
    for k in range(n):
        T = (
            T
            @ np.linalg.inv(_body(k * EVERY))
            @ _body((k + 1) * EVERY)
            @ se3_exp(np.zeros(6) if drift is None else drift)
        )
    return OdometryKeyframe(KeyframePacket(keyframe, vo, NOTHING, None, begins_submap=begins_submap), T)


def _between(n, drift=None):
    """Frames before the n-th keyframe; their odometry drifts evenly to `drift`."""
    start, seen = (n - 1) * EVERY, []
    for i in range(start + 2, n * EVERY, 2):
        T = np.linalg.inv(_body(start)) @ _body(i)
        if drift is not None:
            T = T @ se3_exp(drift * (i - start) / EVERY)
        seen.append(SeenFrame(i * 50_000_000, frame(i, WIDTH)[0], n - 1, T))
    return seen


DRIFT = (0.004, -0.003, 0.002, 0.01, -0.01, 0.005)


@cache
def _follow(drift=None):
    stage, late = MonoDepth(CONFIG, RIG), []
    drift = None if drift is None else np.array(drift)
    for n in range(4):
        keyframe = _keyframe(n, drift=drift)
        late.append(stage.add(keyframe, _body(n * EVERY), _between(n, drift) if n else []))
    return stage, late


def test_a_keyframe_gets_its_depth_when_it_has_been_followed_long_enough():
    stage, late = _follow()
    assert late[:3] == [None] * 3
    assert (late[3].keyframe_id, late[3].t_ns) == (0, 0)
    assert stage.reference_id == 3
    true = frame(0, WIDTH)[1]
    known = late[3].depth_m > 0.0
    assert known.mean() > 0.4
    assert np.median(np.abs(late[3].depth_m[known] / true[known] - 1.0)) < 0.005


def test_odometry_between_keyframes_is_bent_to_what_the_graph_found():
    _, straight = _follow()
    _, bent = _follow(DRIFT)
    both = (straight[3].depth_m > 0.0) & (bent[3].depth_m > 0.0)
    assert both.sum() > 0.9 * (straight[3].depth_m > 0.0).sum()
    assert np.median(np.abs(bent[3].depth_m[both] / straight[3].depth_m[both] - 1.0)) < 0.0005


def test_a_new_submap_of_trajectory_begins_anew_and_keeps_what_was_found():
    stage = MonoDepth(CONFIG, RIG)
    assert stage.add(_keyframe(0), _body(0), []) is None
    assert stage.add(_keyframe(1), _body(EVERY), _between(1)) is None
    stage.add(_keyframe(2, begins_submap=True), np.eye(4), _between(2))
    assert stage.reference_id == 2


def test_a_corrected_pose_reaches_the_depth_that_comes_late():
    stage = MonoDepth(CONFIG, RIG)
    shift = se3_exp(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    stage.add(_keyframe(0), _body(0), [])
    for n in (1, 2, 3):
        moved = np.array([shift @ _body(k * EVERY) for k in range(n + 1)])
        stage.move(np.arange(n + 1), moved)
        late = stage.add(_keyframe(n), moved[-1], _between(n))
    assert np.allclose(late.T_map_body, shift @ _body(0))


def test_late_depth_fills_the_map_like_any_other():
    _, late = _follow()
    mapper = Mapper(replace(MapConfig(), mono_depth=CONFIG), RIG, one_camera=True)
    mapper.add(_keyframe(0).packet.keyframe, _body(0))
    assert mapper.counters["keyframes_dense"] == 0
    mapper.add_depth(late[3])
    assert mapper.counters["keyframes_dense"] == 1
    on_table = np.array([[-0.6, y, 0.72] for y in np.linspace(-0.3, 0.3, 13)])
    states = mapper.occupancy.state_at(on_table)
    assert (states == Occupancy.OCCUPIED).mean() > 0.5
    assert len(mapper.cloud().points_m) > 1000
    with pytest.raises(DataError, match="in the map already"):
        mapper.add_depth(late[3])
    with pytest.raises(DataError, match="rigid"):
        mapper.add_depth(replace(late[3], keyframe_id=7, T_map_body=np.full((4, 4), np.nan)))
    with pytest.raises(DataError, match="depth"):
        mapper.add_depth(replace(late[3], keyframe_id=8, depth_m=late[3].depth_m[:50]))


def test_an_image_of_another_size_is_refused():
    stage = MonoDepth(CONFIG, RIG)
    wrong = _keyframe(0)
    image = replace(wrong.packet.keyframe.frame, images=(np.zeros((10, 10), np.uint8),))
    packet = replace(wrong.packet, keyframe=replace(wrong.packet.keyframe, frame=image))
    with pytest.raises(DataError, match="calibration"):
        stage.add(OdometryKeyframe(packet, np.eye(4)), np.eye(4), [])
