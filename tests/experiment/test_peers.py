"""Known systems as commands: found in an interpreter of their own, refused with what to install, run beside ours."""

import json
import os
import shutil
import stat
import sys

import numpy as np
import pytest
from tiny import write_plan

from vislam.cli import run_verb
from vislam.core.errors import UsageError
from vislam.experiment import peers
from vislam.experiment.commands import identity
from vislam.experiment.plan import load_plan
from vislam.trajectory import read_tum

pytestmark = pytest.mark.usefixtures("jobs_in_this_process")

# plays pyorbslam3: it follows along x by a metre a frame and saves what it was asked; the driver is the real one
ORBSLAM3 = """
import enum
from types import SimpleNamespace

import numpy as np

Sensor = enum.Enum("Sensor", "RGBD IMU_STEREO IMU_MONOCULAR")


class Slam:
    def __init__(self, vocabulary, settings, sensor):
        assert open(vocabulary).read() == "words"
        text = open(settings).read()
        assert "IMU.Frequency: 200.0" in text and "Camera.fps: 5" in text, text
        self.inertial, self.kept = sensor is not Sensor.RGBD, []

    def track_stereo(self, left, right, t_s, samples):
        assert left.shape == right.shape and left.ndim == 2 and samples.shape[1] == 7
        T = np.eye(4)
        T[0, 3] = len(self.kept)
        self.kept.append(t_s)
        return SimpleNamespace(pose_valid=len(self.kept) > 1, pose_wc=T.tolist())

    def shutdown(self):
        pass

    def save_trajectory_euroc(self, path):
        rows = [f"{t_s * 1e9:.6f} {i} 0 0 0 0 0 1" for i, t_s in enumerate(self.kept)]
        open(path, "w").write("\\n".join(rows))
"""
WORLD = "sim:handheld-room,rig=stereo,image_width_px=160,camera_hz=5,exposure_s=0,duration_s=4"
PLAN = f"""
name = "tiny"
members = 1
[[sequences]]
name = "room"
source = "{WORLD}"
[[sequences]]
name = "points"
source = "points:laps"
[[sequences]]
name = "one camera"
source = "{WORLD}"
config = {{"frontend.mode" = "mono"}}
"""


@pytest.fixture
def python(tmp_path):
    """An interpreter that has the stand-in's package and what drivers need, as an environment of its own would."""
    place = tmp_path / "site"
    (place / "pyorbslam3").mkdir(parents=True)
    (place / "pyorbslam3" / "__init__.py").write_text(ORBSLAM3)
    (place / "pyorbslam3-0.9.dist-info").mkdir()
    (place / "pyorbslam3-0.9.dist-info" / "METADATA").write_text("Name: pyorbslam3\nVersion: 0.9\n")
    script = tmp_path / "python3"
    script.write_text(f'#!/bin/sh\nPYTHONPATH="{place}" exec {sys.executable} "$@"\n')
    script.chmod(stat.S_IRWXU)
    return script


@pytest.fixture
def vocabulary(tmp_path, monkeypatch):
    (tmp_path / "voc.txt").write_text("words")
    monkeypatch.setenv(peers.VOCABULARY, str(tmp_path / "voc.txt"))


def command(asked):
    return peers.command_of(asked, os.environ)


def test_a_peer_is_the_command_of_its_driver_with_the_version_of_its_package(python, vocabulary):
    words = command(f"orbslam3={python}")
    assert words[0] == str(python)
    assert words[1].endswith("peer_drivers/orbslam3_peer.py")
    assert words[-2:] == ("{final}", "pyorbslam3 0.9")
    assert "pyorbslam3" not in sys.modules


def test_without_a_name_it_is_the_first_interpreter_in_path_that_has_it(python, vocabulary, monkeypatch):
    monkeypatch.setenv("PATH", f"{python.parent}{os.pathsep}{os.environ['PATH']}")
    assert command("orbslam3")[0] == str(python)


