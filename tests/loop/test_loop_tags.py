"""AprilTags as loop candidates: rendered tags with exact poses, and keyframes that nothing else ties together."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.config import load
from vislam.core.geometry import invert, se3_log
from vislam.core.memory import TagSighting
from vislam.core.messages import Frame, Keyframe
from vislam.loop import closer as closer_module
from vislam.loop.closer import LoopCloser
from vislam.loop.tags import TagBook, sight_tags
from vislam.vision.features import find_tags
from worlds.landmarks import body_pose, make_rig

SEED = 5
SIZE_M = 0.2
RIG = make_rig()
CAMERA, T_BODY_CAM = RIG.cameras[0], RIG.T_body_cams[0]
WITH_SIZE = {"loop.tag_size_m": SIZE_M}


def hung(x, y, z, yaw_deg=180.0):
    """Pose of a tag whose z axis looks at whoever faces it; a body at the origin looks along x."""
    T = np.eye(4)
    facing = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    T[:3, :3] = Rotation.from_euler("z", yaw_deg - 180.0, degrees=True).as_matrix() @ facing
    T[:3, 3] = x, y, z
    return T


def render(T_world_body, tags, rng):
    """Return the image [480, 640] of tags {id: T_world_tag} on grey noise, with exact perspective and distortion."""
    T_cam_world = invert(T_world_body @ T_BODY_CAM)
    image = rng.normal(120.0, 4.0, (480, 640))
    columns, rows = np.meshgrid(np.arange(0.0, 640.0, 0.5) - 0.25, np.arange(0.0, 480.0, 0.5) - 0.25)
    rays = np.column_stack([CAMERA.normalise(np.column_stack([columns.ravel(), rows.ravel()])), np.ones(columns.size)])
    fine = np.full(columns.size, np.nan)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for tag_id, T_world_tag in tags.items():
        pattern = cv2.copyMakeBorder(
            cv2.aruco.generateImageMarker(dictionary, tag_id, 80), 20, 20, 20, 20, 0, value=255
        )
        T = T_cam_world @ T_world_tag
        depth = (T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2])
        hit = (rays * depth[:, None] - T[:3, 3]) @ T[:3, :3]
        u, v = np.floor(hit[:, 0] / SIZE_M * 80.0 + 60.0), np.floor(60.0 - hit[:, 1] / SIZE_M * 80.0)
        on = (u >= 0) & (u < 120) & (v >= 0) & (v < 120) & (depth > 0.0)
        fine[on] = pattern[v[on].astype(int), u[on].astype(int)]
    fine = np.nanmean(fine.reshape(480, 2, 640, 2), axis=(1, 3)) if np.isfinite(fine).any() else image
    image = np.where(np.isfinite(fine), fine + rng.normal(0.0, 3.0, image.shape), image)
    return np.clip(image, 0.0, 255.0).astype(np.uint8)


def frame(T_world_body, tags, rng, index=0):
    return Frame(index * 300_000_000, index, (render(T_world_body, tags, rng),))


@pytest.mark.filterwarnings("ignore:Mean of empty slice")
@pytest.mark.parametrize("yaw_deg", [-35.0, 30.0])
def test_pose_of_a_tag_and_its_covariance(yaw_deg):
    rng = np.random.default_rng(SEED)
    config = load(None, WITH_SIZE).loop
    errors = []
    for k in range(8):
        T_world_tag = hung(1.2 + 0.1 * k, 0.05 * k - 0.2, 0.1, 180.0 + yaw_deg)
        (sighting,) = sight_tags(frame(np.eye(4), {7: T_world_tag}, rng), CAMERA, config)
        assert sighting.tag_id == 7
        error = se3_log(invert(invert(T_BODY_CAM) @ T_world_tag) @ sighting.T_cam_tag)
        errors.append(error @ np.linalg.solve(sighting.covariance, error) / 6.0)
        assert np.linalg.norm(error[3:]) < 0.03
    print(f"seed {SEED}, squared error per degree of freedom:", np.round(errors, 2))
    assert np.mean(errors) < 2.0


@pytest.mark.filterwarnings("ignore:Mean of empty slice")
def test_what_says_nothing_is_left_out():
    rng = np.random.default_rng(SEED)
    config = load(None, WITH_SIZE).loop
    assert sight_tags(Frame(0, 0, ()), CAMERA, config) == ()
    assert sight_tags(frame(np.eye(4), {}, rng), CAMERA, config) == ()
    far = sight_tags(frame(np.eye(4), {3: hung(6.0, 0.0, 0.0)}, rng), CAMERA, config)
    assert far == ()
    image = render(np.eye(4), {3: hung(1.5, 0.0, 0.0)}, rng)
    twice = np.hstack([image[:, 160:480], image[:, 160:480]])
    assert len(find_tags(twice, "36h11", 30.0)[0]) == 2
    assert sight_tags(Frame(0, 0, (twice,)), CAMERA, config) == ()
    (frontal,) = sight_tags(Frame(0, 0, (image,)), CAMERA, load(None, {}).loop)
    assert frontal.T_cam_tag is None  # no size, no pose
    assert sight_tags(Frame(0, 0, (image,)), CAMERA, load(None, {"loop.tags": "off"}).loop) == ()


@pytest.mark.filterwarnings("ignore:Mean of empty slice")
def test_a_blank_wall_with_tags_closes_the_loop():
    """Nothing but two tags ties the second visit to the first."""
    rng = np.random.default_rng(SEED)
    tags = {7: hung(1.5, 0.35, 0.1, 225.0), 9: hung(1.5, -0.35, 0.0, 135.0)}
    detector = LoopCloser(load(None, WITH_SIZE).loop, RIG, SEED)
    first = [body_pose((0.1 * k, 0.0, 0.0), 2.0 * k) for k in range(3)]
    second = [body_pose((0.05 + 0.1 * k, 0.1, 0.0), 2.0 - k) for k in range(3)]
    poses = [*first, *[body_pose((0.0, 0.0, 0.0), 180.0)] * 8, *second]
    edges, records = [], []
    for k, pose in enumerate(poses):
        nothing = np.empty((0, 2)), np.empty((0, 32), np.uint8), np.empty((0, 3))
        keyframe = Keyframe(k, k * 300_000_000, frame(pose, tags, rng, k), *nothing)
        drifted = pose.copy()
        drifted[1, 3] += 0.4 if k >= 3 else 0.0
        found, said = detector.detect(keyframe, drifted)
        edges += found
        records += said
    print(*(f"{r.from_id}-{r.to_id} {r.source} {r.decision}: {r.reason}" for r in records), sep="\n")
    assert {r.source for r in records} == {"tag"}
    assert len(edges) >= 3
    for edge in edges:
        error = se3_log(invert(edge.T_from_to) @ invert(poses[edge.from_id]) @ poses[edge.to_id])
        assert np.linalg.norm(error[3:]) < 0.05
        assert error @ np.linalg.solve(edge.covariance, error) < 25.0


def searched(monkeypatch, settings, tagged=()):
    """Return which of 14 keyframes are searched for tags, of which some show one."""
    looked = []

    def sight(frame, camera, config):
        looked.append(frame.index)
        return (TagSighting(7, 40.0, None, None),) if frame.index in tagged else ()

    monkeypatch.setattr(closer_module, "sight_tags", sight)
    detector = LoopCloser(load(None, settings).loop, RIG, SEED)
    nothing = np.empty((0, 2)), np.empty((0, 32), np.uint8), np.empty((0, 3))
    for k in range(14):
        seen = Frame(k * 300_000_000, k, (np.zeros((480, 640), np.uint8),))
        detector.detect(Keyframe(k, seen.t_ns, seen, *nothing), np.eye(4))
    return looked


def test_where_no_tag_hangs_few_keyframes_are_searched(monkeypatch):
    assert searched(monkeypatch, {}) == [0, 4, 8, 12]
    assert searched(monkeypatch, {"loop.tags_every": 1}) == list(range(14))


def test_who_tells_the_size_of_tags_or_shows_one_has_all_keyframes_searched(monkeypatch):
    assert searched(monkeypatch, WITH_SIZE) == list(range(14))
    assert searched(monkeypatch, {}, tagged=(3, 4)) == [0, *range(4, 14)]


def test_who_saw_a_tag_largest_is_asked_first():
    book = TagBook()
    assert book.candidates(0, 0, 2) == []
    rng = np.random.default_rng(SEED)
    config = load(None, WITH_SIZE).loop
    with pytest.warns(RuntimeWarning, match="Mean of empty"):
        near, middle = (sight_tags(frame(np.eye(4), {7: hung(x, 0.0, 0.0)}, rng), CAMERA, config) for x in (1.0, 2.0))
    book.add(0, middle)
    book.add(1, near)
    book.add(2, middle)
    book.add(9, middle)
    assert [c.id for c in book.candidates(9, 5, 2)] == [1]
    assert [c.id for c in book.candidates(9, 0, 2)] == [0]
    assert book.candidates(9, -1, 2) == []
