import os
import signal
import sqlite3
import subprocess
import sys
import textwrap
import time
from contextlib import closing
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

from session_entries import decided, editing, start_facts
from vislam.core.camera import Camera, Rig
from vislam.core.database import connect
from vislam.core.errors import DataError, StorageError
from vislam.core.geometry import se3_exp
from vislam.core.memory import FrameEntry, GraphRecord, KeyframeEntry
from vislam.core.messages import (
    Frame,
    FurtherTracks,
    GraphUpdate,
    ImuSpan,
    Keyframe,
    KeyframePacket,
    LoopEdge,
    MagSample,
    NavState,
    Observations,
    Tracking,
    VoMeasurement,
)
from vislam.imu import ImuNoise
from vislam.runs.session import Session, SessionWriter, has_begun

SEED = 11
NOISE = ImuNoise(1.7e-4, 2.0e-3, 1.9393e-5, 3.0e-3, 200.0)
RIG = Rig(
    (Camera(640, 480, 458.654, 457.296, 320.1, 240.3, 0.1, "radtan", (-0.28, 0.07, 2e-4, 1.7e-5)),),
    (se3_exp(np.array([0.1, -0.2, 1.5, 0.01, 0.02, 0.03])),),
    True,
)


def packet(i, rng):
    image = np.zeros((4, 4), np.uint8)
    points = None if i == 2 else rng.normal(size=(7, 3))
    pixels = rng.uniform(0, 640, (7, 2)).astype(np.float32).astype(float)
    frame = Frame(1000 * i, i, (image,))
    keyframe = Keyframe(i, 1000 * i, frame, pixels, rng.integers(0, 256, (7, 32), np.uint8), points)
    lost = i == 1
    vo = VoMeasurement(
        1000 * i,
        i - 1,
        None if lost else se3_exp(rng.normal(size=6)),
        np.diag(rng.uniform(1e-6, 1e-4, 6)),
        i != 2,
        Tracking.LOST if lost else Tracking.OK,
        90 - i,
    )
    depth = np.array([1.5, np.nan, 2.25, 0.5])
    right = None if i == 0 else pixels[:4] - 3.5
    ids = np.array([3, 2**40, 7, 8], np.int64) + i
    further = (FurtherTracks(2, ids[:3] + (2 << 40), pixels[4:]), FurtherTracks(3, ids[:0], pixels[:0])) if i else ()
    seen = Observations(ids, pixels[:4], right, None if i == 1 else depth, noise=1.0 + 0.3 * i, further=further)
    span = None if i == 0 else ImuSpan(1000 * i - np.arange(5)[::-1], rng.normal(size=(5, 3)), rng.normal(size=(5, 3)))
    mag = MagSample(1000 * i - 3, rng.normal(size=3)) if i == 2 else None
    return KeyframePacket(keyframe, vo, seen, span, mag, i == 1, 0.0125 * i)


def state(t_ns):
    return NavState(t_ns, se3_exp(np.full(6, 0.3)), np.ones(3), np.full(3, 1e-3), np.full(3, 0.1), np.eye(15) / 3.0)


def update(revision, ids, poses, newest=None):
    poses = np.array(poses).reshape(-1, 4, 4)
    return GraphUpdate(revision, np.array(ids, np.int64), poses, np.eye(4), newest)


def record(accepted=(), rejected=()):
    return GraphRecord(loops=tuple(decided(i, i in accepted) for i in (*accepted, *rejected)))


def write_three(path, count=3):
    rng = np.random.default_rng(SEED)
    writer = SessionWriter.create(path, {"source": "test", "config": {"seed": 1}}, RIG, NOISE, 9.80665)
    poses = [se3_exp(rng.normal(size=6)) for _ in range(3)]
    packets = [packet(i, rng) for i in range(3)]
    edge = LoopEdge(5, 0, 2, poses[1], np.eye(6) * 0.01, True, 40, 0.3)
    refused = LoopEdge(6, 1, 2, poses[1], np.eye(6), True, 12, 0.1)
    for i in range(count):
        edges, accepted, rejected = ([edge, refused], (5,), (6,)) if i == 2 else ([], (), ())
        writer.add_frame(FrameEntry(1000 * i - 500, i - 1, None if i == 0 else poses[0]))
        writer.add_frame(FrameEntry(1000 * i, i, np.eye(4)))
        change = update(i + 1, [i], [poses[i]], state(1000 * i))
        start = start_facts(state(0), NOISE)
        writer.add(KeyframeEntry(packets[i], poses[i], change, record(accepted, rejected), edges, start=start))
    return writer, packets, poses, edge


