"""Estimators that are not vislam's in a comparison: found, run on the pipeline's measurements, refused by name."""

import json

import numpy as np
import pytest
from tiny import PLAN, write_plan

from vislam.cli import run_verb
from vislam.config import load as load_config
from vislam.core.errors import UsageError
from vislam.core.messages import ImuSample
from vislam.experiment.jobs import expand
from vislam.experiment.plan import load_plan
from vislam.experiment.programs import ProgramError, identity, load, run_program
from vislam.sim import open_points
from vislam.trajectory import read_tum

pytestmark = pytest.mark.usefixtures("jobs_in_this_process")

STILL = """
import numpy as np
from vislam.trajectory import Trajectory

class Still:
    def __init__(self, setup, x_m=0.0):
        self.setup, self.t_ns, self.samples = setup, [], 0
        self.T = np.eye(4)
        self.T[0, 3] = x_m

    def inertial(self, sample):
        self.samples += 1

    def frame(self, frame):
        self.t_ns.append(frame.t_ns)
        return self.T if self.samples > 100 else None

    def answer(self):
        return Trajectory(np.array(self.t_ns), np.array([self.T] * len(self.t_ns)))
"""


@pytest.fixture
def program(tmp_path):
    """Write a file and return what names it as an estimator."""

    def write(text=STILL, cls=""):
        (tmp_path / "mine.py").write_text(text)
        return str(tmp_path / "mine.py") + cls

    return write


def world(**options):
    return open_points("laps", seed=0, **{"duration_s": 2.0, "tracks": 30, "camera_hz": 10.0, **options})


def run(program, out, config=None, **options):
    out.mkdir(exist_ok=True)
    return run_program(program, options, world(), load_config(None, config or {}), out)


def test_it_gets_all_measurements_and_its_answers_are_written(program, tmp_path):
    metrics = run(program(), tmp_path / "run", x_m=2.5)
    known, final, truth = (read_tum(tmp_path / "run" / f"trajectory_{n}.tum") for n in ("causal", "final", "truth"))
    assert metrics["frames"] == len(final) == sum(not isinstance(v, ImuSample) for v in world().events())
    assert 0 < len(known) < len(final)
    assert metrics["cost"]["first_pose_s"] == pytest.approx((known.t_ns[0] - final.t_ns[0]) * 1e-9)
    assert np.all(final.positions_m == [2.5, 0.0, 0.0])
    assert len(truth)
    assert metrics["has_imu"]


def test_settings_about_measurements_hold_for_it(program, tmp_path):
    text = STILL.replace("self.samples += 1", "raise AssertionError('heard of the IMU')")
    with pytest.raises(ProgramError, match="heard of the IMU"):
        run(program(text), tmp_path / "run")
    metrics = run(program(text), tmp_path / "run", {"imu.enabled": False})
    assert not metrics["has_imu"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("self.samples += 1", "self.samples / 0"), r"inertial sample at \d+ ns: ZeroDivisionError"),
        (("self.T if", "np.eye(3) if"), r"frame 5 at \d+ ns: a pose is an array \[4, 4\], not \[3, 3\]"),
        (("self.T if", "2 * self.T if"), "is no rigid motion"),
        (("self.T if", "self.T * np.nan if"), "is no rigid motion"),
        (("self.T if", "'here' if"), "a pose .4, 4. is wanted"),
        (("return Trajectory(", "return ("), r"answer\(\) gave tuple; a Trajectory is wanted"),
        (("[self.T] *", "[2 * self.T] *"), "in the end: DataError: pose 0"),
        (("self.T = np.eye(4)", "raise RuntimeError('no licence')"), "at the start: RuntimeError: no licence"),
    ],
)
def test_what_it_does_wrong_is_told_with_its_name_and_place(program, tmp_path, change, message):
    assert change[0] in STILL
    with pytest.raises(ProgramError, match=message) as told:
        run(program(STILL.replace(*change)), tmp_path / "run")
    assert str(tmp_path / "mine.py") in str(told.value)


def test_what_it_knew_before_it_failed_is_kept(program, tmp_path):
    text = STILL.replace(
        "self.t_ns.append(frame.t_ns)", "self.t_ns.append(frame.t_ns)\n        assert len(self.t_ns) < 10"
    )
    with pytest.raises(ProgramError, match="frame 9"):
        run(program(text), tmp_path / "run")
    assert len(read_tum(tmp_path / "run" / "trajectory_causal.tum")) < 10
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["frames"] == 9


