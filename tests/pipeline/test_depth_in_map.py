"""A run in the map of another that depth finds where no image does: in the dark, on other wallpaper, or elsewhere."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import load
from vislam.core.errors import UsageError
from vislam.core.geometry import invert, quaternion_xyzw_from_rotation, se3_exp, se3_log
from vislam.loop.table import read_loops
from vislam.pipeline.settings import derived
from vislam.runs import execute, map_of, resume
from vislam.runs.begin import parse_start
from vislam.runs.folder import MapChoice, prepare, read_setup
from vislam.runs.session import Session
from vislam.slam import Slam
from vislam.trajectory import read_tum
from worlds import corner
from worlds.corner import World, path

# keyframes often, and depth asked whenever it can: a short film is enough
SETTINGS = {
    "view.enabled": False, "map.products": [], "frontend.keyframe_max_interval_s": 0.15, "frontend.readout_s": 0.0,
    "loop.depth_worth_m": 0.0, "loop.depth_worth_deg": 0.0,
}  # fmt: skip
OTHER_ROOM = (  # nearer, and with other angles
    (np.array([0.0, 0.0, 1.0]), 2.9),
    (np.array([-0.8, 0.0, 0.6]), 1.9),
    (np.array([0.0, -1.0, 0.0]), 1.4),
)


class Film:
    """Frames as a recording."""

    name = "corner"
    imu_noise = None

    def __init__(self, world, frames):
        self.rig, self._frames = world.rig, frames
        self.frame_count = len(frames)
        self.problems = {}

    def events(self, from_ns=None):
        yield from self._frames

    def truth(self):
        return None


def film(world, poses, dark_from=None):
    frames = world.frames(poses)
    if dark_from is not None:
        frames = [
            replace(f, images=tuple(np.full_like(i, 4) for i in f.images)) if f.index >= dark_from else f
            for f in frames
        ]
    return Film(world, frames)


def run(recording, out, base=None, **settings):
    prepare(out, overwrite=False)
    changed = {name.replace("__", "."): value for name, value in settings.items()}
    return execute(recording, load(None, {**SETTINGS, **changed}), out, "film", [], base=base)


def by_depth(out):
    return [loop for loop in read_loops(out / "loops.csv") if loop.source == "depth"]


def told(T, off=(0.0, 0.07, 0.0, 0.08, 0.0, -0.06)):
    """A start that is a little off, as somebody types it."""
    T = T @ se3_exp(np.array(off))
    return ",".join(f"{x:.6f}" for x in [*T[:3, 3], *quaternion_xyzw_from_rotation(T[:3, :3])])


@pytest.fixture(scope="module")
def old(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "old"
    metrics = run(film(World("rgbd"), path(24)), out, map__enabled=True, up="none")
    assert metrics["keyframes"] > 4
    return out


def other_noise(seed=7):
    world = World("rgbd", seed=seed)
    world.rng = np.random.default_rng(99)
    return world


def errors_m(out, poses):
    """Position errors of a run's frames in the map, whose origin is pose 0 of the path."""
    found = read_tum(out / "trajectory_graph.tum")
    index = np.round((found.t_ns - 1_000_000_000) / corner.FRAME_NS).astype(int)
    return np.array(
        [np.linalg.norm(se3_log(invert(T) @ poses[k])[3:]) for T, k in zip(found.T_world_body, index, strict=True)]
    )


def test_in_the_dark_depth_ties_a_run_to_the_map_it_was_found_in(old, tmp_path):
    poses = path(34, 1.5)[4:]
    metrics = run(film(other_noise(), poses, dark_from=8), tmp_path / "new", MapChoice(old, False), up="none")
    assert metrics["map"]["found_t_s"] < 0.5
    loops = by_depth(tmp_path / "new")
    kept = [loop for loop in loops if loop.decision == "accepted"]
    assert len(kept) >= 2, [loop.reason for loop in loops]
    assert all(loop.from_id < metrics["map"]["keyframes"] <= loop.to_id for loop in kept)
    assert "1 of 3 keyframes in a row agree" in loops[0].reason
    assert metrics["counters"]["depth in map"]["offered"] >= len(kept)
    assert errors_m(tmp_path / "new", poses).max() < 0.03