def same(a, b):
    """Whether two values hold the same bits, field by field; images and features are not compared."""
    if isinstance(a, tuple) and any(is_dataclass(value) for value in a):
        return len(a) == len(b) and all(same(*pair) for pair in zip(a, b, strict=True))
    if not is_dataclass(a) or not is_dataclass(b):
        return a is b or np.array_equal(a, b, equal_nan=isinstance(a, np.ndarray) and a.dtype.kind == "f")
    return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a) if f.name != "keyframe")


def test_a_session_gives_back_what_was_stored(tmp_path):
    print("seed", SEED)
    writer, packets, poses, edge = write_three(tmp_path / "session.db")
    frames = [p.keyframe for p in packets]
    moved = se3_exp(np.full(6, 0.1))
    writer.move(update(4, [1], [moved]), record())
    writer.close()
    session = Session(tmp_path / "session.db")
    stored = list(session.keyframes())
    assert session.info()["config"] == {"seed": 1}
    assert [k.id for k in stored] == [0, 1, 2]
    assert np.array_equal(stored[1].T_map_body, moved)
    assert np.array_equal(stored[1].T_odom_body, poses[1])
    for got, put in zip(stored, frames, strict=True):
        assert got.t_ns == put.t_ns
        assert np.array_equal(got.descriptors, put.descriptors)
        assert np.allclose(got.keypoints_px, put.keypoints_px)
        if put.points_body_m is None:
            assert got.points_body_m is None
        else:
            assert np.allclose(got.points_body_m, put.points_body_m, atol=1e-6)
    (kept,) = [logged.edge for logged in session.factor_log().edges if logged.accepted]
    assert (kept.id, kept.from_id, kept.to_id, kept.inliers, kept.has_scale) == (5, 0, 2, 40, True)
    assert np.array_equal(kept.T_from_to, edge.T_from_to)
    assert np.array_equal(kept.covariance, edge.covariance)
    session.close()


def test_the_factor_log_gives_back_every_measurement(tmp_path):
    print("seed", SEED)
    writer, packets, poses, edge = write_three(tmp_path / "session.db")
    writer.add_frame(FrameEntry(2500, 2, poses[2]))
    writer.close()
    log = Session(tmp_path / "session.db").factor_log()
    assert log.rig.cameras == RIG.cameras
    assert log.rig.has_depth
    assert np.array_equal(log.rig.T_body_cams[0], RIG.T_body_cams[0])
    assert log.noise == NOISE
    assert log.gravity_m_s2 == 9.80665
    assert same(log.first_state, state(0))
    for i, (kept, put) in enumerate(zip(log.keyframes, packets, strict=True)):
        assert same(kept.packet, put), i
        assert (kept.packet.keyframe.id, kept.packet.keyframe.t_ns) == (i, 1000 * i)
        assert np.array_equal(kept.T_odom_body, poses[i])
        assert np.array_equal(kept.velocity_map_m_s, np.ones(3))
        assert np.array_equal(kept.accel_bias_m_s2, np.full(3, 0.1))
    assert [(e.edge.id, e.accepted) for e in log.edges] == [(5, True), (6, False)]
    assert same(log.edges[0].edge, edge)
    assert log.frames.t_ns.tolist() == [-500, 0, 500, 1000, 1500, 2000, 2500]
    assert log.frames.keyframe_ids.tolist() == [-1, 0, 0, 1, 1, 2, 2]
    assert log.frames.T_keyframe_body[0] is None
    assert np.array_equal(log.frames.T_keyframe_body[-1], poses[2])


def test_a_loop_decided_later_changes_its_decision(tmp_path):
    writer, *_ = write_three(tmp_path / "session.db")
    writer.move(update(4, [], []), record(accepted=(6,), rejected=(5,)))
    writer.close()
    session = Session(tmp_path / "session.db")
    assert [(e.edge.id, e.accepted) for e in session.factor_log().edges] == [(5, False), (6, True)]