@pytest.mark.parametrize(
    ("text", "cls", "message"),
    [
        (STILL, ":Moving", "no class 'Moving'; there are: Still"),
        (STILL.replace("def answer", "def reply"), ":Still", "'Still' has no method 'answer'; it needs inertial"),
        (STILL.replace("def answer", "def reply"), "", "0 of Still have them"),
        (STILL + STILL.replace("Still", "Other"), "", "2 of Other, Still have them; name it as .*mine.py:CLASS"),
        ("import nothing_of_this_name", "", "ModuleNotFoundError"),
        ("class Still\n", "", "SyntaxError"),
    ],
)
def test_a_file_without_an_estimator_is_refused_before_anything_runs(program, text, cls, message):
    with pytest.raises(UsageError, match=message):
        load(program(text, cls))


def test_options_that_the_class_does_not_take_are_refused(program, tmp_path):
    with pytest.raises(UsageError, match=r"Still\(setup, \*\*options\): got an unexpected keyword argument 'y_m'"):
        run(program(), tmp_path / "run", y_m=1.0)


def test_a_missing_file_and_a_missing_module_are_refused(tmp_path):
    with pytest.raises(UsageError, match=r"there is no file .*absent\.py"):
        load(str(tmp_path / "absent.py"))
    with pytest.raises(UsageError, match="No module named 'absent_package'"):
        load("absent_package.estimators:Mine")


def test_a_class_of_an_installed_package_is_found_and_identified_by_all_of_it(tmp_path, monkeypatch):
    package = tmp_path / "own_estimators"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "still.py").write_text(STILL)
    monkeypatch.syspath_prepend(tmp_path)
    before = identity("own_estimators.still:Still")
    assert before.startswith("Still ")
    assert load("own_estimators.still").__name__ == "Still"
    (package / "__init__.py").write_text("NEW = 1\n")
    assert identity("own_estimators.still:Still") != before


def test_a_file_beside_it_can_be_imported(program, tmp_path):
    (tmp_path / "beside_mine.py").write_text(STILL)
    text = "from beside_mine import Still\nclass Mine(Still):\n    pass\n"
    assert load(program(text)).__name__ == "Mine"


def compare(folder, capsys, *more):
    places = ["--store", str(folder / "r.db"), "--cache", str(folder / "cache"), "--out", str(folder / "out")]
    code = run_verb(["compare", str(folder / "tiny.toml"), *places, "--json", *more])
    return code, json.loads(capsys.readouterr().out)


def test_a_plan_runs_it_beside_the_pipeline_and_the_numbers_come_out_again(program, tmp_path, capsys):
    own = '\n[[estimators]]\nname = "mine"\nprogram = "mine.py"\noptions = {x_m = 1.0}\n'
    write_plan(tmp_path, PLAN.replace("[0, 1]", "[0]").partition('\n[[estimators]]\nname = "slow')[0] + own)
    program()
    code, data = compare(tmp_path, capsys)
    assert (code, data["results"], data["failed"]) == (0, 2, 0)
    rows = json.loads((tmp_path / "out" / "manifest.json").read_text())["results"]
    mine = {row["output"]: row for row in rows if row["unit"][2] == "mine"}
    assert set(mine) == {"causal", "final"}
    assert mine["final"]["ate_m"] > 0.1
    assert mine["final"]["cpu_ms_per_frame"] > 0.0
    assert "mine causal" in (tmp_path / "out" / "report.html").read_text()
    code, data = compare(tmp_path, capsys, "--verify", str(tmp_path / "out"), "--sample", "0")
    assert code == 0
    assert {v["outcome"] for v in data["verdicts"]} == {"identical"}
    program(STILL + "# changed\n")
    assert [job["state"] for job in compare(tmp_path, capsys, "--dry-run")[1]["jobs"]] == ["ok", "to do"]


def test_the_command_line_adds_it_to_a_plan(program, tmp_path):
    path = write_plan(tmp_path)
    plan = load_plan(path, programs=[program(), program(cls=":Still")])
    added = plan.estimators[-2:]
    assert [(e.name, e.compared) for e in added] == [("mine", ("causal", "final")), ("mine Still", ("causal", "final"))]
    jobs = expand(plan)
    assert len({job.key for job in jobs if job.estimator.startswith("mine")}) == 2  # one class, one run for each seed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('outputs = ["causal"]', 'outputs = ["ekf"]'), "estimator 'mine' has no output 'ekf'; it has causal, final"),
        (('program = "mine.py"\n', ""), "estimator 'mine' has no output 'causal'; it has ekf, live, graph, batch"),
        (('program = "mine.py"\noutputs = ["causal"]', ""), "options of estimator 'mine' are for a program"),
    ],
)
def test_mistakes_about_programs_in_a_plan_are_named(tmp_path, change, message):
    own = '\n[[estimators]]\nname = "mine"\nprogram = "mine.py"\noutputs = ["causal"]\noptions = {x_m = 1.0}\n'
    assert change[0] in own
    with pytest.raises(UsageError, match=message):
        load_plan(write_plan(tmp_path, PLAN + own.replace(*change)))
