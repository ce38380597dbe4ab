import cv2
import numpy as np
import pytest

from vislam.sim import WORLD_NAMES
from vislam.sim.scene.render import Renderer
from vislam.sim.worlds.table import WORLDS
from worlds.recordings import frame_seconds

LIMITS = {  # speed m/s, acceleration m/s2, rate rad/s, length m, seconds, rest at the start s
    "workshop-cart": (1.2, 2.0, 1.4, (50.0, 60.0), (60.0, 80.0), 2.0),
    "cart-drive": (1.0, 2.0, 1.5, (100.0, 115.0), (150.0, 180.0), 3.0),
    "handheld-room": (1.0, 4.0, 1.5, (8.0, 16.0), (30.0, 40.0), 1.5),
    "corridor-loop": (1.6, 4.0, 2.0, (65.0, 85.0), (50.0, 75.0), 2.0),
    "aliased-halls": (1.6, 4.0, 2.0, (62.0, 72.0), (58.0, 66.0), 2.0),
}


def test_every_world_has_a_description():
    assert set(WORLD_NAMES) == set(WORLDS) == set(LIMITS)
    assert all(20 < len(world.description) < 120 and "\n" not in world.description for world in WORLDS.values())


@pytest.mark.parametrize("name", WORLD_NAMES)
@pytest.mark.parametrize("seed", [0, 1])
def test_motion_is_plausible_and_starts_at_rest(painted, name, seed):
    world = painted(name, seed=seed)
    speed, acceleration, rate, length, seconds, rest = LIMITS[name]
    t = np.arange(0.0, world.duration_s, 0.005)
    motion = world.spline.at(t)
    speeds = np.linalg.norm(motion.velocity_world_m_s, axis=1)
    assert speeds.max() < speed
    assert np.linalg.norm(motion.acceleration_world_m_s2, axis=1).max() < acceleration
    assert np.linalg.norm(motion.rate_body_rad_s, axis=1).max() < rate
    assert length[0] < np.trapezoid(speeds, t) < length[1]
    assert seconds[0] < world.duration_s < seconds[1]
    assert speeds[t <= rest].max() < 1e-9
    assert np.abs(motion.rate_body_rad_s[t <= rest]).max() < 1e-9


@pytest.mark.parametrize("name", WORLD_NAMES)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_camera_never_touches_anything(painted, name, seed):
    world = painted(name, seed=seed)
    bodies = world.dense_truth().T_world_body[::4]
    for T_body_cam in world.rig.T_body_cams:
        places = (bodies @ T_body_cam)[:, :3, 3]
        assert world.scene.clearance_m(places).min() > 0.3


def test_clearance_measures_distances(painted):
    scene = painted("handheld-room").scene
    clearance = scene.clearance_m(np.array([[0.0, 0.0, 1.3], [0.0, 0.0, 0.02], [0.5, 0.3, 2.55]]))
    assert clearance[0] > 1.0
    assert clearance[1] == pytest.approx(0.02, abs=1e-6)
    assert clearance[2] < 0.051


@pytest.mark.parametrize("name", WORLD_NAMES)
def test_corners_are_everywhere(painted, name):
    world = painted(name, rig="mono", image_width_px=320)
    counts = []
    for index in range(0, world.frame_count, world.frame_count // 40):
        corners = cv2.goodFeaturesToTrack(world.render(index).images[0], 1000, 0.01, 5)
        counts.append(0 if corners is None else len(corners))
    assert np.median(counts) > 200
    assert min(counts) > 90


def inliers(world, i: int, j: int) -> int:
    """Count the ORB matches between two frames that agree on one epipolar geometry."""
    orb = cv2.ORB_create(1000)
    (points_i, words_i), (points_j, words_j) = (orb.detectAndCompute(world.render(k).images[0], None) for k in (i, j))
    matches = [
        pair[0]
        for pair in cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(words_i, words_j, k=2)
        if len(pair) == 2 and pair[0].distance < 0.8 * pair[1].distance and pair[0].distance < 64
    ]
    if len(matches) < 8:
        return 0
    a = np.float32([points_i[m.queryIdx].pt for m in matches])
    b = np.float32([points_j[m.trainIdx].pt for m in matches])
    cv2.setRNGSeed(0)
    _, mask = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, 2.0, 0.999)
    return 0 if mask is None else int(mask.sum())


