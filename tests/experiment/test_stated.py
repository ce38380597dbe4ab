"""Covariances that estimators by others give with their poses: read, refused, and judged as ours are."""

import json
import sys

import numpy as np
import pytest
from tiny import PLAN, write_plan

from vislam.cli import run_verb
from vislam.config import load as load_config
from vislam.core.errors import DataError
from vislam.datasets import open_dataset
from vislam.datasets.recorder import record
from vislam.experiment.commands import run_command
from vislam.experiment.measures import output_measures
from vislam.experiment.programs import ProgramError, run_program
from vislam.experiment.stated import checked, split_stated
from vislam.runs.sources import open_source
from vislam.sim import open_points
from vislam.trajectory import read_tum
from vislam.trajectory.states import read_states_csv

pytestmark = pytest.mark.usefixtures("jobs_in_this_process")

# knows the truth, errs by what it says, times what it is told to; its first pose is sure
HONEST = """
import numpy as np
from scipy.spatial.transform import Rotation
from vislam.sim import open_points
from vislam.trajectory import Trajectory

class Honest:
    def __init__(self, setup, claimed=1.0):
        self.truth = open_points("laps", seed=setup.seed, duration_s=40.0, tracks=10, camera_hz=10.0).truth()
        self.rng, self.claimed, self.known = np.random.default_rng(3), claimed, []
        self.root = self.rng.normal(0.0, 0.02, (6, 6))

    def inertial(self, sample):
        pass

    def frame(self, frame):
        T = self.truth.at(frame.t_ns)
        if not self.known:
            P = np.zeros((6, 6))
        else:
            error, P = self.root @ self.rng.normal(size=6), self.claimed * self.root @ self.root.T
            T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(error[:3]).as_matrix()
            T[:3, 3] += error[3:]
        self.known.append((frame.t_ns, T, P))
        return T, P

    def answer(self):
        t_ns, T, P = map(np.array, zip(*self.known))
        P[5] = np.nan  # of one nothing is known
        return Trajectory(t_ns, T), P
"""


def run(folder, text=HONEST, **options):
    (folder / "honest.py").write_text(text)
    (folder / "run").mkdir(exist_ok=True)
    recording = open_points("laps", seed=0, duration_s=40.0, tracks=10, camera_hz=10.0)
    metrics = run_program(str(folder / "honest.py"), options, recording, load_config(None, {}), folder / "run")
    span = (0, recording.frame_count * 10**8)
    return output_measures(folder / "run", ["causal", "final"], metrics, span)


def test_exact_covariances_have_a_nees_of_one_and_ones_four_times_too_small_of_four(tmp_path):
    for claimed, expected in ((1.0, 1.0), (0.25, 4.0)):
        for name, found in run(tmp_path, claimed=claimed).items():
            assert set(found["anees"]) == {"rotation", "position"}  # it says nothing of velocities
            for entry in found["anees"].values():
                assert entry["mean"] / expected == pytest.approx(1.0, abs=0.15)  # 400 times 3 degrees of freedom
                assert 0.85 < entry["low"] < 1.0 < entry["high"] < 1.15
                assert entry["count"] == (399 if name == "causal" else 398)


def test_without_covariances_there_is_no_nees(tmp_path):
    measured = run(
        tmp_path, HONEST.replace("return T, P", "return T").replace("Trajectory(t_ns, T), P", "Trajectory(t_ns, T)")
    )
    assert all("anees" not in entry for entry in measured.values())
    assert not list((tmp_path / "run").glob("states_*"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("return T, P", "return T, P[:3, :3]"),
            r"frame 0 at \d+ ns: a covariance is an array \[6, 6\] .* not \[3, 3\]",
        ),
        (("return T, P", "return T, P - np.eye(6)"), "frame 0 .* symmetric with eigenvalues of at least 0"),
        (("return T, P", "return T, P + np.inf"), "frame 0 .* the covariance is not finite; leave it away"),
        (("return T, P", "return T, 'sure'"), "frame 0 .* could not convert string"),
        (("T), P", "T), 'sure'"), r"answer\(\): could not convert string .*; covariances \[N, 6, 6\] are wanted"),
        (("T), P", "T), P[:2]"), r"answer\(\) gave 400 poses and 2 covariances"),
    ],
)
def test_what_is_no_covariance_is_told_with_its_place(tmp_path, change, message):
    assert change[0] in HONEST
    with pytest.raises(ProgramError, match=message):
        run(tmp_path, HONEST.replace(*change))


def line(t, P=None, nan=False):
    upper = [] if P is None else (P[np.triu_indices(6)] * (np.nan if nan else 1.0)).tolist()
    return " ".join(map(repr, [float(t), 1.0, 2.0, float(t), 0.0, 0.0, 0.0, 1.0, *upper]))


