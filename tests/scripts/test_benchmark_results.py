"""Results of benchmarks are kept by revision, and a slower one is found."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from vislam.core import DataError

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from benchmarks import results

OLD = results.Result("a" * 12, "2026-01-01T00:00:00+00:00", "cpu A", {}, {"predict": 2.0, "correct": 10.0})
NEW = replace(OLD, revision="b" * 12, date="2026-01-02T00:00:00+00:00", cpu_ms={"predict": 3.0, "correct": 10.5})


def test_what_is_recorded_is_read_again(tmp_path):
    path = results.record("ekf", {"predict": 1.25, "correct": 0.1 + 0.2}, tmp_path)
    assert path.parent == tmp_path / "ekf"
    result = results.read(path)
    assert result.cpu_ms == {"predict": 1.25, "correct": 0.3}
    assert path.stem == result.revision == results.revision()
    assert result.machine == results.machine()
    assert result.versions["numpy"]


def test_metrics_of_one_revision_gather_in_one_file(tmp_path):
    results.record("pose_graph", {"intel": 5.0, "garage": 8.0}, tmp_path)
    path = results.record("pose_graph", {"garage": 7.0, "sphere": 30.0}, tmp_path)
    assert results.read(path).cpu_ms == {"intel": 5.0, "garage": 7.0, "sphere": 30.0}


def test_times_of_another_machine_do_not_stay_beside_ours(tmp_path, monkeypatch):
    results.record("ekf", {"predict": 5.0}, tmp_path)
    monkeypatch.setattr(results, "machine", lambda: "another")
    path = results.record("ekf", {"correct": 7.0}, tmp_path)
    assert results.read(path).cpu_ms == {"correct": 7.0}


@pytest.mark.parametrize("times", [{}, {"predict": 0.0}, {"predict": float("nan")}, {"predict": float("inf")}])
def test_times_that_say_nothing_are_refused(tmp_path, times):
    with pytest.raises(ValueError, match="positive"):
        results.record("ekf", times, tmp_path)
    assert not list(tmp_path.iterdir())


def test_each_metric_is_compared_with_its_newest_earlier_value():
    between = replace(OLD, revision="c" * 12, cpu_ms={"predict": 4.0})
    found = {change.metric: change for change in results.changes([OLD, between, NEW])}
    assert found["predict"].since == "c" * 12
    assert found["predict"].ratio == 0.75
    assert found["correct"].since == "a" * 12
    assert found["correct"].ratio == pytest.approx(1.05)


def test_other_machines_and_new_metrics_have_nothing_to_be_compared_with():
    assert results.changes([]) == []
    assert results.changes([NEW]) == []
    assert results.changes([replace(OLD, machine="cpu B"), NEW]) == []
    assert results.changes([replace(OLD, cpu_ms={"other": 1.0}), NEW]) == []


def write(folder: Path, *found: results.Result) -> None:
    for result in found:
        (folder / "ekf").mkdir(exist_ok=True)
        text = json.dumps({name: getattr(result, name) for name in results.Result.__slots__})
        (folder / "ekf" / f"{result.revision}.json").write_text(text)


def test_beyond_the_factor_is_slower_and_at_it_is_not(tmp_path, capsys):
    write(tmp_path, NEW, OLD)
    assert not results.compare(["ekf"], 1.3, tmp_path)
    out = capsys.readouterr().out
    assert [line.split()[0] for line in out.splitlines() if line.endswith("SLOWER")] == ["predict"]
    assert out.splitlines()[-1] == "WARNING: 1 of 2 became slower by more than 1.3 times"
    assert results.compare([], 1.5, tmp_path)  # all that have results; exactly 1.5


def test_what_creeps_by_small_steps_is_told_and_only_the_limit_is_an_error(tmp_path, capsys):
    steps = [
        replace(OLD, revision=str(k) * 12, date=f"2026-01-0{k + 1}T00:00:00+00:00", cpu_ms={"predict": 1.1**k})
        for k in range(4)
    ]
    write(tmp_path, *steps)
    assert not results.compare(["ekf"], 1.15, tmp_path)
    assert results.compare(["ekf"], 1.15, tmp_path, limit=2.0)
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].endswith(f"1.10x since {'2' * 12}  CREEPS: 1.33x since {'0' * 12}")
    write(tmp_path, replace(NEW, date="2026-02-01T00:00:00+00:00", cpu_ms={"predict": 2.1}))
    assert not results.compare(["ekf"], 1.15, tmp_path, limit=2.0)


def test_times_beside_a_reference_are_compared_as_multiples_of_it_on_any_machine():
    there = replace(OLD, machine="cpu B", reference_ms=100.0)
    here = replace(NEW, reference_ms=50.0, cpu_ms={"predict": 1.5, "correct": 5.0})
    found = {change.metric: change for change in results.changes([there, here])}
    assert found["predict"].ratio == pytest.approx(1.5)
    assert found["correct"].ratio == pytest.approx(1.0)
    assert results.changes([replace(there, reference_ms=None), here]) == []


def test_a_reference_is_recorded_with_what_was_measured_beside_it(tmp_path):
    results.record("cost", {"old": 3.0}, tmp_path, reference_ms=80.0)
    path = results.record("cost", {"frame": 3.0}, tmp_path, reference_ms=90.0)
    assert (results.read(path).cpu_ms, results.read(path).reference_ms) == ({"frame": 3.0}, 90.0)
    path.write_text(path.read_text().replace("90.0", "-1.0"))
    with pytest.raises(DataError, match="not positive"):
        results.read(path)


def test_damaged_and_missing_results_are_errors(tmp_path):
    for names in (["ekf"], []):
        with pytest.raises(DataError, match="no results"):
            results.compare(names, 1.3, tmp_path)
    write(tmp_path, OLD)
    undated = json.dumps({"revision": "a", "date": "never", "machine": "", "versions": {}, "cpu_ms": {}})
    for text in ("{", "[]", undated):
        (tmp_path / "ekf" / "bad.json").write_text(text)
        with pytest.raises(DataError, match=r"bad\.json"):
            results.history("ekf", tmp_path)


def test_the_command_line_ends_with_a_code(tmp_path):
    command = [sys.executable, results.__file__, "compare", "no-such-benchmark"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == DataError.exit_code
    assert "--record" in done.stderr


def test_the_table_of_the_page_is_that_of_the_newest_files():
    page = results.PAGE.read_text(encoding="utf-8")
    assert results.with_table(page, results.table()) == page, "run benchmarks/results.py table"


def test_a_page_without_its_markers_is_named():
    with pytest.raises(DataError, match="table:begin"):
        results.with_table("# Results\n", "")
