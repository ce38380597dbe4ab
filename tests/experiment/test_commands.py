"""Systems that are programs of their own in a comparison: run, measured, and refused by name."""

import json
import sys

import pytest
from tiny import write_plan

from vislam.cli import run_verb
from vislam.config import load as load_config
from vislam.core.errors import UsageError
from vislam.datasets import open_dataset
from vislam.datasets.recorder import record
from vislam.experiment.commands import check, identity, outputs_of, run_command
from vislam.experiment.plan import load_plan
from vislam.experiment.programs import ProgramError
from vislam.runs.sources import open_source
from vislam.trajectory import read_tum

pytestmark = pytest.mark.usefixtures("jobs_in_this_process")

# reads a EuRoC folder and stands still; knows nothing of vislam
PEER = """
import pathlib, sys
recording, causal, final, mb = sys.argv[1:5]
assert "vislam" not in sys.modules
ballast = bytearray(int(mb) << 20)
stamps = sorted(int(p.stem) for p in pathlib.Path(recording, "mav0", "cam0", "data").iterdir())
for path, skip in ((causal, 2), (final, 0)):
    rows = [f"{t // 10**9}.{t % 10**9:09d} 1 2 3 0 0 0 1" for t in stamps[skip:]]
    pathlib.Path(path).write_text("\\n".join(rows) + "\\n")
print("done")
"""
WORLD = "sim:handheld-room,rig=stereo,image_width_px=160,camera_hz=5,exposure_s=0,duration_s=2"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("peer")
    record(open_source(WORLD, 0), folder / "room")
    (folder / "peer.py").write_text(PEER)
    return folder


def command(folder, *more):
    return [sys.executable, str(folder / "peer.py"), "{recording}", "{causal}", "{final}", *more]


def run(words, folder, out):
    out.mkdir()
    recording = open_dataset(f"euroc:{folder / 'room'}")
    return run_command(words, folder / "room", recording, load_config(None, {}), out)


def test_it_runs_over_the_folder_and_pays_for_itself_alone(folder, tmp_path):
    metrics = run(command(folder, "64"), folder, tmp_path / "run")
    causal, final = (read_tum(tmp_path / "run" / f"trajectory_{name}.tum") for name in ("causal", "final"))
    assert metrics["frames"] == len(final) == len(causal) + 2
    cost = metrics["cost"]
    assert 64.0 < cost["peak_memory_mb"] < 120.0  # this process has hundreds
    assert 0.0 < cost["cpu_s"] < 5.0
    assert cost["first_pose_s"] == pytest.approx(0.4)  # of those known in time
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == [
        "metrics.json", "trajectory_causal.tum", "trajectory_final.tum", "trajectory_truth.tum",
    ]  # fmt: skip


def test_what_goes_wrong_is_told_with_what_it_said(folder, tmp_path):
    with pytest.raises(ProgramError, match=r"exit code 1; last said: .*ValueError: invalid literal for int"):
        run(command(folder, "much"), folder, tmp_path / "one")
    silent = [sys.executable, "-c", "pass", "{causal}"]
    with pytest.raises(ProgramError, match=r"wrote no trajectory_causal\.tum"):
        run(silent, folder, tmp_path / "two")
    killed = [sys.executable, "-c", "import os; os.kill(os.getpid(), 9)", "{causal}"]
    with pytest.raises(ProgramError, match="exit code -9"):
        run(killed, folder, tmp_path / "three")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["true", "{causal}", "{map}"], r"\{map\} means nothing in a command; there are \{recording\}, \{mode\}"),
        (["true", "{recording}"], r"has nowhere to write: it needs \{causal\} or \{final\}"),
        (["no-such-slam", "{final}"], "there is no program 'no-such-slam'; install it first"),
        (["true", "{final"], "expected '}' before end of string"),
    ],
)
def test_a_command_that_cannot_run_is_refused_before_anything_does(words, message):
    with pytest.raises(UsageError, match=message):
        check(words)


def test_a_changed_file_is_another_command(folder, tmp_path):
    script = tmp_path / "peer.py"
    script.write_text(PEER)
    before = identity(["python", str(script), "{final}"])
    assert before[0] == "python"
    script.write_text(PEER + "#")
    assert identity(["python", str(script), "{final}"]) != before
    assert outputs_of(["a", "x{final}"]) == ("final",)


PLAN = """
name = "peers"
members = 1
config = {{"loop.enabled" = false}}
[[sequences]]
name = "room"
source = "{world}"
[[estimators]]
name = "vislam"
outputs = ["ekf"]
[[estimators]]
name = "peer"
command = {words}
"""


def test_a_plan_runs_it_on_a_rendered_world_beside_the_pipeline(folder, tmp_path, capsys, monkeypatch):
    words = ["$PYTHON", *command(folder, "1")[1:]]
    monkeypatch.setenv("PYTHON", sys.executable)
    write_plan(tmp_path, PLAN.format(world=WORLD.replace("duration_s=2", "duration_s=4"), words=json.dumps(words)))
    places = ["--store", str(tmp_path / "r.db"), "--cache", str(tmp_path / "cache"), "--out", str(tmp_path / "out")]
    assert run_verb(["compare", str(tmp_path / "tiny.toml"), *places, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["failed"] == 0
    rows = json.loads((tmp_path / "out" / "manifest.json").read_text())["results"]
    peer = {row["output"]: row for row in rows if row["unit"][2] == "peer"}
    assert set(peer) == {"causal", "final"}
    assert peer["final"]["ate_m"] > 0.05
    assert peer["final"]["peak_memory_mb"] < 60.0
    assert peer["final"]["completeness"] > 0.99


def test_what_is_not_on_disk_is_refused_for_it(tmp_path):
    text = PLAN.format(world="points:laps", words='["true", "{final}"]')
    with pytest.raises(UsageError, match="'peer' is a command, and 'room' is not on disk"):
        load_plan(write_plan(tmp_path, text))
    both = text.replace("points:laps", WORLD) + 'program = "mine.py"\n'
    with pytest.raises(UsageError, match="'peer' is either a program or a command"):
        load_plan(write_plan(tmp_path, both))