def test_a_failed_commit_leaves_no_half_keyframe(tmp_path):
    """Whatever breaks in the middle of a keyframe, packet, edges and frames of it are all absent."""
    writer, packets, poses, edge = write_three(tmp_path / "session.db", count=2)
    bad = GraphRecord(loops=(decided(("not", "an id"), True),))
    writer.add_frame(FrameEntry(1500, 1, None))
    with pytest.raises(StorageError):
        writer.add(KeyframeEntry(packets[2], poses[2], update(3, [2], [poses[2]]), bad, [edge]))
    log = Session(tmp_path / "session.db").factor_log()
    assert len(log.keyframes) == 2
    assert log.edges == []
    assert log.frames.t_ns.tolist() == [-500, 0, 500, 1000]


def test_a_killed_writer_leaves_every_committed_keyframe(tmp_path):
    path = tmp_path / "session.db"
    script = textwrap.dedent(f"""
        import sys; sys.path[:0] = {[str(f) for f in Path(__file__).parents[:2]]!r}
        from pathlib import Path
        from test_session import write_three
        writer, *_ = write_three(Path({str(path)!r}))
        print("committed", flush=True)
        import time; time.sleep(60)
    """)
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline().strip() == "committed"
        process.send_signal(signal.SIGKILL)
    assert len(list(Session(path).keyframes())) == 3
    assert len(Session(path).factor_log().keyframes) == 3


def test_a_session_killed_at_any_moment_of_its_beginning_or_end_can_be_read(tmp_path):
    """Each of many children makes one and closes it, and is killed somewhere within the time that this takes."""
    rng = np.random.default_rng(SEED)
    print("seed", SEED)
    journals = 0
    for k in range(100):
        path = tmp_path / f"{k}.db"
        child = os.fork()
        if child == 0:
            for _ in range(100):
                path.unlink(missing_ok=True)
                SessionWriter.create(path, {"source": "none"}, RIG, None, 9.81).close(finished=True)
            os._exit(0)
        time.sleep(rng.uniform(0.0, 0.02))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        journals += path.with_name(f"{k}.db-journal").exists()
        if has_begun(path):
            Session(path).close()
    print(journals, "left a journal")
    assert journals > 0


def test_damage_and_strangers_are_refused(tmp_path):
    with pytest.raises(DataError, match="no session"):
        Session(tmp_path / "absent.db")
    (tmp_path / "text.db").write_text("this is no database, but long enough to be looked at as one " * 20)
    with pytest.raises(DataError, match="cannot be read"):
        Session(tmp_path / "text.db")
    stranger = sqlite3.connect(tmp_path / "stranger.db")
    stranger.execute("CREATE TABLE t (x)")
    stranger.close()
    with pytest.raises(DataError, match="not a vislam session"):
        Session(tmp_path / "stranger.db")
    writer, *_ = write_three(tmp_path / "cut.db")
    writer.close()
    with editing(tmp_path / "cut.db") as database:
        database.execute("UPDATE keyframes SET T_map_body = x'0011' WHERE id = 1")
    with pytest.raises(DataError, match="damaged"):
        list(Session(tmp_path / "cut.db").keyframes())
    with editing(tmp_path / "cut.db") as database:
        database.execute("UPDATE info SET value = '{}' WHERE key = 'rig'")
    with pytest.raises(DataError, match="damaged"):
        Session(tmp_path / "cut.db").rig()


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE packets SET pixels_px = x'00112233' WHERE id = 1",
        "UPDATE packets SET track_ids = x'001122' WHERE id = 1",
        "UPDATE further SET pixels_px = x'00112233' WHERE id = 1",
        "UPDATE further SET id = 7 WHERE id = 1",
        "UPDATE packets SET vo_inliers = 'many' WHERE id = 1",
        "UPDATE packets SET imu_gyro = NULL WHERE id = 1",
        "UPDATE packets SET vo_tracking = 'fine' WHERE id = 1",
        "UPDATE edges SET covariance = x'' WHERE id = 5",
        "UPDATE info SET value = '{}' WHERE key = 'rig'",
        "UPDATE info SET value = '{\"t_ns\": 0}' WHERE key = 'first_state'",
        "UPDATE info SET value = 'not json' WHERE key = 'imu_noise'",
        "DELETE FROM packets WHERE id = 1",
        "DELETE FROM packets WHERE id = 2",
        "UPDATE frames SET T_keyframe_body = x'00' WHERE t_ns = 0",
        "DROP TABLE frames",
    ],
)
def test_a_damaged_factor_log_is_a_data_error(damage, tmp_path):
    writer, *_ = write_three(tmp_path / "session.db")
    writer.close()
    with editing(tmp_path / "session.db") as database:
        database.execute(damage)
    with pytest.raises(DataError, match="run the recording again"):
        Session(tmp_path / "session.db").factor_log()