def test_a_file_gives_up_its_covariances_and_keeps_its_poses(tmp_path):
    root = np.random.default_rng(0).normal(size=(6, 6))
    P = root @ root.T
    tum, states = tmp_path / "trajectory_causal.tum", tmp_path / "states.csv"
    tum.write_text("# mine\n" + "\n".join([line(1, P), line(2, P, nan=True), line(3, 2 * P)]) + "\n")
    split_stated(tum, states)
    assert read_tum(tum).t_ns.tolist() == [10**9, 2 * 10**9, 3 * 10**9]
    found = read_states_csv(states)[1]
    assert [s.t_ns for s in found] == [10**9, 3 * 10**9]
    assert np.allclose([s.covariance[:6, :6] for s in found], [P, 2 * P], rtol=1e-15)
    assert np.isnan(found[0].covariance[6:]).all()
    before = tum.read_bytes()
    split_stated(tum, tmp_path / "none.csv")  # now it has none
    assert tum.read_bytes() == before
    assert not (tmp_path / "none.csv").exists()


def test_a_damaged_file_is_told_with_its_line(tmp_path):
    P, tum = np.eye(6), tmp_path / "a.tum"
    tum.write_text(line(1, P) + "\n" + line(2, -P))
    with pytest.raises(DataError, match=r"a\.tum:2: the covariance is not symmetric"):
        split_stated(tum, tmp_path / "s.csv")
    tum.write_text(line(1, P) + "\n" + line(2))
    with pytest.raises(DataError, match=r"a\.tum:2: expected 29 columns, got 8"):
        split_stated(tum, tmp_path / "s.csv")
    with pytest.raises(DataError, match="not finite"):
        checked(P * np.nan, "here")


# reads a EuRoC folder and its truth; says in how many metres it may be wrong
PEER = """
import pathlib, random, sys
recording, final, claimed_m = sys.argv[1:]
random.seed(1)
frames = sorted(int(p.stem) for p in pathlib.Path(recording, "mav0", "cam0", "data").iterdir())
truth = {}
for row in pathlib.Path(recording, "mav0", "mocap0", "data.csv").read_text().splitlines():
    if row[0] != "#":
        t, x, y, z, qw, qx, qy, qz = row.split(",")[:8]
        truth[int(t)] = [float(v) for v in (x, y, z, qx, qy, qz, qw)]
rows = []
for t in frames:
    pose = list(truth[min(truth, key=lambda s: abs(s - t))])
    sigma = 0.05 if rows else 1e-9
    pose[:3] = [v + random.gauss(0.0, sigma) for v in pose[:3]]
    variance = (float(claimed_m) if rows else 1e-9) ** 2
    upper = [(variance if i > 2 else 1e-8) if i == j else 0.0 for i in range(6) for j in range(i, 6)]
    rows.append(f"{t // 10**9}.{t % 10**9:09d} " + " ".join(map(repr, pose + upper)))
pathlib.Path(final).write_text("\\n".join(rows) + "\\n")
"""


def test_a_program_of_its_own_gives_them_as_further_columns(tmp_path):
    record(
        open_source("sim:handheld-room,rig=mono,image_width_px=96,camera_hz=20,exposure_s=0,duration_s=4", 0),
        tmp_path / "room",
    )
    (tmp_path / "peer.py").write_text(PEER)
    recording = open_dataset(f"euroc:{tmp_path / 'room'}")
    found = {}
    for claimed_m in ("0.05", "0.025"):
        out = tmp_path / claimed_m
        out.mkdir()
        words = [sys.executable, str(tmp_path / "peer.py"), "{recording}", "{final}", claimed_m]
        metrics = run_command(words, tmp_path / "room", recording, load_config(None, {}), out)
        found[claimed_m] = output_measures(out, ["final"], metrics, None)["final"]["anees"]["position"]
    assert found["0.05"]["mean"] == pytest.approx(1.0, abs=0.25)  # 80 poses
    assert found["0.025"]["mean"] / found["0.05"]["mean"] == pytest.approx(4.0, rel=1e-3)


def test_a_report_tells_them_beside_ours(tmp_path, capsys):
    text = HONEST.replace("duration_s=40.0, tracks=10", "duration_s=5.0, tracks=40")
    (tmp_path / "honest.py").write_text(text)
    plan = PLAN.replace("[0, 1]", "[0]").split('[[estimators]]\nname = "slow')[0]
    path = write_plan(tmp_path, plan)
    places = ["--store", str(tmp_path / "r.db"), "--cache", str(tmp_path / "cache"), "--out", str(tmp_path / "out")]
    assert run_verb(["compare", str(path), *places, "--estimator", str(tmp_path / "honest.py"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["failed"] == 0
    rows = json.loads((tmp_path / "out" / "manifest.json").read_text())["results"]
    told = {(row["unit"][2], row["output"]): row.get("anees_position") for row in rows}
    assert 0.5 < told["honest", "causal"] < 2.0
    assert 0.5 < told["honest", "final"] < 2.0
    assert told["loose", "ekf"] is not None