def test_one_that_is_not_installed_says_what_to_install_and_under_which_licence(python, vocabulary, monkeypatch):
    with pytest.raises(UsageError, match=r"python3 has no depthai\. vislam installs nothing .* Basalt \(BSD-3, .*pip"):
        command(f"basalt={python}")
    with pytest.raises(
        UsageError, match=r"no interpreter '/no/python'\. .* ORB-SLAM3 \(GPL-3\.0\) .* install pyorbslam3"
    ):
        command("orbslam3=/no/python")
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(UsageError, match=r"no Python in PATH\. .*then --peer orbslam3=peers/bin/python"):
        command("orbslam3")
    with pytest.raises(UsageError, match="no peer 'vins'; there are: orbslam3, basalt"):
        command("vins")


def test_a_vocabulary_is_asked_for(python, monkeypatch):
    monkeypatch.delenv(peers.VOCABULARY, raising=False)
    with pytest.raises(
        UsageError, match=r"ORBSLAM3_VOCABULARY names no vocabulary; .*orbslam3_vocabulary\.py OUT\.txt"
    ):
        command(f"orbslam3={python}")


def test_all_that_a_driver_consists_of_identifies_its_results(python, vocabulary, tmp_path, monkeypatch):
    before = identity(command(f"orbslam3={python}"))
    shutil.copytree(peers.DRIVERS, tmp_path / "drivers")
    monkeypatch.setattr(peers, "DRIVERS", tmp_path / "drivers")
    assert identity(command(f"orbslam3={python}")) == before  # wherever it lies
    with (tmp_path / "drivers" / "slam_recording.py").open("a") as file:
        file.write("# another\n")
    assert identity(command(f"orbslam3={python}")) != before


def test_it_runs_beside_ours_on_what_it_can_read_and_pays_for_itself(python, vocabulary, tmp_path, capsys):
    path = write_plan(tmp_path, PLAN)
    plan = load_plan(path, known=[f"orbslam3={python}"])
    assert plan.estimators[0].sequences == ("room", "one camera")
    text = PLAN.split('[[sequences]]\nname = "points"', maxsplit=1)[0]
    text += f'[[estimators]]\nname = "other"\npeer = "orbslam3={python}"\n'
    write_plan(tmp_path, text)
    places = ["--store", str(tmp_path / "r.db"), "--cache", str(tmp_path / "cache"), "--out", str(tmp_path / "out")]
    kept = ["--keep-runs", str(tmp_path / "kept")]
    assert run_verb(["compare", str(path), *places, *kept, "--peer", f"orbslam3={python}", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["failed"] == 0
    rows = json.loads((tmp_path / "out" / "manifest.json").read_text())["results"]
    assert {row["unit"][2] for row in rows} == {"other", "orbslam3"}
    assert len({row["key"] for row in rows}) == 1  # one program, one run
    by_output = {row["output"]: row for row in rows}
    assert by_output["causal"]["first_pose_s"] == pytest.approx(0.2)  # it has no pose for its first frame
    assert by_output["final"]["completeness"] > 0.9
    assert by_output["final"]["cpu_ms_per_frame"] > 0.0
    assert 20.0 < by_output["final"]["peak_memory_mb"] < 400.0
    (run,) = (tmp_path / "kept").iterdir()
    final = read_tum(run / "trajectory_final.tum")
    assert np.linalg.norm(np.diff(final.positions_m, axis=0), axis=1) == pytest.approx(1.0)
    published = read_tum(run / "trajectory_causal.tum")
    assert len(published) == len(final) - 1
    assert final.T_world_body[-1] == pytest.approx(published.T_world_body[-1])  # where down is comes from those


def test_what_it_cannot_read_is_told_before_anything_runs(python, vocabulary, tmp_path, monkeypatch):
    blind = PLAN.replace(WORLD, "points:laps")
    with pytest.raises(UsageError, match=r"'orbslam3' can run on none of the sequences: it needs a recording on disk"):
        load_plan(write_plan(tmp_path, blind), known=[f"orbslam3={python}"])
    both = PLAN + f'[[estimators]]\nname = "x"\npeer = "orbslam3={python}"\nprogram = "mine.py"\n'
    with pytest.raises(UsageError, match="'x' is either a peer, a program or a command"):
        load_plan(write_plan(tmp_path, both))
    monkeypatch.setattr(peers, "command_of", lambda asked, variables: ("true", "{causal}"))
    stereo_only = load_plan(write_plan(tmp_path, PLAN), known=["basalt"])
    assert stereo_only.estimators[0].sequences == ("room",)
