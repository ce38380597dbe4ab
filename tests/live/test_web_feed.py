"""What a page gets of a run: bounded however long the run is, and nobody waits for a page that takes nothing."""

import base64
import json
import multiprocessing
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from vislam.core.messages import Tracking
from vislam.hw.health import Health
from vislam.live.processes.front import FrameShare, picture
from vislam.live.web import feed as feed_module
from vislam.live.web.feed import MOST_POINTS, Feed
from vislam.live.web.map_share import SAVED, MapShare, quantised
from vislam.live.web.updates import FrameUpdate, KeyframeCloud, LoopUpdate, MapUpdate, Save, Saved, Status, StepPicture
from vislam.live.wire.mail import Inbox
from vislam.live.wire.published_pose import NO_VISION_MS, PublishedPose
from vislam.mapping.formats.ply import read_ply
from waiting import HUNG_S


def cloud(count: int) -> KeyframeCloud:
    return KeyframeCloud(0.001, np.full((count, 3), 7, np.int16), np.zeros(count, np.uint16))


def update(ids: range, points: int = 10, revision: int = 1) -> MapUpdate:
    poses = {i: np.eye(4) for i in ids}
    return MapUpdate(revision, poses, dict.fromkeys(ids, 0), {i: cloud(points) for i in ids}, [])


def whole(feed: Feed) -> tuple[dict, int]:
    """Ask as the page does until it has all; return the clouds and how many answers that took."""
    clouds: dict = {}
    epoch = since = answers = 0
    while True:
        told = feed.map({"epoch": str(epoch), "since": str(since)})
        json.dumps(told, allow_nan=False)
        clouds |= told["clouds"]
        epoch, since, answers = told["epoch"], told["revision"], answers + 1
        if not told["more"]:
            return clouds, answers