def nearest_revisit(world, i: int, gap_s: float) -> int:
    """Return the frame, at least `gap_s` away from frame i, whose pose is most like it."""
    poses = world.truth().T_world_body
    distance = np.linalg.norm(poses[:, :3, 3] - poses[i, :3, 3], axis=1)
    distance += 2.0 * (1.0 - np.einsum("nj,j->n", poses[:, :3, 0], poses[i, :3, 0]))
    times = frame_seconds(world)
    distance[np.abs(times - times[i]) < gap_s] = np.inf
    return int(np.argmin(distance))


@pytest.mark.parametrize(
    ("name", "start", "others"),
    [("workshop-cart", 60, (200, 330, 430)), ("corridor-loop", 80, (400, 600, 900)), ("handheld-room", 40, (140, 240))],
)
def test_places_are_recognised_and_not_confused(painted, name, start, others):
    world = painted(name, rig="mono")
    assert inliers(world, start, nearest_revisit(world, start, 15.0)) > 40
    for other in others:
        assert inliers(world, start, other) < 20


def test_the_corridor_is_walked_again_for_five_metres_and_only_there(painted):
    world = painted("corridor-loop")
    places = world.truth().T_world_body[:, :3, 3]
    times = frame_seconds(world)
    apart = np.linalg.norm(places[:, None, :2] - places[None, :, :2], axis=2)
    apart[np.abs(times[:, None] - times[None]) < 15.0] = np.inf
    again = np.flatnonzero(apart.min(axis=1) < 0.5)
    late = again[times[again] > 30.0]
    assert np.linalg.norm(np.diff(places[late], axis=0), axis=1).sum() > 5.0
    assert times[again[times[again] < 30.0]].max() < 12.0
    assert times[late].min() > times[-1] - 12.0


def turned_about_the_middle(poses: np.ndarray, quarters: int) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), quarters)
    return T @ poses


def test_the_aliased_halls_are_the_same_pixels_but_for_a_number_and_the_fourth_is_rearranged(painted):
    world = painted("aliased-halls", rig="mono", image_noise=False, exposure_changes=False)
    pose = world.truth().T_world_body[150] @ world.rig.T_body_cams[0]  # in the second hall, its shelf in view
    renderer = Renderer(world.rig.cameras[0])
    first, second, third, fourth = (
        renderer.render(world.scene, turned_about_the_middle(pose, k))[0].astype(float) for k in (3, 0, 1, 2)
    )
    for other in (first, third):
        assert np.median(np.abs(other - second)) <= 2.0  # soft shadows are not turned with the hall
        assert np.mean(np.abs(other - second) > 25.0) < 0.02  # the number
    assert np.mean(np.abs(fourth - second) > 25.0) > 0.1


def test_the_aliased_halls_fool_appearance_and_are_revisited_truly(painted):
    world = painted("aliased-halls", rig="mono")
    poses = world.truth().T_world_body
    late = 540  # in the second hall again
    true = nearest_revisit(world, late, 15.0)
    assert np.linalg.norm(poses[true, :3, 3] - poses[late, :3, 3]) < 0.5
    assert inliers(world, late, true) > 60
    for quarters in (1, -1):  # where the same is seen in the next hall and in the one before
        turned = turned_about_the_middle(poses[late], quarters)
        distance = np.linalg.norm(poses[:, :3, 3] - turned[:3, 3], axis=1) + 2.0 * (
            1.0 - poses[:, :3, 0] @ turned[:3, 0]
        )
        assert inliers(world, late, int(np.argmin(distance))) > 60
