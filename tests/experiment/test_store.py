"""The store of results."""

import multiprocessing
import os
import signal
import sqlite3

import pytest

from vislam.core.errors import DataError, StorageError
from vislam.experiment.store import ResultStore

RESULT = {"status": "ok", "reason": "", "run": {"frames": 3}, "outputs": {}}
FAILED = {"status": "failed", "reason": "lost", "run": {}, "outputs": {}}


def test_results_come_back_and_are_never_doubled(tmp_path):
    path = tmp_path / "deep" / "results.db"
    with ResultStore(path) as store:
        assert store.add("k1", "first", {"a": 1}, RESULT)
        assert not store.add("k1", "again", {"a": 1}, FAILED)
        assert store.add("k2", "second", {}, FAILED)
    with ResultStore(path) as store:
        assert len(store) == 2
        assert store.get("k1") == RESULT
        assert (store.status("k1"), store.status("k2"), store.status("k3")) == ("ok", "failed", None)
        assert store.get("k3") is None


def test_only_failures_can_be_forgotten(tmp_path):
    with ResultStore(tmp_path / "r.db") as store:
        store.add("good", "g", {}, RESULT)
        store.add("bad", "b", {}, FAILED)
        store.add("other", "o", {}, FAILED)
        assert store.forget_failures(["good", "bad"]) == 1
        assert (store.status("good"), store.status("bad"), store.status("other")) == ("ok", None, "failed")


def _write_until_killed(path, wrote):
    with ResultStore(path) as store:
        for i in range(100_000):
            store.add(f"k{i}", "x", {}, RESULT)
            wrote.value = i + 1


def test_a_writer_that_is_killed_loses_nothing_it_had_written(tmp_path):
    context = multiprocessing.get_context("spawn")
    wrote = context.Value("i", 0)
    writer = context.Process(target=_write_until_killed, args=(tmp_path / "r.db", wrote))
    writer.start()
    while wrote.value < 50 and writer.is_alive():
        pass
    os.kill(writer.pid, signal.SIGKILL)
    writer.join()
    written = wrote.value
    assert written >= 50
    with ResultStore(tmp_path / "r.db") as store:
        assert len(store) in (written, written + 1)
        assert all(store.get(f"k{i}") == RESULT for i in range(written))


def test_two_comparisons_may_share_the_file(tmp_path):
    with ResultStore(tmp_path / "r.db") as one, ResultStore(tmp_path / "r.db") as two:
        assert one.add("k", "one", {}, RESULT)
        assert two.status("k") == "ok"
        assert not two.add("k", "two", {}, RESULT)
        assert two.add("m", "two", {}, RESULT)
        assert len(one) == 2


def _open(path):
    with ResultStore(path) as store:
        store.add(f"k{os.getpid()}", "x", {}, RESULT)


def test_comparisons_may_make_the_file_at_the_same_time(tmp_path):
    context = multiprocessing.get_context("fork")
    for i in range(5):
        path = tmp_path / f"{i}.db"
        processes = [context.Process(target=_open, args=(path,)) for _ in range(4)]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
        assert [process.exitcode for process in processes] == [0] * 4
        with ResultStore(path) as store:
            assert len(store) == 4


def test_other_files_are_refused(tmp_path):
    garbage = tmp_path / "garbage.db"
    garbage.write_bytes(b"this is not a database at all" * 100)
    with pytest.raises(DataError, match="give another --store"):
        ResultStore(garbage)
    assert garbage.read_bytes().startswith(b"this is not")
    foreign = tmp_path / "foreign.db"
    database = sqlite3.connect(foreign)
    database.execute("CREATE TABLE people (name TEXT)")
    database.close()
    with pytest.raises(DataError, match="no results of this version"):
        ResultStore(foreign)
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot be made"):
        ResultStore(tmp_path / "file" / "r.db")