def test_scores_that_were_no_numbers_are_read_as_such(tmp_path):
    write_three(tmp_path / "session.db")[0].close()
    with editing(tmp_path / "session.db") as database:
        database.execute("INSERT INTO retrieved VALUES (9, 2, 0, NULL, NULL, 1, 0)")
    with closing(Session(tmp_path / "session.db")) as session:
        assert np.isnan([session.retrieved()[-1].score, session.retrieved()[-1].island_score]).all()


@pytest.mark.parametrize(
    "planted",
    [
        "CREATE TRIGGER t AFTER UPDATE ON info BEGIN DELETE FROM keyframes; END",
        "CREATE VIEW v AS SELECT * FROM info",
        "CREATE TABLE more (x)",
        "CREATE INDEX i ON frames (abs(t_ns))",
    ],
)
def test_what_is_planted_in_a_session_never_runs(planted, tmp_path):
    path = tmp_path / "session.db"
    write_three(path)[0].close()
    with closing(sqlite3.connect(path)) as database:
        database.execute(planted)
        database.commit()
    before = path.read_bytes()
    for opened in (Session, SessionWriter.reopen):
        with pytest.raises(DataError, match="other tables, triggers or views"):
            opened(path)
    assert path.read_bytes() == before
    if "TABLE" in planted or "INDEX" in planted:
        return
    with closing(connect(path)) as database, pytest.raises(sqlite3.DatabaseError, match=r"prohibited|authorized"):
        # even where nobody looked first
        database.execute("UPDATE info SET value = value" if "TRIGGER" in planted else "SELECT * FROM v")


def test_a_flipped_bit_is_noticed_or_changes_nothing(tmp_path):
    path = tmp_path / "session.db"
    write_three(path)[0].close()
    sound, whole = path.read_bytes(), dump(path)
    rng, noticed = np.random.default_rng(4), 0
    for at in rng.integers(0, 8 * len(sound), 120).tolist():
        data = bytearray(sound)
        data[at // 8] ^= 1 << at % 8
        path.write_bytes(data)
        try:
            Session(path).close()
        except DataError:
            noticed += 1
        else:
            assert dump(path) == whole
    assert noticed > 10


def dump(path):
    with closing(sqlite3.connect(path)) as database:
        return list(database.iterdump())


def test_a_session_of_the_first_format_is_refused_with_the_next_step(tmp_path):
    writer, *_ = write_three(tmp_path / "session.db")
    writer.close()
    database = sqlite3.connect(tmp_path / "session.db")
    database.execute("PRAGMA user_version=1")
    database.close()
    with pytest.raises(DataError, match="format 1, this vislam reads 8; run the recording again"):
        Session(tmp_path / "session.db")


def test_noise_under_the_names_before_those_of_kalibr_is_read(tmp_path):
    writer, *_ = write_three(tmp_path / "session.db")
    old = {"gyro_noise_density": 1.7e-4, "accel_noise_density": 2.0e-3, "gyro_bias_walk": 1.9393e-5}
    writer.set_info({"imu_noise": old | {"accel_bias_walk": 3.0e-3, "rate_hz": 200.0, "gyro_scale_sigma": None}})
    writer.close()
    with closing(Session(tmp_path / "session.db")) as session:
        assert session.factor_log().noise == NOISE


def test_a_place_that_cannot_be_written_is_a_storage_error(tmp_path):
    with pytest.raises(StorageError, match="cannot be written"):
        SessionWriter.create(tmp_path / "absent" / "session.db", {}, RIG, None, 9.81)
