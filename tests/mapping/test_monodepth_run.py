"""Runs with depth from one camera: maps come out, replay and rebuilding give the same bytes, also after a kill."""

import json
import signal
import subprocess
import sys
from dataclasses import replace
from multiprocessing import Pipe
from pathlib import Path

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import load
from vislam.core.clock import StageClock
from vislam.datasets.recorder import record
from vislam.live.handover import BackEnded, FrontEnded, Seen
from vislam.live.pace import MapPace
from vislam.live.processes.child import Flag, Life, Signals
from vislam.live.processes.front import light
from vislam.live.processes.map import FollowedPipeline
from vislam.live.wire.mail import Inbox, Outbox
from vislam.mapping.formats.ply import read_ply
from vislam.mapping.octree.octomap_io import read_octree
from vislam.pipeline.back import map_stage
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.offline.rebuild import map_settings, rebuild
from vislam.runs.session import Session
from vislam.runs.sources import open_source
from vislam.sim import open_world
from vislam.slam import Slam

PRODUCTS = ("cloud", "octomap", "grid", "drive", "mesh")
SETTINGS = {
    "view.enabled": False,
    "map.products": PRODUCTS,
    "map.mono_depth.enabled": True,
    "map.mono_depth.scale": 1.0,
    "map.mono_depth.keyframes": 2,
}
# a process that kills itself, as nothing else could: by SIGKILL, in the middle of the recording
KILLED = """
import os, pathlib, signal, sys
sys.path.insert(0, sys.argv[1])
from test_monodepth_run import run
def stop(done, total, note):
    if done == 3 * total // 4:
        os.kill(os.getpid(), signal.SIGKILL)
run(sys.argv[2], pathlib.Path(sys.argv[3]), stop)
"""


def run(source, out, *progress):
    prepare(out, False)
    return execute(open_source(str(source), 0), load(None, SETTINGS), out, str(source), ["test"], *progress)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mono") / "recording"
    world = open_world("handheld-room", rig="mono", duration_s=7.0, camera_hz=10.0, image_width_px=256)
    record(world, folder)
    return folder


@pytest.fixture(scope="module")
def finished(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("mono") / "run"
    return out, run(recording, out)


@pytest.fixture(scope="module")
def killed(recording, tmp_path_factory):
    """What a killed run left: a session, and no maps."""
    out = tmp_path_factory.mktemp("mono") / "killed"
    command = [sys.executable, "-c", KILLED, str(Path(__file__).parent), str(recording), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr[-3000:]
    assert not (out / "map").exists()
    return out


def maps_of(out):
    """Contents of the map's files; pictures show the path too, of all frames or of keyframes alone."""
    paths = [path for path in sorted((out / "map").iterdir()) if path.suffix not in (".png", ".json")]
    return {path.name: path.read_bytes() for path in paths}


def depth_images(out):
    session = Session(out / "session.db")
    try:
        return [i for i, depth in session.rows("SELECT id, depth_png FROM scans ORDER BY id") if depth]
    finally:
        session.close()


def test_one_camera_makes_every_map(finished):
    out, metrics = finished
    assert metrics["mode"] == "mono"
    assert metrics["warnings"] == []
    assert len(depth_images(out)) == metrics["counters"]["map"]["keyframes_dense"] >= 3
    octree = read_octree(out / "map" / "octomap.bt")
    points, _ = read_ply(out / "map" / "cloud.ply")
    vertices, _ = read_ply(out / "map" / "mesh.ply")
    assert min(len(octree.occupied_voxels()), len(points), len(vertices)) > 500
    states = octree.log_odds_at(points)
    assert (states >= 0.0).mean() > 0.9  # the rest lies where nothing is known
    assert not (states < 0.0).any()
    for positions in (points, vertices):  # the room is 6 x 4.6 m, and the path begins at its origin
        inside = np.all(np.abs(positions) < [6.0, 4.6, 3.0], axis=1)
        assert inside.mean() > 0.95


def test_replay_gives_identical_maps(recording, finished, tmp_path):
    run(recording, tmp_path / "again")
    assert maps_of(tmp_path / "again") == maps_of(finished[0])


def test_made_again_from_the_session_the_maps_are_the_same(finished, tmp_path):
    out, _ = finished
    answer = rebuild(out, map_settings(out).map, tmp_path, "graph")
    assert answer["depth"] == "session"
    assert set(answer["written"]) >= set(PRODUCTS)
    assert all((tmp_path / name).read_bytes() == data for name, data in maps_of(out).items())


def test_a_killed_run_is_resumed_with_its_depth_and_ends_with_the_map_of_its_session(killed, tmp_path, capsys):
    before = depth_images(killed)
    assert before
    assert run_verb(["run", "--resume", str(killed), "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["frames"] == metrics["frames_expected"]
    after = depth_images(killed)
    assert after[: len(before)] == before
    assert len(after) > len(before)
    rebuild(killed, map_settings(killed).map, tmp_path, "graph")
    assert all((tmp_path / name).read_bytes() == data for name, data in maps_of(killed).items())


def test_the_map_process_of_a_live_run_makes_the_same_depth(recording, finished):
    """Front and back of one pipeline tell it over pipes what those of a live run tell; keyframes come as they will."""
    config, source = load(None, SETTINGS), open_source(str(recording), 0)
    slam = Slam(replace(config, map=replace(config.map, enabled=False)), source.rig, source.imu_noise)
    (frames, frames_out), (keyframes, keyframes_out) = Pipe(duplex=False), Pipe(duplex=False)
    seen, late = Outbox(frames_out, 10_000), Outbox(keyframes_out, 10_000)
    for value in source.events():
        for step in slam.feed(value):
            for keyframe in step.keyframes:
                late.put(keyframe)
            front = slam.front
            seen.put(Seen(light(step.front, shows=False, feeds_depth=True), np.eye(4), front.start, front.learned))
    seen.put(FrontEnded(slam.front.report(), slam.front.start, slam.front.learned, {}))
    late.put(BackEnded(None, None, None, {}, {}))
    life, clock = Life("map", Pipe()[1], Signals(Flag(), Flag())), StageClock()
    stage = map_stage(config, source.rig, clock)
    followed = FollowedPipeline(life, clock, stage, Inbox(frames), Inbox(keyframes), MapPace(float("inf")))
    steps = [keyframe for step in followed.steps() for keyframe in step.keyframes] + followed.finish().keyframes
    scans = {i: scan for step in steps for i, scan in step.scans.items() if scan.depth_png}
    out, metrics = finished
    assert sorted(scans) == depth_images(out)
    there, whole = (counters["mono depth"]["depth_pixels"] for counters in (stage.counters, metrics["counters"]))
    assert abs(there - whole) < 0.05 * whole
    seen.close()
    late.close()