def test_a_run_in_a_map_that_is_resumed_and_goes_dark_then_asks_depth_too(old, tmp_path):
    def stop(done, total, note):
        if done == 12:
            raise KeyboardInterrupt

    recording, out = film(other_noise(), path(36, 1.5)[4:], dark_from=15), tmp_path / "new"
    config = load(None, {**SETTINGS, "up": "none"})
    prepare(out, overwrite=False)
    with pytest.raises(KeyboardInterrupt):
        execute(recording, config, out, "film", [], stop, MapChoice(old, False))
    _, config, base = read_setup(out)
    metrics = resume(recording, config, out, "film", [], base=base)
    assert metrics["resumed"]
    assert metrics["counters"]["depth in map"]["asked"] > 0  # since then
    again = metrics["resumed"][0]["keyframe"]
    assert [loop for loop in by_depth(out) if loop.to_id > again and loop.decision == "accepted"]


def test_in_a_map_the_graph_knows_motion_in_the_dark_as_well_as_depth_does(old):
    recording = film(other_noise(), path(30, 1.5)[4:], dark_from=8)
    config = derived(load(None, {**SETTINGS, "up": "none"}), recording.rig, None)
    stored = Session(old / "session.db")
    slam = Slam(config, recording.rig)
    slam.begin_in_map(map_of(stored, recording, config, None))
    stored.close()
    steps = [step for frame in recording.events() for step in slam.feed(frame)]
    dark = [t.keyframe.id for t in (step.front.track for step in steps) if t.by_depth and t.keyframe is not None]
    assert len(dark) > 2
    for k in dark:
        sigmas = np.sqrt(np.diag(slam.back.graph.relative_covariance(k - 1, k)))
        assert sigmas[:3].max() < np.deg2rad(3.0)
        assert sigmas[3:].max() < 0.05


def test_a_place_that_is_told_is_found_on_other_wallpaper_by_depth_alone(old, tmp_path):
    poses = path(24)[2:]
    start = told(poses[0])
    metrics = run(
        film(other_noise(8), poses), tmp_path / "new", MapChoice(old, True), loop__start_in_map=start, up="none"
    )
    loops = read_loops(tmp_path / "new" / "loops.csv")
    kept = {loop.source for loop in loops if loop.decision == "accepted" and loop.from_id < metrics["map"]["keyframes"]}
    assert kept == {"depth"}
    assert metrics["map"]["found_t_s"] is not None
    assert errors_m(tmp_path / "new", poses).max() < 0.03


def test_a_place_that_is_told_on_the_way_is_found_as_well(old):
    poses = path(24)[2:]
    recording = film(other_noise(8), poses)
    config = derived(load(None, {**SETTINGS, "up": "none"}), recording.rig, None)
    stored = Session(old / "session.db")
    slam = Slam(config, recording.rig)
    slam.begin_in_map(map_of(stored, recording, config, None, True))
    stored.close()
    joined = []
    for k, frame in enumerate(recording.events()):
        if k == 5:
            slam.back.guess(poses[k] @ se3_exp(np.array([0.0, 0.07, 0.0, 0.08, 0.0, -0.06])))
        joined += [keyframe.update.submaps.is_joined for step in slam.feed(frame) for keyframe in step.keyframes]
    assert not joined[0] and joined[-1]
    assert slam.back.counters["depth in map"]["offered"] > 0


def test_another_room_gets_no_edge_by_depth_whatever_place_is_told(old, tmp_path, monkeypatch):
    monkeypatch.setattr(corner, "_PLANES", OTHER_ROOM)
    poses = path(24)[2:]
    start = told(poses[0])
    metrics = run(
        film(other_noise(8), poses), tmp_path / "new", MapChoice(old, True), loop__start_in_map=start, up="none"
    )
    loops = by_depth(tmp_path / "new")
    assert len(loops) > 2  # it was asked
    assert not [loop for loop in loops if loop.decision == "accepted"]
    assert metrics["map"]["found_t_s"] is None


@pytest.mark.parametrize(
    "text", ["", "1,2,3", "0,0,0,0,0,0,0", "nan,0,0,0,0,0,1", "1e300,0,0,0,0,0,1", "a,b,c,d,e,f,g"]
)
def test_a_start_that_is_no_pose_is_told(text):
    with pytest.raises(UsageError, match="QX,QY,QZ,QW"):
        parse_start(text)


def test_a_start_without_a_map_is_told(tmp_path, capsys):
    arguments = ["run", "sim:handheld-room", "--out", str(tmp_path / "run"), "--loop.start-in-map", "0,0,0,0,0,0,1"]
    assert run_verb(arguments) == 2
    assert "--map OLD" in capsys.readouterr().err
