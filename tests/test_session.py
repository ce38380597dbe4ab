import os
import signal
import sqlite3
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from vislam.errors import DataError, StorageError
from vislam.geometry import se3_exp
from vislam.messages import Frame, GraphUpdate, Keyframe, LoopEdge
from vislam.session import Session, SessionWriter

SEED = 11


def keyframe(i, rng):
    image = np.zeros((4, 4), np.uint8)
    points = None if i == 2 else rng.normal(size=(7, 3))
    pixels = rng.uniform(0, 640, (7, 2)).astype(np.float32).astype(float)
    return Keyframe(i, 1000 * i, Frame(1000 * i, i, (image,)), pixels, rng.integers(0, 256, (7, 32), np.uint8), points)


def update(revision, ids, poses, accepted=()):
    return GraphUpdate(revision, np.array(ids, np.int64), np.array(poses).reshape(-1, 4, 4), np.eye(4), None, accepted)


def write_three(path):
    rng = np.random.default_rng(SEED)
    writer = SessionWriter(path, {"source": "test", "config": {"seed": 1}})
    poses = [se3_exp(rng.normal(size=6)) for _ in range(3)]
    frames = [keyframe(i, rng) for i in range(3)]
    edge = LoopEdge(5, 0, 2, poses[1], np.eye(6) * 0.01, True, 40, 0.3)
    refused = LoopEdge(6, 1, 2, poses[1], np.eye(6), True, 12, 0.1)
    for i, frame in enumerate(frames):
        edges, accepted = ([edge, refused], (5,)) if i == 2 else ([], ())
        writer.add(frame, poses[i], update(i + 1, [i], [poses[i]], accepted), edges)
    return writer, frames, poses, edge


def test_a_session_gives_back_what_was_stored(tmp_path):
    print("seed", SEED)
    writer, frames, poses, edge = write_three(tmp_path / "session.db")
    moved = se3_exp(np.full(6, 0.1))
    writer.move(update(4, [1], [moved]))
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
    (kept,) = session.edges()
    assert (kept.id, kept.from_id, kept.to_id, kept.inliers, kept.has_scale) == (5, 0, 2, 40, True)
    assert np.array_equal(kept.T_from_to, edge.T_from_to)
    assert np.array_equal(kept.covariance, edge.covariance)
    session.close()


def test_a_killed_writer_leaves_every_committed_keyframe(tmp_path):
    path = tmp_path / "session.db"
    script = textwrap.dedent(f"""
        import sys; sys.path.insert(0, {os.path.dirname(__file__)!r})
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
    database = sqlite3.connect(tmp_path / "cut.db")
    database.execute("UPDATE keyframes SET T_map_body = x'0011' WHERE id = 1")
    database.commit()
    database.close()
    with pytest.raises(DataError, match="damaged"):
        list(Session(tmp_path / "cut.db").keyframes())


def test_a_place_that_cannot_be_written_is_a_storage_error(tmp_path):
    with pytest.raises(StorageError, match="cannot be written"):
        SessionWriter(tmp_path / "absent" / "session.db", {})