def points_of(clouds: dict) -> int:
    return sum(len(base64.b64decode(entry["rgb"])) // 2 for entry in clouds.values())


def pose_at(position: np.ndarray, health: Health = Health.LEVELLED, sigma: float = 0.1) -> PublishedPose:
    T = np.eye(4)
    T[:3, 3] = position
    covariance = np.diag(np.full(6, sigma))
    return PublishedPose(
        10**9, 10**9, 1, health, T, np.zeros(3), np.zeros(3), covariance, np.eye(6), np.eye(4), 0, 0, NO_VISION_MS
    )


def test_what_changed_is_sent_and_nothing_else() -> None:
    feed = Feed()
    feed.take(update(range(3)))
    first = feed.map({})
    assert len(first["clouds"]) == 3
    feed.take(MapUpdate(2, {1: np.eye(4) * 2}, {}, {}, []))
    second = feed.map({"epoch": str(first["epoch"]), "since": str(first["revision"])})
    assert np.frombuffer(base64.b64decode(second["ids"]), "<u4").tolist() == [1]
    assert second["clouds"] == {}


def test_points_are_bounded_however_many_keyframes_there_are() -> None:
    feed = Feed()
    for begin in range(0, 1024, 32):
        feed.take(update(range(begin, begin + 32), 2000))
    clouds, answers = whole(feed)
    assert len(clouds) == 1024
    assert points_of(clouds) <= MOST_POINTS
    assert answers > 1
    assert feed.state({})["map"]["points"] == points_of(clouds)


def test_keyframes_are_thinned_when_there_are_too_many_and_the_page_begins_anew(monkeypatch) -> None:
    monkeypatch.setattr(feed_module, "_MOST_KEYFRAMES", 100)
    feed = Feed()
    feed.take(update(range(100)))
    before = feed.map({})
    feed.take(update(range(100, 150)))
    told = feed.map({"epoch": str(before["epoch"]), "since": str(before["revision"])})
    assert told["epoch"] == before["epoch"] + 1
    assert len(told["clouds"]) == 75


def test_the_path_is_bounded_and_only_its_new_part_is_sent() -> None:
    feed = Feed()
    for k in range(5000):
        feed.follow(pose_at(np.array([0.05 * k, 0.0, 0.0])))
    path = feed.state({})["path"]
    count = len(base64.b64decode(path["xyz"])) // 12
    assert 1000 < count <= 4000
    tail = feed.state({"epoch": str(path["epoch"]), "path": str(count - 2)})["path"]
    assert len(base64.b64decode(tail["xyz"])) == 24


@pytest.mark.parametrize("query", [{"path": "-1"}, {"path": "x"}, {"path": "9" * 15, "epoch": "0"}, {"since": "1e9"}])
def test_numbers_that_are_none_are_taken_for_zero_or_ask_for_nothing(query: dict[str, str]) -> None:
    feed = Feed()
    feed.take(update(range(2)))
    feed.follow(pose_at(np.zeros(3)))
    json.dumps(feed.state(query), allow_nan=False)
    json.dumps(feed.map(query), allow_nan=False)


def test_a_pose_without_certainty_is_told_without_numbers_that_json_lacks() -> None:
    feed = Feed()
    feed.follow(pose_at(np.full(3, np.nan), Health(0), np.inf))
    told = json.dumps(feed.state({}), allow_nan=False)
    assert "NaN" not in told
    assert base64.b64decode(feed.state({})["path"]["xyz"]) == b""  # not levelled: nowhere


def test_the_newest_picture_is_shown_whether_of_the_run_or_of_a_step() -> None:
    feed = Feed()
    assert feed.picture() == b""
    feed.take(StepPicture(b"step"))
    assert (feed.picture(), feed.state({})["picture"]) == (b"step", 1)
    feed.take(FrameUpdate(5, b"frame", "lost", 3, "dark"))
    state = feed.state({})
    assert (feed.picture(), state["picture"], state["frame"]["reason"]) == (b"frame", 2, "dark")
    assert base64.b64decode(feed.seen()["state"]) == b"\x02"


def test_loops_status_and_what_was_saved_are_told() -> None:
    feed = Feed()
    feed.take(Status({"phase": "running"}))
    feed.take(Saved("saved/cloud.ply"))
    loops = [LoopUpdate(1, 9, "odometry", "pending", "waits"), LoopUpdate(1, 9, "odometry", "accepted", "agrees")]
    feed.take(MapUpdate(1, {}, {}, {}, loops, {"accepted": 1}))
    state = feed.state({})
    assert state["phase"] == "running"
    assert feed.is_going
    assert state["saved"][0]["text"] == "saved/cloud.ply"
    assert feed.map({})["loops"] == [[1, 9, "accepted", "agrees", -1]]
    assert state["map"]["loops"] == {"accepted": 1}


def test_a_cloud_is_the_same_every_time_and_never_wraps_around() -> None:
    rng = np.random.default_rng(0)
    points, colors = rng.uniform(-80.0, 80.0, (5000, 3)), rng.integers(0, 255, (5000, 3), dtype=np.uint8)
    first, second = (quantised(4, points, colors) for _ in range(2))
    assert np.array_equal(first.xyz, second.xyz)
    assert len(first.xyz) == 2000
    restored = first.xyz * first.step_m
    nearest = np.abs(restored[:20, None] - points[None]).max(axis=2).min(axis=1)
    assert nearest.max() <= first.step_m


def test_a_picture_is_small_and_what_has_no_image_gives_none() -> None:
    frame = SimpleNamespace(color=None, images=(np.zeros((960, 1280), np.uint8),))
    jpeg = picture(frame, np.array([[3.0, 4.0], [np.nan, 0.0], [-1e9, 1e9]]))
    assert jpeg[:2] == b"\xff\xd8"
    assert len(jpeg) < 50_000
    assert picture(SimpleNamespace(color=None, images=()), np.empty((0, 2))) == b""


def seen_step(t_ns: int):
    vo = SimpleNamespace(tracking=Tracking.OK, inliers=5)
    track = SimpleNamespace(vo=vo, reason="", observations=SimpleNamespace(pixels_px=np.empty((0, 2))))
    frame = SimpleNamespace(t_ns=t_ns, color=None, images=(np.zeros((48, 64), np.uint8),))
    return SimpleNamespace(frame=frame, track=track)


def keyframe_step(keyframe_id: int):
    keyframe = SimpleNamespace(id=keyframe_id, t_ns=keyframe_id, points_body_m=np.ones((5, 3)), frame=SimpleNamespace(
        color=None, images=()), keypoints_px=np.zeros((5, 2)))  # fmt: skip
    update = SimpleNamespace(revision=1, ids=np.array([keyframe_id]), T_map_body=np.eye(4)[None], T_map_odom=np.eye(4))
    odometry = SimpleNamespace(packet=SimpleNamespace(keyframe=keyframe), T_odom_body=np.eye(4))
    return SimpleNamespace(odometry=odometry, update=update, candidates=[], edges=[],
                           record=SimpleNamespace(loops=()), scans={})  # fmt: skip


@pytest.mark.parametrize("is_dead", [True, False])
def test_nobody_waits_for_a_page_that_takes_nothing_and_no_memory_is_spent_on_it(
    tmp_path, monkeypatch, is_dead
) -> None:
    monkeypatch.setattr("vislam.live.processes.front._FRAME_S", 0.0)
    hears, says = multiprocessing.Pipe()
    if is_dead:
        hears.close()
    frames = FrameShare(says)
    for k in range(3000):  # more than a pipe holds
        frames.show(seen_step(k))
    hears_map, says_map = multiprocessing.Pipe()
    if is_dead:
        hears_map.close()
    shared = MapShare(says_map, tmp_path)
    for k in range(3000):
        shared.take([keyframe_step(k)], None)
    if is_dead:
        return
    inbox, waiting = Inbox(hears_map), []
    while sum(told.left_out for told in waiting) == 0:  # what was sent before the page fell behind comes first
        shared.flush()
        waiting += [told] if (told := inbox.get(HUNG_S)) is not None else []
    assert max(len(told.clouds) for told in waiting) <= 64


def answer(shared: MapShare, inbox: Inbox, mapper=None) -> Saved:
    """Return what the map's process answers to the page, as it goes on."""
    while not isinstance(told := inbox.get(0.02), Saved):
        shared.take([], mapper)
    return told


def test_the_map_is_saved_where_the_program_says_and_errors_are_told(tmp_path) -> None:
    page, wire = multiprocessing.Pipe()
    shared = MapShare(wire, tmp_path)
    shared.take([keyframe_step(1)], None)
    inbox = Inbox(page)
    page.send((0, Save()))
    saved = answer(shared, inbox)
    assert saved.is_well
    assert SAVED[1] in saved.text
    assert {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")} == {SAVED[1]}


def test_points_of_a_keyframe_come_from_its_depth_where_it_has_some_and_the_saved_map_is_that_of_all(tmp_path) -> None:
    points, colors = np.full((4, 3), 0.5, np.float32), np.full((4, 3), 200, np.uint8)
    cloud_ = SimpleNamespace(points_m=points, colors=colors)
    mapper = SimpleNamespace(keyframe_cloud=lambda keyframe_id, voxel_m: cloud_, cloud=lambda: cloud_)
    page, wire = multiprocessing.Pipe()
    shared = MapShare(wire, tmp_path)
    shared.take([keyframe_step(1)], mapper)
    inbox = Inbox(page)
    told = inbox.get(HUNG_S)
    assert told.clouds[1].xyz.tolist() == [[500, 500, 500]] * 4
    page.send((0, Save()))
    saved = answer(shared, inbox, mapper)
    assert saved.is_well
    assert "4 points" in saved.text
    assert len(read_ply(tmp_path / "saved" / "cloud.ply")[0]) == 4


def test_before_the_first_keyframe_there_is_little_to_save_and_a_folder_that_cannot_be_is_told(tmp_path) -> None:
    (tmp_path / "run").write_text("a file in its way")
    saved = []
    for out in (tmp_path, tmp_path / "run"):
        page, wire = multiprocessing.Pipe()
        page.send((0, Save()))
        saved.append(answer(MapShare(wire, out), Inbox(page)))
    assert [told.is_well for told in saved] == [True, False]
    assert "not saved" in saved[1].text


@pytest.mark.parametrize(
    ("status", "pose", "state", "text"),
    [
        ({"phase": "waiting"}, None, "plain", "The run waits for Start."),
        ({"phase": "getting ready", "line": "getting ready: compiling"}, None, "plain", "Getting ready: compiling."),
        ({"phase": "running"}, {}, "trusted", "Trusted, ± 0.55 m: nothing in the run contradicts itself."),
        (
            {"phase": "running", "verdict": {"state": "doubtful", "reasons": ["it is dark: 3 of 4", "it shakes", "c"]}},
            {}, "doubtful", "Doubtful, ± 0.55 m: it is dark, and 2 more reasons.",
        ),
        (
            {"phase": "running"}, {"health": Health.INVALID | Health.DEAD_RECKONING, "vision_age_s": 2.0}, "invalid",
            "Invalid, ± 0.55 m: nothing has corrected it for 2.0 s; vision is lost: dark. Do not steer by it.",
        ),
        (
            {"phase": "running"}, {"health": Health.INVALID | Health.IMU_MISSING}, "invalid",
            "Invalid, ± 0.55 m: no samples come from the IMU. Do not steer by it.",
        ),
        ({"phase": "ended", "verdict": {"state": "lost", "reasons": ["dark"]}}, {}, "lost", "Lost: dark."),
    ],
)  # fmt: skip
def test_the_page_begins_with_what_the_pose_is_worth(status: dict, pose: dict | None, state: str, text: str) -> None:
    feed = Feed()
    feed.take(Status(status))
    feed.take(FrameUpdate(5, b"", "lost", 3, "dark"))
    if pose is not None:
        feed.follow(replace(pose_at(np.zeros(3)), **pose))
    line = feed.state({})["headline"]
    assert (line["state"], line["text"]) == (state, text)
    assert ("sigma" in line) == (state == "invalid")


def test_all_times_count_from_the_first_frame_of_the_run() -> None:
    feed = Feed()
    notices = [("info", "ready", 4 * 10**9), ("warning", "dark", 7 * 10**9)]
    feed.take(Status({"phase": "running", "notices": notices}))
    assert [notice[2] for notice in feed.state({})["notices"]] == [None, None]  # there is no first frame yet
    feed.follow(replace(pose_at(np.zeros(3)), t_ns=5 * 10**9))
    feed.take(Status({"phase": "running", "notices": notices, "zero_ns": 6 * 10**9}))  # as the run's own files count
    feed.follow(replace(pose_at(np.zeros(3)), t_ns=8 * 10**9))
    state = feed.state({})
    assert [notice[2] for notice in state["notices"]] == [None, 1.0]
    assert state["pose"]["t_s"] == 2.0
