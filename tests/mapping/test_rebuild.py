import json
import re
import shutil
from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest

from session_entries import editing
from vislam.cli import run_verb
from vislam.config import Config, ImuConfig, MapConfig, ViewConfig
from vislam.core.errors import DataError, UsageError
from vislam.datasets.recorder import record
from vislam.mapping.formats.ply import read_ply
from vislam.mapping.octree.octomap_io import read_octree
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.offline.rebuild import map_settings, rebuild
from vislam.runs.report import write_report
from vislam.runs.sources import open_source
from vislam.sim import open_world

PRODUCTS = ("cloud", "octomap", "grid", "drive")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run of a few keyframes, of a recording that is there."""
    folder = tmp_path_factory.mktemp("rebuild")
    record(open_world("handheld-room", duration_s=2.0, camera_hz=5.0, image_width_px=160), folder / "recording")
    source, out = str(folder / "recording"), folder / "run"
    config = Config(imu=ImuConfig(enabled=False), map=MapConfig(products=PRODUCTS), view=ViewConfig(enabled=False))
    prepare(out, False)
    execute(open_source(source, 0), config, out, source=source, command=["test"])
    return out


def test_the_same_settings_give_the_same_files(run, tmp_path):
    told = []
    answer = rebuild(run, map_settings(run).map, tmp_path, "graph", lambda *step: told.append(step))
    assert answer["depth"] == "session"
    assert answer["left_out"] == {}
    for path in answer["written"].values():
        name = path.rpartition("/")[2]
        assert (tmp_path / name).read_bytes() == (run / "map" / name).read_bytes()
    done, totals, notes = zip(*told, strict=True)
    assert set(totals) == {answer["keyframes"] + len(PRODUCTS)}
    assert list(done) == sorted(done)
    assert notes[-len(PRODUCTS) :] == PRODUCTS
    settings = json.loads((tmp_path / "map.json").read_text())
    assert settings["settings"]["resolution_m"] == 0.05


def test_another_resolution_and_other_products(run, tmp_path):
    config = replace(
        map_settings(run).map, resolution_m=0.1, cloud_voxel_m=0.05, products=("pcd", "octomap", "surfels")
    )
    answer = rebuild(run, config, tmp_path, "graph")
    assert set(answer["written"]) == {"pcd", "octomap", "surfels"}
    assert read_octree(tmp_path / "octomap.bt").resolution_m == 0.1
    points = int(re.search(rb"POINTS (\d+)", (tmp_path / "cloud.pcd").read_bytes())[1])
    assert 0 < points < len(read_ply(run / "map" / "cloud.ply")[0])


def test_other_filters_read_the_recording_again(run, tmp_path):
    config = map_settings(run).map
    answer = rebuild(run, replace(config, edge_px=config.edge_px + 2), tmp_path, "graph")
    assert answer["depth"] == "recording"
    assert len(read_ply(tmp_path / "cloud.ply")[0]) < len(read_ply(run / "map" / "cloud.ply")[0])
    # what the recording gives with the run's own settings is what the run kept
    other = shutil.copytree(run, tmp_path / "copy")
    _write_config(other, replace(map_settings(run), map=replace(config, enabled=False)))
    again = rebuild(other, config, tmp_path / "again", "graph")
    assert again["depth"] == "recording"
    assert (tmp_path / "again" / "octomap.bt").read_bytes() == (run / "map" / "octomap.bt").read_bytes()


def _write_config(run, config):
    data = asdict(config)
    with editing(run / "session.db") as db:
        db.execute("UPDATE info SET value = ? WHERE key = 'config'", (json.dumps(data),))
    (run / "config.json").write_text(json.dumps(data))


def test_stored_pictures_of_odd_shapes_are_reported_small(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    tall = cv2.imencode(".png", np.zeros((900_000, 1), np.uint8))[1].tobytes()
    with editing(tmp_path / "run" / "session.db") as db:
        db.execute("UPDATE scans SET colors = ?", (tall,))
    assert write_report(tmp_path / "run").is_file()


def test_poses_of_another_estimate(run, tmp_path):
    moved = tmp_path / "run"
    shutil.copytree(run, moved)
    rows = [line.split() for line in (run / "trajectory_graph.tum").read_text().splitlines() if line[0] != "#"]
    text = "".join(f"{r[0]} {float(r[1]) + 10.0} {' '.join(r[2:])}\n" for r in rows)
    (moved / "trajectory_batch.tum").write_text(text)
    config = replace(map_settings(moved).map, products=("octomap",))
    rebuild(moved, config, tmp_path / "out", "batch")
    here, there = (read_octree(path / "octomap.bt").occupied_voxels() for path in (run / "map", tmp_path / "out"))
    shift = (np.median(there, axis=0) - np.median(here, axis=0)) * 0.05
    np.testing.assert_allclose(shift, [10.0, 0.0, 0.0], atol=0.25)
    with pytest.raises(UsageError, match="there are: batch, ekf, graph"):
        rebuild(moved, config, tmp_path / "out", "best")


def test_the_verb(run, tmp_path, capsys):
    copy = shutil.copytree(run, tmp_path / "run")
    before = (copy / "map" / "cloud.ply").read_bytes()
    verb = ["map", str(copy), "--resolution-m", "0.1", "--products", "octomap", "drive", "--json"]
    assert run_verb(verb) == 0
    answer = json.loads(capsys.readouterr().out)
    assert set(answer["written"]) == {"octomap", "drive", "drive_yaml"}
    assert (copy / "map" / "cloud.ply").read_bytes() == before  # what was not asked for stays
    assert (copy / "report.html").stat().st_size > 10_000
    assert run_verb(["map", str(copy / "map" / "octomap.bt"), "--info"]) == 0
    assert "0.1" in capsys.readouterr().out


def test_what_cannot_be_made_again_is_said(run, tmp_path, capsys):
    assert run_verb(["map", str(tmp_path)]) == 3
    assert "no session at" in capsys.readouterr().err
    broken = shutil.copytree(run, tmp_path / "broken")
    (broken / "session.db").write_bytes((run / "session.db").read_bytes()[:5000])
    with pytest.raises(DataError):
        rebuild(broken, MapConfig(), tmp_path / "out", "graph")
    assert run_verb(["map", str(broken)]) == 3
    text = capsys.readouterr().err
    assert text.startswith("vislam: ")
    assert "Traceback" not in text
