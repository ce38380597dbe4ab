"""The kernels against numbers: derivatives by differences, factorisation and covariance against numpy."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from vislam.config import WindowConfig
from vislam.core.messages import Array
from vislam.window.equations import inertial, schur, solver, visual
from vislam.window.equations.layout import (
    AXES,
    CALIBRATION,
    FOCAL,
    METRES,
    RIGHT,
    Camera,
    Links,
    Normal,
    States,
    Views,
    positions,
    retract,
)
from vislam.window.spans import LinkStore
from vislam.window.tracks import TrackTable
from worlds.motion import EUROC_NOISE, Motion
from worlds.parts import GRAVITY_M_S2, MACHINE
from worlds.room import RGBD, STEREO, World, ring, start_state, told_way


class Scene(NamedTuple):
    X: Array
    points: Array
    calibration: Array
    views: Views
    camera: Camera
    links: Links


def make_scene(rig, seed: int) -> Scene:
    """Five keyframes off the truth, everything on: rolling shutter, time offset, extrinsic rotation, right or depth."""
    world = World(Motion.random(seed), rig, seed, duration_s=1.2, tracks=12)
    packets, truths = world.packets()
    rng = np.random.default_rng(seed)
    config = WindowConfig()
    tracks, links = TrackTable(config, rig), LinkStore(config, EUROC_NOISE, MACHINE)
    X = []
    for packet, truth in zip(packets, truths, strict=True):
        state = start_state(truth, packet.keyframe.t_ns, rng)
        T = state.T_world_body
        X.append(
            np.concatenate(
                [T[:3, :3].ravel(), T[:3, 3], state.velocity_world_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2]
            )
        )
        tracks.add(packet.keyframe.id, packet.observations)
        if packet.imu is not None:
            told = [told_way(truths[1][0], truths[2][0], 0.01, 1.0, 0.02, rng)] if len(X) == 3 else []
            links.push(replace(packet, at_rest=len(X) == 3), 0.2, X[-2][15:] + 1e-3, np.eye(4), told)
    count = len(X)
    links.hear(np.array(X), np.zeros(count, dtype=np.bool_))
    camera = Camera(
        T_body_cam=rig.T_body_cams[0],
        T_cam0_cams=rig.T_cam0_cams,
        lenses=rig.lenses,
        right=1 if rig.is_stereo else -1,
        rate=rng.normal(size=(count, 3)),
        applied_offset_s=rng.normal(size=count) * 1e-3,
        active=np.ones(CALIBRATION, dtype=np.bool_),
        huber_k=np.full(len(rig.cameras) + 1, 1.5),
        rho_information=0.01,
    )
    selection = tracks.select(np.arange(count))
    calibration = np.array([0.008, 0.01, -0.02, 0.015, 0.012, 0.02, -0.03, 0.0, 0.0, 0.0, *[0.01] * 6])
    points = np.zeros((len(selection.slots), 3))
    visual.start(np.array(X), calibration, selection.views, camera, np.ones(len(points), dtype=np.bool_), 0.2, points)
    return Scene(np.array(X), points, calibration, selection.views, camera, links.arrays)


def normal_equations(scene: Scene) -> tuple[Array, Array]:
    count = len(scene.X)
    D = 15 * count + CALIBRATION
    A, g = np.zeros((D, D)), np.zeros(D)
    landmarks = schur.room_for(len(scene.points), 6 * count + CALIBRATION)
    held = np.zeros(count, dtype=np.bool_)
    visual.linearise(
        States(scene.X, scene.X, held), scene.points, scene.calibration, scene.views, scene.camera, 9 * count,
        Normal(A, g), landmarks,
    )  # fmt: skip
    return g, landmarks.gradients


def views_cost(scene: Scene, X: Array, points: Array, calibration: Array) -> float:
    squares = np.zeros((len(scene.views.values), 2))
    return visual.cost(X, points, calibration, scene.views, scene.camera, squares)


RIGS = {"stereo": STEREO, "rgbd": RGBD, "ring": ring(120.0, 240.0, pair=True)}


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)
@pytest.mark.parametrize("seed", [1, 2])
def test_gradient_of_views_is_that_of_their_cost(rig, seed: int) -> None:
    scene = make_scene(rig, seed)
    g, g_points = normal_equations(scene)
    where = positions(len(scene.X), True)
    step = 1e-6
    for k in range(len(scene.X)):
        for i in range(6):
            costs = []
            for sign in (1.0, -1.0):
                X, d = scene.X.copy(), np.zeros(15)
                d[i] = sign * step
                retract(X[k], d)
                costs.append(views_cost(scene, X, scene.points, scene.calibration))
            assert g[where[k, i]] == pytest.approx((costs[0] - costs[1]) / (2 * step), rel=1e-4, abs=1e-1)
    for p in (0, len(scene.points) // 2, len(scene.points) - 1):
        for i in range(3):
            points = np.repeat(scene.points[None], 2, axis=0)
            points[0, p, i] += step
            points[1, p, i] -= step
            costs = [views_cost(scene, scene.X, q, scene.calibration) for q in points]
            assert g_points[p, i] == pytest.approx((costs[0] - costs[1]) / (2 * step), rel=1e-4, abs=1e-1)
    for i in (0, 4, FOCAL, METRES, RIGHT, RIGHT + 1, RIGHT + 2):
        calibrations = np.repeat(scene.calibration[None], 2, axis=0)
        calibrations[0, i] += step
        calibrations[1, i] -= step
        costs = [views_cost(scene, scene.X, scene.points, c) for c in calibrations]
        assert g[-CALIBRATION + i] == pytest.approx((costs[0] - costs[1]) / (2 * step), rel=1e-3, abs=1.0)


@pytest.mark.parametrize("rig", [STEREO, ring(120.0)], ids=["stereo", "ring"])
def test_gradient_by_extrinsic_rotation(rig) -> None:
    scene = make_scene(rig, 3)
    scene.calibration[1:4] = 0.0  # where its tangent is its difference
    g, _ = normal_equations(scene)
    for i in range(1, 4):
        costs = []
        for sign in (1e-6, -1e-6):
            c = scene.calibration.copy()
            c[i] = sign
            costs.append(views_cost(scene, scene.X, scene.points, c))
        assert g[-CALIBRATION + i] == pytest.approx((costs[0] - costs[1]) / 2e-6, rel=1e-3, abs=1.0)


def test_gradient_of_links_is_that_of_their_cost() -> None:
    scene = make_scene(STEREO, 4)
    count = len(scene.X)
    D = 15 * count + CALIBRATION
    A, g = np.zeros((D, D)), np.zeros(D)
    where = positions(count, True)
    held = np.zeros(count, dtype=np.bool_)
    states = States(scene.X, scene.X, held)
    inertial.linearise(states, scene.calibration, scene.links, GRAVITY_M_S2, where, count - 1, count, Normal(A, g))
    for k in range(count):
        for i in range(15):
            step = 1e-6
            costs = []
            for sign in (1.0, -1.0):
                X, d = scene.X.copy(), np.zeros(15)
                d[i] = sign * step
                retract(X[k], d)
                costs.append(inertial.cost(X, scene.calibration, scene.links, GRAVITY_M_S2))
            assert g[where[k, i]] == pytest.approx((costs[0] - costs[1]) / (2 * step), rel=2e-3, abs=10.0), (k, i)
    for i in range(AXES, CALIBRATION):
        costs = []
        for sign in (1e-6, -1e-6):
            c = scene.calibration.copy()
            c[i] += sign
            costs.append(inertial.cost(scene.X, c, scene.links, GRAVITY_M_S2))
        assert g[-CALIBRATION + i] == pytest.approx((costs[0] - costs[1]) / 2e-6, rel=1e-3, abs=10.0), i


def test_factorisation_solution_and_covariance_agree_with_numpy() -> None:
    rng = np.random.default_rng(5)
    half = rng.normal(size=(40, 30))
    half[:, ::3] *= half[:, ::3] > 0.5  # some zeros to skip
    A = half.T @ half + 0.1 * np.eye(30)
    U = A.copy()
    assert solver.factorise(U)
    np.testing.assert_allclose(np.triu(U).T @ np.triu(U), A, atol=1e-10)
    b = rng.normal(size=30)
    np.testing.assert_allclose(solver.solve(U, b), np.linalg.solve(A, b), rtol=1e-8)
    inverse = np.linalg.inv(A)
    np.testing.assert_allclose(solver.trailing_covariance(U, 12), inverse[12:, 12:], rtol=1e-6, atol=1e-9)
    columns = np.array([3, 17])
    np.testing.assert_allclose(
        solver.joint_covariance(U, columns), inverse[np.ix_(columns, columns)], rtol=1e-6, atol=1e-9
    )
    A[4, 4] = -1.0
    assert not solver.factorise(A)


def test_landmarks_are_found_at_their_depth() -> None:
    world = World(Motion.random(6), STEREO, 6, duration_s=1.0, sigma_px=1e-3, tracks=30)
    packets, truths = world.packets()
    tracks = TrackTable(WindowConfig(), STEREO)
    for packet in packets:
        tracks.add(packet.keyframe.id, packet.observations)
    X = np.array([np.concatenate([T[:3, :3].ravel(), T[:3, 3], v, b]) for T, v, b in truths])
    selection = tracks.select(np.arange(len(X)))
    scene = make_scene(STEREO, 6)
    camera = scene.camera._replace(
        rate=np.zeros((len(X), 3)), applied_offset_s=np.zeros(len(X)), T_cam0_cams=scene.camera.T_cam0_cams
    )
    points = np.zeros((len(selection.slots), 3))
    visual.start(X, np.zeros(CALIBRATION), selection.views, camera, np.ones(len(points), dtype=np.bool_), 0.2, points)
    squares = np.zeros((len(selection.rows), 2))
    visual.cost(X, points, np.zeros(CALIBRATION), selection.views, camera, squares)
    assert np.sqrt(squares[:, 0]).max() < 0.02  # standard deviations of 1 px, so px
