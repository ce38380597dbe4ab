"""Bundle adjustment of simulated runs: nearer to the truth than their pose graphs, whatever is wrong with the data."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.batch import optimize_run
from vislam.config import BatchConfig, Config
from vislam.core import (
    FurtherTracks,
    ImuSpan,
    NavState,
    Observations,
    Rig,
    Tracking,
    VoMeasurement,
    invert,
    so3_exp,
    so3_log,
    transform,
    transform_points,
)
from vislam.core.errors import DataError
from vislam.trajectory.frames import LoggedFrames
from worlds.lap import position, rotation
from worlds.session import simulate

NO_VIBRATION = BatchConfig()  # the simulated IMU is as white as its model says
CONFIG = Config(batch=NO_VIBRATION)
QUICK = Config(batch=replace(NO_VIBRATION, rounds=3, covariances=False))


def changed(log, ids, change):
    keyframes = [replace(k, packet=change(k.packet)) if i in ids else k for i, k in enumerate(log.keyframes)]
    return replace(log, keyframes=keyframes)


def blind(packet):
    return replace(packet, observations=Observations(np.zeros(0, np.int64), np.zeros((0, 2))))


def lost(packet):
    vo = packet.vo
    return replace(
        blind(packet), vo=VoMeasurement(vo.t_ns, vo.keyframe_id, None, np.eye(6), vo.has_scale, Tracking.LOST, 0)
    )


@pytest.mark.parametrize(
    ("kind", "imu"), [("stereo", True), ("mono", True), ("rgbd", True), ("rgbd", False), ("stereo", False)]
)
def test_batch_is_nearer_to_the_truth_than_the_pose_graph(kind, imu):
    run = simulate(kind, imu=imu)
    result = optimize_run(run.log, CONFIG)
    graph_m, batch_m = run.rmse_m(run.run_poses), run.rmse_m(result.T_map_body)
    print(f"pose graph {graph_m:.4f} m, batch {batch_m:.4f} m")
    assert batch_m < 0.9 * graph_m
    assert batch_m < 0.025
    assert result.cost_after < result.cost_before
    assert result.sigma_px == pytest.approx(0.5, rel=0.15)
    assert result.readout_s == 0.0
    assert all(verdict.kept for verdict in result.loops)
    assert not result.tied_by_odometry
    assert not result.note
    assert all(np.isfinite(s.covariance[:6, :6]).all() for s in result.states)
    assert all(np.isfinite(s.velocity_world_m_s).all() == imu for s in result.states)


def test_tracks_of_a_camera_that_looks_back_count_as_well():
    run = simulate("mono", true_loops=0)
    log, rng = run.log, np.random.default_rng(11)
    camera, T_body_rear = log.rig.cameras[0], transform(so3_exp(np.array([0.0, 0.0, np.pi])), np.zeros(3))
    rig = Rig((camera, camera), (log.rig.T_body_cam0, T_body_rear @ log.rig.T_body_cam0))
    points = rng.uniform([-9, -9, -3], [9, 9, 3], (300, 3))

    def with_rear(packet, T_world_body):
        seen = transform_points(invert(T_world_body @ rig.T_body_cams[1]), points)
        pixels = camera.project(seen) + 0.5 * rng.normal(size=(len(points), 2))
        good = camera.contains(pixels) & (seen[:, 2] > 0.8)
        further = FurtherTracks(1, np.flatnonzero(good) + (1 << 40), pixels[good])
        return replace(packet, observations=replace(packet.observations, further=(further,)))

    pairs = zip(log.keyframes, run.truth, strict=True)
    keyframes = [replace(k, packet=with_rear(k.packet, T)) for k, T in pairs]
    alone, both = optimize_run(log, QUICK), optimize_run(replace(log, rig=rig, keyframes=keyframes), QUICK)
    alone_m, both_m = run.rmse_m(alone.T_map_body), run.rmse_m(both.T_map_body)
    print(f"seed 11: {alone_m:.4f} m with one camera, {both_m:.4f} m with two")
    assert both_m < 0.8 * alone_m
    assert both.observations > alone.observations


@pytest.mark.parametrize(("kind", "imu", "false_loops"), [("stereo", True, 6), ("mono", True, 0), ("rgbd", False, 6)])
def test_outlier_tracks_and_false_loops_change_little(kind, imu, false_loops):
    run = simulate(kind, imu=imu, outliers=0.1, false_loops=false_loops)
    result = optimize_run(run.log, CONFIG)
    graph_m, batch_m = run.rmse_m(run.run_poses), run.rmse_m(result.T_map_body)
    print(f"pose graph {graph_m:.4f} m, batch {batch_m:.4f} m, {result.rejected_observations} observations refused")
    assert batch_m < 0.9 * graph_m
    assert {v.id for v in result.loops if v.kept} == {v.id for v in result.loops} - run.false_ids
    share = result.rejected_observations / (result.rejected_observations + result.observations)
    assert 0.05 < share < 0.2
    assert result.sigma_px == pytest.approx(0.5, rel=0.2)


def test_a_false_loop_that_the_run_had_accepted_is_refused_and_named():
    run = simulate("stereo", duration_s=12.0, true_loops=0, false_loops=1)
    edges = [replace(edge, accepted=True) for edge in run.log.edges]
    result = optimize_run(replace(run.log, edges=edges), QUICK)
    (verdict,) = result.loops
    assert verdict.in_run
    assert not verdict.kept
    assert "undecided" in verdict.reason
    assert "undecided" in result.note


@pytest.mark.parametrize("true_loops", [1, 2])
def test_few_true_loops_are_kept(true_loops):
    run = simulate("stereo", true_loops=true_loops, false_loops=0)
    result = optimize_run(run.log, QUICK)
    assert [verdict.kept for verdict in result.loops] == [True] * true_loops


def test_a_loop_that_cannot_be_used_is_refused_with_its_reason():
    run = simulate("rgbd", imu=False)
    edge = run.log.edges[0]
    broken = replace(edge, edge=replace(edge.edge, covariance=np.full((6, 6), np.nan)))
    result = optimize_run(replace(run.log, edges=[broken, *run.log.edges[1:]]), QUICK)
    assert "NaN" in result.loops[0].reason
    assert sum(v.kept for v in result.loops) == len(run.log.edges) - 1


def test_a_rolling_shutter_is_found_and_undone():
    run = simulate("rgbd", imu=False, readout_s=0.03, duration_s=12.0, true_loops=0)
    result = optimize_run(run.log, CONFIG)
    assert result.readout_s == pytest.approx(0.03, abs=0.003)
    known = replace(CONFIG.frontend, readout_s=0.0)
    ignored = optimize_run(run.log, replace(CONFIG, frontend=known))
    assert ignored.readout_s == 0.0
    print("rmse", run.rmse_m(result.T_map_body), run.rmse_m(ignored.T_map_body), result.sigma_px, ignored.sigma_px)
    assert run.rmse_m(result.T_map_body) < 0.5 * run.rmse_m(ignored.T_map_body)
    assert result.sigma_px < ignored.sigma_px


def test_the_same_log_gives_the_same_bits():
    log = simulate("stereo", duration_s=6.0, outliers=0.1, true_loops=0).log
    first, second = optimize_run(log, CONFIG), optimize_run(log, CONFIG)
    assert np.array_equal(first.T_map_body, second.T_map_body)
    assert all(np.array_equal(a.covariance, b.covariance) for a, b in zip(first.states, second.states, strict=True))


def test_covariances_tell_the_error():
    """Position and orientation relative to the start, three runs: normalised squared error near one per dimension."""
    honest = replace(
        CONFIG, batch=BatchConfig(vision_inflation=1.0), graph=replace(CONFIG.graph)
    )  # noise of the world as it is
    ratios = []
    for seed in range(3):
        run = simulate("stereo", duration_s=10.0, true_loops=0, seed=20 + seed)
        for k, state in enumerate(optimize_run(run.log, honest).states[8::8], start=1):
            R, truth = state.T_world_body[:3, :3], run.truth[8 * k]
            error = np.concatenate([so3_log(R.T @ truth[:3, :3]), truth[:3, 3] - state.T_world_body[:3, 3]])
            ratios.append(error @ np.linalg.solve(state.covariance[:6, :6], error) / 6.0)
    print("NEES per dimension", np.mean(ratios))
    assert 0.4 < np.mean(ratios) < 2.0


def test_gaps_in_vision_and_imu_are_bridged():
    run = simulate("stereo", duration_s=10.0, true_loops=0)
    log = changed(run.log, {12, 13}, lost)
    log = changed(log, {25}, lambda packet: replace(packet, imu=None))
    result = optimize_run(log, QUICK)
    assert set(result.tied_by_odometry) == {12, 13}
    assert run.rmse_m(result.T_map_body) < 0.03


def test_a_gap_without_imu_keeps_the_chain():
    run = simulate("rgbd", imu=False, duration_s=10.0, true_loops=0)
    result = optimize_run(changed(run.log, {20}, lost), QUICK)
    assert result.tied_by_odometry == [20]
    after = [invert(run.truth[22]) @ run.truth[35], invert(result.T_map_body[22]) @ result.T_map_body[35]]
    assert np.linalg.norm(after[0][:3, 3] - after[1][:3, 3]) < 0.03


def test_loops_of_a_run_whose_submap_is_tied_by_habit_are_judged():
    run = simulate("stereo", imu=False)

    def begins(packet):
        habit = replace(packet.vo, covariance=0.01 * np.eye(6), tracking=Tracking.LOST)
        return replace(packet, begins_submap=True, vo=habit)

    result = optimize_run(changed(run.log, {len(run.log.keyframes) // 2}, begins), QUICK)
    assert [verdict.kept for verdict in result.loops] == [True] * len(run.log.edges)


def test_without_any_track_the_pose_graph_remains():
    run = simulate("stereo", duration_s=8.0, true_loops=0)
    result = optimize_run(changed(run.log, range(len(run.log.keyframes)), blind), QUICK)
    assert result.landmarks == 0
    assert len(result.tied_by_odometry) == len(run.log.keyframes) - 1
    assert np.abs(result.T_map_body - run.run_poses).max() < 0.005


def test_one_keyframe_stays_where_it_is():
    run = simulate("rgbd", duration_s=2.0, true_loops=0)
    result = optimize_run(replace(run.log, keyframes=run.log.keyframes[:1]), QUICK)
    assert np.allclose(result.T_map_body[0], run.log.first_state.T_world_body, atol=1e-9)


def test_logs_that_cannot_be_used_are_data_errors():
    log = simulate("stereo", duration_s=2.0, true_loops=0).log
    with pytest.raises(DataError, match="no keyframe"):
        optimize_run(replace(log, keyframes=[]), QUICK)
    bent = replace(log.keyframes[3], T_map_body=np.full((4, 4), np.nan))
    with pytest.raises(DataError, match="keyframe 3"):
        optimize_run(replace(log, keyframes=[*log.keyframes[:3], bent]), QUICK)
    with pytest.raises(DataError, match="ids must be dense"):
        optimize_run(replace(log, keyframes=[log.keyframes[0], log.keyframes[2]]), QUICK)
    one_camera = simulate("mono", duration_s=2.0, true_loops=0).log
    with pytest.raises(DataError, match="scale"):
        optimize_run(replace(one_camera, noise=None, first_state=None), QUICK)


def test_frames_between_keyframes_follow_the_imu():
    run = simulate("stereo", duration_s=8.0, true_loops=0)
    world, log = run.world, run.log
    t_ns = (np.arange(160) * 50_000_000).astype(np.int64)
    at_imu = np.searchsorted(world.imu_t_ns, [p.packet.keyframe.t_ns for p in log.keyframes])
    biases = zip(world.true_gyro_bias[at_imu], world.true_accel_bias[at_imu], strict=True)
    states = [
        NavState(world.t_ns(k), run.truth[k], world.velocity[k], gyro, accel, np.eye(15))
        for k, (gyro, accel) in enumerate(biases)
    ]
    R, p = rotation(t_ns * 1e-9).as_matrix(), position(t_ns * 1e-9, world.scale_m)
    frames = LoggedFrames(t_ns, np.minimum(t_ns // 250_000_000, len(states) - 1), [None] * len(t_ns))

    def worst(log):
        spans = {k.packet.keyframe.id: k.packet.imu for k in log.keyframes if k.packet.imu is not None}
        carried = frames.carried_by_imu(states, spans, log.gravity_m_s2, 0.1)
        placed = carried.placed(
            {k: state.t_ns for k, state in enumerate(states)},
            {k: state.T_world_body for k, state in enumerate(states)},
        )
        assert np.array_equal(placed.t_ns, t_ns)
        turned = [so3_log(a.T @ b) for a, b in zip(placed.T_world_body[:, :3, :3], R, strict=True)]
        return np.linalg.norm(placed.positions_m - p, axis=1).max(), np.linalg.norm(turned, axis=1).max()

    with_imu = worst(log)
    interpolated = worst(changed(log, range(len(states)), lambda packet: replace(packet, imu=None)))
    print("worst m and rad by the IMU", with_imu, "interpolated", interpolated)
    assert with_imu[0] < 0.0005
    assert with_imu[1] < 0.0005
    assert interpolated[0] > 5 * with_imu[0]
    holed = changed(log, {10}, lambda packet: replace(packet, imu=_without_middle(packet.imu)))
    assert with_imu[0] < worst(holed)[0] < 1.5 * interpolated[0]
    rng = np.random.default_rng(5)
    between = (t_ns % 250_000_000 != 0) & (t_ns < states[-1].t_ns)
    turns = [so3_exp(0.01 * noisy * rng.standard_normal(3)) for noisy in between]
    poses = zip(frames.keyframe_ids.tolist(), R, p, turns, strict=True)
    seen = [invert(run.truth[k]) @ transform(turned @ turn, at) for k, turned, at, turn in poses]
    frames = replace(frames, T_keyframe_body=seen)
    by_vision = worst(log)
    print("orientation by the gyroscope, places by vision", by_vision)
    assert by_vision[0] < 1e-9 and by_vision[1] < 0.02 * 0.03  # of the scatter of vision


def _without_middle(span):
    keep = np.abs(np.arange(len(span.t_ns)) - len(span.t_ns) / 2) > 12
    return ImuSpan(span.t_ns[keep], span.gyro_rad_s[keep], span.accel_m_s2[keep])


def with_cameras(log, focal, metres, focal_sigma, metres_sigma):
    """The log of a run whose calibration gives a multiple of the true focal length and baseline."""
    sigmas = replace(log.rig.cameras[0].sigmas, focal=focal_sigma, metres=metres_sigma)
    cameras = tuple(replace(camera.with_focal(focal), sigmas=sigmas) for camera in log.rig.cameras)
    first, *others = log.rig.T_body_cams
    apart = [invert(first) @ T for T in others]
    T_body_cams = (first, *(first @ transform(T[:3, :3], metres * T[:3, 3]) for T in apart))
    return replace(log, rig=replace(log.rig, cameras=cameras, T_body_cams=T_body_cams))


@pytest.mark.parametrize(("kind", "focal", "metres"), [("mono", 0.99, 1.0), ("stereo", 1.01, 0.98)])
def test_what_a_calibration_is_off_by_is_found(kind, focal, metres):
    run = simulate(kind, true_loops=0)
    exact = optimize_run(with_cameras(run.log, focal, metres, 0.0, 0.0), CONFIG)
    found = optimize_run(with_cameras(run.log, focal, metres, 0.01, 0.02), CONFIG)
    wrong_m, right_m = run.rmse_m(exact.T_map_body), run.rmse_m(found.T_map_body)
    print(f"{wrong_m:.4f} m, {right_m:.4f} m", found.calibration)
    assert right_m < 0.6 * wrong_m
    errors, sigmas = found.calibration
    assert np.all(np.abs(np.array([1.0 / focal, 1.0 / metres]) - 1.0 - errors) < 3.0 * sigmas + 1e-9)
    assert np.array_equal(exact.calibration, np.zeros((2, 2)))


def test_without_an_imu_the_unit_of_metres_stays_in_doubt():
    run = simulate("rgbd", imu=False, true_loops=0)
    sure, unsure = (optimize_run(with_cameras(run.log, 1.0, 1.0, 0.0, sigma), CONFIG) for sigma in (0.0, 0.01))
    assert np.allclose(unsure.calibration, [[0.0, 0.0], [0.0, 0.01]])
    way = unsure.T_map_body[-1, :3, 3] - unsure.T_map_body[0, :3, 3]
    added = (unsure.states[-1].covariance - sure.states[-1].covariance)[3:6, 3:6]
    assert np.allclose(added, np.outer(way, way) * 1e-4, atol=0.05 * way @ way * 1e-4)
