"""Jobs in processes of their own: crashes, timeouts, interrupts, orphans, and a cluster that loses a worker."""

import json
import sys
import threading
from contextlib import closing, suppress

import psutil
import pytest
from tiny import write_plan

from dask_cluster import dask_cluster
from vislam.core.errors import UsageError
from vislam.experiment.compare import run_locally, run_on_dask
from vislam.experiment.isolated import run_isolated
from vislam.experiment.jobs import expand
from vislam.experiment.plan import load_plan
from vislam.experiment.store import ResultStore
from vislam.experiment.worker import run_job
from waiting import HUNG_S, is_gone, wait_for


@pytest.fixture
def specs(tmp_path):
    return [job.spec() for job in expand(load_plan(write_plan(tmp_path)))]


@pytest.fixture
def endless(specs):
    return {**specs[0], "source": "points:laps,duration_s=3600"}


def workers_of(process):
    """The processes that `process` started for jobs."""
    found = []
    for child in process.children(recursive=True):
        with suppress(psutil.Error):  # it ended meanwhile
            found += [child] * ("vislam.experiment.worker" in " ".join(child.cmdline()))
    return found


def in_thread(function):
    box = []
    thread = threading.Thread(target=lambda: box.append(function()))
    thread.start()
    return thread, box


def test_a_crash_and_a_timeout_are_results_with_reasons(specs, tmp_path):
    crash = run_isolated({"key": "x", "timeout_s": HUNG_S}, str(tmp_path))
    assert crash["status"] == "failed"
    assert crash["reason"].startswith("crash: exit code 1; last said:")
    assert "KeyError: 'environment'" in crash["reason"]
    late = run_isolated({**specs[0], "timeout_s": 0.05}, str(tmp_path))
    assert late == {"status": "failed", "reason": "timeout: not done after 0.05 s", "run": {}, "outputs": {}}
    assert not workers_of(psutil.Process())


def test_a_killed_job_says_by_what(endless, tmp_path):
    thread, box = in_thread(lambda: run_isolated(endless, str(tmp_path)))
    wait_for(lambda: workers_of(psutil.Process()))[0].kill()
    thread.join()
    assert box[0]["reason"].startswith("crash: killed by SIGKILL")


def test_an_error_of_the_pipeline_is_a_result(specs, tmp_path):
    spec = json.loads(json.dumps(specs[0]))
    spec["source"] = "points:laps,tracks=0,duration_s=3"
    blind = run_job(spec, tmp_path / "blind", tmp_path)
    assert blind["status"] == "failed"
    assert blind["reason"].startswith("TrackingLostError: ")
    assert blind["run"]["frames"] > 0  # what was measured on the way stays
    spec["source"] = "points:/no/such/recording"
    assert run_job(spec, tmp_path / "none", tmp_path)["reason"].startswith("DataError: ")
    spec["environment"] = {**spec["environment"], "code_sha256": "other"}
    other = run_isolated(spec, str(tmp_path))
    assert other["status"] == "mismatch"
    assert "differs in code_sha256" in other["reason"]


def test_closing_the_local_engine_stops_what_runs(specs, tmp_path):
    done = []
    with closing(run_locally(specs[:2], 2, tmp_path, None)) as finished:
        for spec, result in finished:
            done.append((spec["key"], result["status"]))
            break
    assert [status for _, status in done] == ["ok"]
    assert not workers_of(psutil.Process())


def test_no_job_outlives_the_process_that_asked_for_it(endless, tmp_path):
    request = tmp_path / "spec.json"
    request.write_text(json.dumps(endless))
    code = (
        "import json, sys; from vislam.experiment.isolated import run_isolated; "
        "run_isolated(json.load(open(sys.argv[1])), sys.argv[2])"
    )
    asker = psutil.Popen([sys.executable, "-c", code, str(request), str(tmp_path)])
    worker = wait_for(lambda: workers_of(asker))[0]
    asker.kill()
    asker.wait()
    wait_for(lambda: is_gone(worker))


def test_a_cluster_that_loses_a_worker_loses_and_doubles_no_result(specs, tmp_path):
    specs, finished = specs[:2], []
    with dask_cluster(tmp_path) as (address, workers), ResultStore(tmp_path / "r.db") as store:
        thread, _ = in_thread(lambda: finished.extend(run_on_dask(specs, address, tmp_path, None)))
        victim, job = wait_for(
            lambda: [(w, job) for w in workers.values() for job in workers_of(psutil.Process(w.pid))]
        )[0]
        victim.kill()
        wait_for(lambda: is_gone(job))
        thread.join(HUNG_S)
        assert not thread.is_alive()
        added = [store.add(spec["key"], "label", spec, result) for spec, result in finished]
        assert all(added)
        assert len(store) == len(specs) == len(finished)
        assert {spec["key"] for spec, _ in finished} == {spec["key"] for spec in specs}
        assert [result["status"] for _, result in finished] == ["ok"] * len(specs)
    alone = run_isolated(specs[0], str(tmp_path), str(tmp_path / "kept"))
    for output, entry in next(result for spec, result in finished if spec is specs[0])["outputs"].items():
        assert entry["sha256"] == alone["outputs"][output]["sha256"]  # where a job runs does not matter
    assert (tmp_path / "kept" / specs[0]["key"][:24] / "trajectory_graph.tum").is_file()  # as only this one asked
    assert not [p for p in tmp_path.iterdir() if p.name.startswith("vislam-job-")]


def test_a_cluster_that_is_not_there_is_one_line(specs, tmp_path, monkeypatch):
    monkeypatch.setattr("vislam.core.cluster._ANSWER_S", 0.5)
    with pytest.raises(UsageError, match="no Dask scheduler answers at 'tcp://127"):
        list(run_on_dask(specs, "tcp://127.0.0.1:9", tmp_path, None))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"pip install '\.\[cluster\]'"):
        list(run_on_dask(specs, "tcp://127.0.0.1:9", tmp_path, None))
