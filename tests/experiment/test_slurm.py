"""Jobs as an array on a Slurm cluster, with programs that stand in for sbatch, squeue and scancel."""

import csv
import json
import os
import stat
import sys
from contextlib import closing

import pytest
from tiny import PLAN, write_plan

from vislam.cli import run_verb
from vislam.core.errors import UsageError
from vislam.experiment import slurm
from vislam.experiment.jobs import expand
from vislam.experiment.plan import load_plan
from vislam.experiment.slurm import run_on_slurm

pytestmark = pytest.mark.usefixtures("jobs_in_this_process")

# runs the tasks of the array one after the other, as a cluster with one slot would, and forgets it then
SBATCH = """
import os, pathlib, re, subprocess, sys
here = pathlib.Path(__file__).parent
script = pathlib.Path(sys.argv[-1])
(here / "asked.txt").write_text(" ".join(sys.argv[1:-1]))
assert "SLURM_ARRAY_TASK_ID" in script.read_text()
last = int(re.search("--array=0-([0-9]+)", script.read_text())[1])
child = '''
import os, pathlib, subprocess, sys
here, script, last = pathlib.Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
for task in range(last + 1):
    if not (here / "cancelled").exists():
        subprocess.run(["sh", script], env={**os.environ, "SLURM_ARRAY_TASK_ID": str(task)})
(here / "running").unlink()
'''
(here / "running").touch()
subprocess.Popen([sys.executable, "-c", child, str(here), str(script), str(last)],
                 stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
print("4711;cluster")
"""
SQUEUE = """
import pathlib
if (pathlib.Path(__file__).parent / "running").exists():
    print("4711_0")
"""
SCANCEL = """
import pathlib, sys
(pathlib.Path(__file__).parent / "cancelled").write_text(sys.argv[1])
"""


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """A folder on the path with the three programs."""
    place = tmp_path / "bin"
    place.mkdir()
    for name, text in (("sbatch", SBATCH), ("squeue", SQUEUE), ("scancel", SCANCEL)):
        (place / name).write_text(f"#!{sys.executable}\n{text}")
        (place / name).chmod(stat.S_IRWXU)
    monkeypatch.setenv("PATH", f"{place}{os.pathsep}{os.environ['PATH']}")
    return place


@pytest.fixture
def specs(tmp_path):
    return [job.spec() for job in expand(load_plan(write_plan(tmp_path)))]


def compare(folder, capsys, out, *more):
    places = ["--store", str(folder / out / "r.db"), "--cache", str(folder / "cache"), "--out", str(folder / out)]
    code = run_verb(["compare", str(folder / "tiny.toml"), *places, "--json", *more])
    return code, json.loads(capsys.readouterr().out)


def test_a_cluster_gives_the_bytes_that_this_machine_gives(cluster, tmp_path, capsys):
    write_plan(tmp_path, PLAN.replace("[0, 1]", "[0]").partition('\n[[estimators]]\nname = "slow')[0])
    here = compare(tmp_path, capsys, "here")
    there = compare(tmp_path, capsys, "there", "--engine", "slurm", "--sbatch=--partition=cpu --mem=4G")
    assert here[0] == there[0] == 0
    assert there[1]["new"] == 1
    assert (cluster / "asked.txt").read_text() == "--parsable --partition=cpu --mem=4G"
    tables = [list(csv.DictReader((tmp_path / out / "runs.csv").open())) for out in ("here", "there")]
    ours, theirs = ([row["sha256"] for row in rows] for rows in tables)
    assert ours == theirs
    assert here[1]["table_sha256"] == there[1]["table_sha256"]
    assert all(theirs)
    assert (tmp_path / "here" / "winners.csv").read_bytes() == (tmp_path / "there" / "winners.csv").read_bytes()
    assert compare(tmp_path, capsys, "there", "--engine", "slurm")[1]["new"] == 0


