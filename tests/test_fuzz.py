"""What files may hold: a short fixed part of `experiments/fuzz.py`, and what it found."""

import importlib.util
import json
import os
import sys
import time
from pathlib import Path

import pytest

from needs import missing
from run_folder import make_run
from vislam.cli import run_verb
from vislam.config import load
from vislam.core.errors import DataError, UsageError, VislamError, printable
from vislam.core.reading import parse_json, read_bytes
from vislam.datasets.calibration import load_yaml
from vislam.datasets.telemetry.mp4 import read_tracks
from vislam.experiment.plan import load_plan
from vislam.loop.table import read_loops
from vislam.loop.words.orbslam import read_orbslam
from vislam.loop.words.vocabulary import Vocabulary
from vislam.mapping.formats.ply import read_ply
from vislam.mapping.octree.octomap_io import read_octree
from vislam.runs.folder import read_metrics
from vislam.runs.session import Session
from vislam.trajectory import evaluate, read_trajectory

_PATH = Path(__file__).resolve().parent.parent / "experiments" / "fuzz.py"
_SPEC = importlib.util.spec_from_file_location("fuzz", _PATH)
fuzz = importlib.util.module_from_spec(_SPEC)
sys.modules["fuzz"] = fuzz  # dataclasses look their module up
_SPEC.loader.exec_module(fuzz)


def test_mutated_files_are_read_or_refused_in_one_line():
    targets = fuzz.small_targets()
    assert fuzz.refused_seeds(targets) == []
    tallies = fuzz.run_cases(targets, seed=1, first=0, cases=20, until=time.monotonic() + 300.0)
    assert [find for tally in tallies.values() for find in tally.finds] == []
    assert all(tally.counts.total() == 20 for tally in tallies.values())
    assert sum(tally.counts["refused"] for tally in tallies.values()) > 50


def test_graphs_that_once_hung_or_failed_do_not(data_root, tmp_path, capsys):
    folder = data_root / "hostile"
    if not folder.is_dir():
        missing(f"{folder}")
    for path in sorted(folder.iterdir()):
        code = run_verb(["optimize", str(path), "--out", str(tmp_path), "--no-report"])
        told = capsys.readouterr().err
        assert code in (0, 3, 4), path
        assert code != 3 or len(told.splitlines()) == 1, path


@pytest.mark.parametrize(
    "edges",
    [
        [],
        ["EDGE_SE2 0 1 1 0 0 100 0 0 0 0 0"],  # nothing knows the rotation
        ["EDGE_SE2 0 1 1 0 0 0 0 0 0 0 100"],  # nor the translation
        ["EDGE_SE2 0 1 1e14 0 0 1e24 0 0 1e24 0 1e24", "EDGE_SE2 0 1 -1e14 0 0 1e-24 0 0 1e-24 0 1e-24"],
    ],
)
def test_a_certificate_comes_to_an_end(edges, tmp_path):
    path = tmp_path / "graph.g2o"
    path.write_text("\n".join(["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 0 0", *edges]) + "\n")
    begun = time.process_time()
    assert run_verb(["optimize", str(path), "--out", str(tmp_path / "out"), "--no-report"]) in (0, 4)
    assert time.process_time() - begun < 10.0


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("EDGE_SE2 0 1 1e159 0 0 1 0 0 1 0 1", "1e+159 m are too far"),
        ("EDGE_SE2 0 1 1 0 0 1e150 0 0 1 0 1", "information of 1e+150 cannot be used"),
        ("VERTEX_SE2 2 \x1b[31mred\x1b[0m 0 0", r"'\x1b[31mred\x1b[0m' is not a number"),
    ],
)
def test_what_no_graph_can_hold_is_refused_with_its_line(line, message, tmp_path, capsys):
    path = tmp_path / "graph.g2o"
    path.write_text(f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n{line}\n")
    assert run_verb(["optimize", str(path), "--out", str(tmp_path / "out")]) == 3
    assert f"graph.g2o:3: {message}" in capsys.readouterr().err


def test_what_is_quoted_never_reaches_the_terminal_as_it_is():
    error = DataError("a\x1b]0;title\x07b\nc\u202ed\udc80 ü — 日本")
    assert str(error) == r"a\x1b]0;title\x07b\nc\u202ed\udc80 ü — 日本"
    assert printable(error) == str(error)


READERS = (
    read_trajectory, load_yaml, load, load_plan, read_orbslam, Vocabulary.load, read_octree, read_ply,
    read_loops, Session, read_tracks,
)  # fmt: skip


@pytest.mark.parametrize("read", READERS, ids=lambda read: read.__qualname__)
@pytest.mark.parametrize("kind", ["fifo", "device"])
def test_what_is_no_file_is_refused_at_once(read, kind, tmp_path):
    path = Path("/dev/zero")
    if kind == "fifo":
        path = tmp_path / "fifo"
        os.mkfifo(path)
    with pytest.raises((VislamError, OSError)) as told:
        read(path)
    assert "FIFO" in str(told.value) or "no session" in str(told.value)


@pytest.mark.parametrize("name", ["graph.g2o", "graph.toro", "graph"])
def test_a_fifo_is_no_pose_graph(name, tmp_path, capsys):
    os.mkfifo(tmp_path / name)
    assert run_verb(["optimize", str(tmp_path / name), "--out", str(tmp_path / "out")]) in (2, 3)
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_json_that_is_nested_too_deep_is_refused(tmp_path, capsys):
    deep = "[" * 200_000
    with pytest.raises(ValueError, match="too deep"):
        parse_json(deep)
    run = make_run(tmp_path / "run", loops=2)
    (run / "metrics.json").write_text('{"accuracy": ' + deep)
    with pytest.raises(DataError, match="too deep"):
        read_metrics(run)
    assert run_verb(["report", str(run), "--figures", str(run / "figures")]) == 0
    (run / "config.json").write_text(deep)
    (run / "manifest.json").write_text(json.dumps({}))
    capsys.readouterr()
    assert run_verb(["run", "--resume", str(run)]) == 3
    assert "too deep" in capsys.readouterr().err


def test_settings_that_are_nested_too_deep_are_refused(tmp_path):
    (tmp_path / "c.toml").write_text("a = " + "[" * 100_000)
    with pytest.raises(UsageError, match="cannot be read"):
        load(tmp_path / "c.toml")


def test_a_file_larger_than_its_kind_is_not_read(tmp_path):
    (tmp_path / "a").write_bytes(b"x" * 11)
    assert len(read_bytes(tmp_path / "a", 11)) == 11
    with pytest.raises(OSError, match="larger than"):
        read_bytes(tmp_path / "a", 10)


def test_positions_too_far_apart_are_told(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("".join(f"{i} {i} {1e200 if i == 5 else 0} 0 0 0 0 1\n" for i in range(9)))
    with pytest.raises(DataError, match=r"a\.tum:6: 1e\+200 m are too far"):
        read_trajectory(path)
    path.write_text("1e999999999 0 0 0 0 0 0 1\n")
    with pytest.raises(DataError, match="out of range"):
        read_trajectory(path)
    path.write_text("".join(f"{i} {i} {i % 2} 0 0 0 0 1\n" for i in range(9)))
    trajectory = read_trajectory(path)
    assert evaluate(trajectory, trajectory, "se3")["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)
