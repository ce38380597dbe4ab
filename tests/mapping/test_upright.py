"""Up from surfaces: made of planes, noise and clutter, seen by cameras that people hold in all ways."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.core.angles import angle_deg
from vislam.mapping.upright import View, surest_up, up_of_planes

UP = np.array([0.0, 0.0, 1.0])
TURNED = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()  # the map's axes are never those of the room


def cameras(pitch_deg: float, count: int, seed: int, roll_deg: float = 5.0) -> list[np.ndarray]:
    """Rotations R_room_cam [3, 3] that look down by a pitch, all around, with some roll."""
    rng = np.random.default_rng(seed)
    out = []
    for yaw in np.linspace(0.0, 2.0, count):
        ahead = Rotation.from_euler("ZY", [yaw, np.deg2rad(pitch_deg + rng.normal(0.0, 5.0))])
        level = ahead * Rotation.from_euler("X", np.deg2rad(rng.normal(0.0, roll_deg)))
        out.append(level.as_matrix() @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float))
    return out


def room(
    shares: dict[tuple[float, float, float], float], clutter: float, pitch_deg: float, seed: int = 0
) -> list[View]:
    """What cameras see of planes (normal: share of all surfaces) with noise of 3 degrees, and of clutter."""
    rng, views = np.random.default_rng(seed), []
    for R_room_cam in cameras(pitch_deg, 24, seed):
        parts = [rng.normal(size=(int(1000 * clutter), 3))]
        for normal, share in shares.items():
            parts.append(np.array(normal) + rng.normal(0.0, 0.05, (int(1000 * share), 3)))
        normals = np.concatenate(parts)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        R_map_cam = TURNED @ R_room_cam
        views.append(View((normals @ TURNED.T).astype(np.float32), R_map_cam[:, 0], -R_map_cam[:, 1]))
    return views


FLOOR, WALLS = {(0, 0, 1): 0.3}, {(1, 0, 0): 0.2, (0, -1, 0): 0.2}


@pytest.mark.parametrize("pitch_deg", [0.0, 15.0, 30.0, 45.0, 60.0])
def test_a_room_says_which_way_is_up_however_the_camera_is_pitched(pitch_deg):
    up = up_of_planes(room(FLOOR | WALLS, 0.3, pitch_deg))
    assert up.source == "planes"
    assert angle_deg(up.direction, TURNED @ UP) < 0.5
    assert up.sigma_deg < 1.0


@pytest.mark.parametrize("pitch_deg", [20.0, 45.0])
def test_a_desk_alone_is_enough(pitch_deg):
    up = up_of_planes(room({(0, 0, 1): 0.4}, 0.6, pitch_deg))
    assert angle_deg(up.direction, TURNED @ UP) < 0.5


def test_walls_alone_are_enough():
    up = up_of_planes(room(WALLS, 0.3, 5.0))
    assert angle_deg(up.direction, TURNED @ UP) < 1.0


def test_walls_at_odd_angles_do_not_disturb():
    odd = tuple(Rotation.from_euler("z", 35.0, degrees=True).apply([1.0, 0.0, 0.0]))
    up = up_of_planes(room(FLOOR | WALLS | {odd: 0.2}, 0.2, 20.0))
    assert angle_deg(up.direction, TURNED @ UP) < 0.5


def test_a_ceiling_is_no_floor():
    up = up_of_planes(room({(0, 0, -1): 0.3} | WALLS, 0.3, -10.0))
    assert angle_deg(up.direction, TURNED @ UP) < 0.5


def test_clutter_alone_says_nothing():
    up = up_of_planes(room({}, 1.0, 10.0))
    assert (up.source, up.direction) == ("unknown", None)
    assert "no floor, table or wall" in up.reason


def test_nothing_seen_says_nothing():
    assert not up_of_planes([]).is_known
    empty = [View(np.zeros((0, 3), np.float32), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))]
    assert "too few" in up_of_planes(empty).reason


def test_one_plane_seen_by_cameras_held_in_every_way_says_nothing():
    views = room({(0, 0, 1): 0.4}, 0.4, 0.0)
    turns = Rotation.random(len(views), random_state=0).as_matrix()
    views = [View(view.normals, R[:, 0], -R[:, 1]) for view, R in zip(views, turns, strict=True)]
    assert not up_of_planes(views).is_known


def test_the_same_surfaces_give_the_same_bytes():
    one, other = (up_of_planes(room(FLOOR | WALLS, 0.3, 30.0)) for _ in range(2))
    assert one.entry() == other.entry()


def tilted(views: list[View], deg: float) -> list[View]:
    R = Rotation.from_rotvec([np.deg2rad(deg), 0.0, 0.0]).as_matrix()
    return [View((v.normals @ R.T).astype(np.float32), R @ v.right, R @ v.upward) for v in views]


def noisier(views: list[View], seed: int) -> list[View]:
    """The same with every keyframe leaning its own way."""
    rng = np.random.default_rng(seed)
    return [tilted([v], deg)[0] for v, deg in zip(views, rng.normal(0.0, 4.0, len(views)), strict=True)]


def test_the_reach_of_normals_that_makes_an_answer_surest_gives_it():
    plain = room(FLOOR | WALLS, 0.3, 20.0)
    by_reach = {3: noisier(plain, 1), 5: plain, 8: noisier(plain, 2)}
    up = surest_up(by_reach.__getitem__)
    assert up.sigma_deg == up_of_planes(plain).sigma_deg < up_of_planes(by_reach[3]).sigma_deg
    assert angle_deg(up.direction, TURNED @ UP) < 0.5


def test_wider_normals_make_no_other_answer():
    plain = room(FLOOR | WALLS, 0.3, 20.0)
    blurred = noisier(plain, 1)
    up = surest_up({3: blurred, 5: tilted(plain, 40.0), 8: blurred}.__getitem__)
    assert np.array_equal(up.direction, up_of_planes(blurred).direction)
    assert not surest_up({3: [], 5: plain, 8: plain}.__getitem__).is_known
