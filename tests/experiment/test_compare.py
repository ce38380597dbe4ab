"""`vislam compare` from plan to report, stopped, resumed and verified."""

import csv
import json
import re
import signal
import subprocess
import sys

import pytest
from tiny import PLAN, jobs_here, write_plan

from vislam.cli import run_verb
from vislam.experiment.recordings import open_cached
from vislam.experiment.store import ResultStore
from waiting import HUNG_S, wait_for

pytestmark = pytest.mark.usefixtures("jobs_in_this_process")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    write_plan(folder)
    return folder


def arguments(folder, *more):
    places = ["--store", str(folder / "r.db"), "--cache", str(folder / "cache"), "--out", str(folder / "out")]
    return ["compare", str(folder / "tiny.toml"), *places, *more]


def answer(capsys, folder, *more):
    code = run_verb(arguments(folder, "--json", *more))
    return code, json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def compared(folder):
    """A comparison that was interrupted after its first result and taken up again."""
    command = [sys.executable, "-m", "vislam", *arguments(folder, "--workers", "1")]
    first = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # children of a background job ignore the signal unless told otherwise
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )

    def count() -> int:
        with ResultStore(folder / "r.db") as store:
            return len(store)

    wait_for(lambda: first.poll() is not None or ((folder / "r.db").is_file() and count()))
    first.send_signal(signal.SIGINT)
    _, said = first.communicate(timeout=HUNG_S)
    kept = count()
    with jobs_here():
        assert run_verb(arguments(folder, "--workers", "2")) == 0
    return first.returncode, said, kept


def test_an_interrupted_comparison_goes_on_where_it_was(compared, folder, capsys):
    code, said, kept = compared
    assert code == 130
    assert "Traceback" not in said
    assert 1 <= kept < 4
    told = answer(capsys, folder)[1]
    table = json.loads((folder / "out" / "manifest.json").read_text())["table_sha256"]
    assert told == {"out": str(folder / "out"), "results": 4, "new": 0, "failed": 0, "table_sha256": table}


def test_a_dry_run_lists_and_runs_nothing(compared, folder, capsys, tmp_path):
    code, data = answer(capsys, folder, "--dry-run")
    assert code == 0
    assert [job["state"] for job in data["jobs"]] == ["ok"] * 4
    empty = ["compare", str(folder / "tiny.toml"), "--store", str(tmp_path / "other.db"), "--dry-run"]
    assert run_verb(empty) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5
    assert all(line.startswith("to do") for line in lines[:4])
    assert lines[4] == "4 jobs, 4 different: 4 to do"
    assert not list(tmp_path.glob("out*"))


def test_the_report_needs_nothing_else_and_holds_every_number(compared, folder):
    page = (folder / "out" / "report.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', page)  # nothing from the network or from other files
    assert page.count("<svg") >= 4
    for part in ("Accuracy", "Consistency", "Is the difference real?", "loose filter, causal", "NIS", "Failures"):
        assert part in page
    rows = list(csv.DictReader((folder / "out" / "runs.csv").open()))
    assert len(rows) == 4 * 2
    assert all(row["status"] == "ok" and len(row["sha256"]) == 64 for row in rows)
    final = [float(row["ate_m"]) for row in rows if row["output"] == "graph"]
    assert all(0.0 < ate < 0.3 for ate in final)
    assert all(0.0 <= float(row["initialisation_s"]) < 3.0 for row in rows)  # stereo has a pose at once
    for name in ("cpu_s_per_s", "cpu_ms_per_frame", "peak_memory_mb", "latency_p50_ms", "completeness"):
        assert all(float(row[name]) > 0.0 for row in rows), name
    assert r"\toprule" in (folder / "out" / "table.tex").read_text()


def test_late_vision_changes_what_is_known_in_time_and_not_the_frames(compared, folder):
    rows = list(csv.DictReader((folder / "out" / "runs.csv").open()))
    by = {(row["estimator"], row["output"], row["seed"]): row for row in rows}
    for seed in ("0", "1"):
        prompt, late = by["loose", "ekf", seed], by["slow vision", "ekf", seed]
        assert prompt["sha256"] != late["sha256"]
        assert prompt["completeness"] == late["completeness"]


def test_numbers_that_come_out_again_are_verified(compared, folder, capsys):
    code, data = answer(capsys, folder, "--verify", str(folder / "out"), "--sample", "1")
    assert code == 0
    assert [v["outcome"] for v in data["verdicts"]] == ["identical", "identical"]
    assert data["remarks"] == []


def test_numbers_that_do_not_come_out_are_told(compared, folder, capsys, tmp_path):
    manifest = json.loads((folder / "out" / "manifest.json").read_text())
    manifest["environment"]["packages"]["numpy"] = "0.9"
    for entry in manifest["results"]:
        entry["sha256"] = "0" * 64
        if entry["output"] == "graph":
            entry["ate_m"] *= 0.5
    tampered = tmp_path / "manifest.json"
    tampered.write_text(json.dumps(manifest))
    code, data = answer(capsys, folder, "--verify", str(tampered), "--sample", "1")
    assert code == 4
    assert {v["output"]: v["outcome"] for v in data["verdicts"]} == {"ekf": "within the spread", "graph": "differs"}
    assert data["remarks"][0].startswith("packages differs")
    manifest["sources"] = dict.fromkeys(manifest["sources"], "other")
    tampered.write_text(json.dumps(manifest))
    assert run_verb(arguments(folder, "--verify", str(tampered))) == 3
    manifest["plan_text"] = PLAN.replace("seeds = [0, 1]", "seeds = [0]")
    tampered.write_text(json.dumps(manifest))
    assert run_verb(arguments(folder, "--verify", str(tampered))) == 2
    tampered.write_text("{}")
    assert run_verb(arguments(folder, "--verify", str(tampered))) == 3


def test_a_failed_job_is_kept_shown_and_tried_again_only_when_asked(tmp_path, capsys):
    text = PLAN.replace("tracks = 40", "tracks = 0").replace("seeds = [0, 1]", "seeds = [0]")
    text = text[: text.rindex("[[estimators]]")]
    write_plan(tmp_path, text)
    assert answer(capsys, tmp_path)[1]["failed"] == 1
    page = (tmp_path / "out" / "report.html").read_text()
    assert "TrackingLostError" in page
    assert "1 of 1" in page
    assert answer(capsys, tmp_path)[1]["new"] == 0
    assert answer(capsys, tmp_path, "--retry-failed")[1]["new"] == 1


def test_wrong_options_are_one_line(folder, capsys):
    assert run_verb(arguments(folder, "--engine", "dask")) == 2
    assert run_verb(arguments(folder, "--scheduler", "tcp://127.0.0.1:1")) == 2
    assert run_verb(arguments(folder, "--workers", "0")) == 2
    assert run_verb(["compare", str(folder / "none.toml")]) == 2
    assert capsys.readouterr().err.count("\n") == 4


def test_a_simulated_world_is_rendered_once_for_all_jobs(tmp_path):
    source = "sim:handheld-room,duration_s=1.0,image_width_px=80,camera_hz=5"
    first = open_cached(source, 0, tmp_path)
    made = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*.csv")}
    again = open_cached(source, 0, tmp_path)
    assert made == {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*.csv")}
    assert first.frame_count == again.frame_count > 2
    other = open_cached(source, 1, tmp_path)
    assert len([p for p in tmp_path.iterdir() if p.is_dir()]) == 2
    assert other.truth() is not None
    assert not list(tmp_path.glob("*.unfinished"))