def test_a_task_that_dies_is_a_failed_job_with_what_it_said(cluster, specs, tmp_path, monkeypatch):
    monkeypatch.setattr(slurm, "_GRACE_S", 0.1)
    broken = [{**specs[0], "key": "a"}]
    del broken[0]["key"]  # the task cannot even answer: where would it keep the run?
    results = list(run_on_slurm(broken, "", tmp_path / "cache", tmp_path / "kept", tmp_path / "slurm", poll_s=0.05))
    assert results[0][1]["status"] == "failed"
    assert results[0][1]["reason"].startswith("crash: the task ended without a result; last said: ")
    assert "KeyError: 'key'" in results[0][1]["reason"]


def test_stopping_cancels_the_array(cluster, specs, tmp_path):
    with closing(run_on_slurm(specs, "", tmp_path / "cache", None, tmp_path / "slurm", poll_s=0.05)) as finished:
        assert next(finished)[1]["status"] == "ok"
    assert (cluster / "cancelled").read_text() == "4711"


@pytest.fixture
def answers(cluster, monkeypatch):
    """A cluster that runs nothing, and whose squeue answers this in turn on stderr, the last for ever."""
    monkeypatch.setattr(slurm, "_GRACE_S", 0.0)
    (cluster / "sbatch").write_text("#!/bin/sh\necho 4711\n")

    def take(*lines):
        cases = "".join(f"{n}) echo '{line}' >&2; exit 1;;\n" for n, line in enumerate(lines[:-1]))
        count = f"n=$(cat {cluster}/asked 2>/dev/null || echo 0); echo $((n + 1)) >{cluster}/asked"
        (cluster / "squeue").write_text(
            f"#!/bin/sh\n{count}\ncase $n in\n{cases}*) echo '{lines[-1]}' >&2; exit 1;;\nesac\n"
        )

    return take


GONE = "slurm_load_jobs error: Invalid job id specified"


def scripts(specs, options, folder):
    """The scripts that sbatch gets of jobs on a cluster that runs nothing."""
    run = run_on_slurm(specs, options, folder, None, folder / "slurm", poll_s=0.0)
    assert next(run)[1]["status"] == "failed"
    run.close()
    return [path.read_text() for path in sorted((folder / "slurm").glob("*/array*.sh"))]


def test_the_array_has_the_time_of_its_jobs_unless_one_asks_otherwise(answers, specs, tmp_path):
    answers(GONE)
    (script,) = scripts(specs, "", tmp_path)
    assert "#SBATCH --array=0-3\n" in script
    assert "#SBATCH --time=35\n" in script  # half an hour and five minutes
    (script,) = scripts(specs, "--time=60", tmp_path / "else")
    assert "--time" not in script


def test_more_jobs_than_an_array_holds_are_several(answers, specs, tmp_path, monkeypatch):
    answers(GONE)
    monkeypatch.setattr(slurm, "_LARGEST", 3)
    first, second = scripts(specs, "", tmp_path)
    assert "--array=0-2\n" in first
    assert "number=$((0 + SLURM_ARRAY_TASK_ID))" in first
    assert "--array=0-0\n" in second
    assert "number=$((3 + SLURM_ARRAY_TASK_ID))" in second


def test_a_scheduler_that_does_not_answer_is_no_end(cluster, answers, specs, tmp_path):
    answers("slurm_load_jobs error: Unable to contact slurm controller", "timed out", GONE)
    assert len(scripts(specs, "", tmp_path)) == 1
    assert int((cluster / "asked").read_text()) == 4  # twice without an answer, and twice gone


def test_no_cluster_and_a_refusal_are_told(cluster, specs, tmp_path, monkeypatch):
    (cluster / "sbatch").write_text("#!/bin/sh\necho 'invalid partition specified: gpu' >&2; exit 1\n")
    with pytest.raises(UsageError, match="refused: invalid partition specified: gpu"):
        next(run_on_slurm(specs, "--partition=gpu", tmp_path, None, tmp_path / "slurm"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match=r"--engine slurm needs sbatch: .* run this on a machine that submits"):
        next(run_on_slurm(specs, "", tmp_path, None, tmp_path / "slurm"))


def test_options_for_sbatch_without_slurm_are_refused(tmp_path, capsys):
    write_plan(tmp_path)
    assert run_verb(["compare", str(tmp_path / "tiny.toml"), "--sbatch=--mem=4G"]) == 2
    assert "--sbatch is for --engine slurm" in capsys.readouterr().err
