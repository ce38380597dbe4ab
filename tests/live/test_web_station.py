"""The process of the page, real: commands reach the run, and the run outlives the page. And the options of both."""

from __future__ import annotations

import http.client
import json
import logging
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import psutil
import pytest
from live_runs import is_of_a_run
from numba import njit

from vislam.cli import run_verb
from vislam.core.errors import UsageError
from vislam.live.processes.child import measured
from vislam.live.status import status_line
from vislam.live.web.address import parsed
from vislam.live.web.station import Station
from vislam.runs.folder import prepare
from waiting import wait_for


def ask(station: Station, method: str, path: str, body: dict | None = None) -> tuple[int, dict]:
    split = urlsplit(station.url)
    headers = {"Authorization": f"Bearer {split.fragment}", "Content-Type": "application/json"}
    with closing(http.client.HTTPConnection(split.hostname, split.port, timeout=300)) as connection:
        connection.request(method, path, None if body is None else json.dumps(body), headers)
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())


@pytest.fixture
def station(tmp_path: Path):
    made = Station(parsed("127.0.0.1:0"), (), "vislam-test-no-pose", tmp_path / "drive")
    yield made
    made.close()
    made.close()


def run_that_goes() -> SimpleNamespace:
    """Stands for a live run."""
    run = SimpleNamespace(is_going=True, is_ending=False, is_brief=False, waits_for=[], notes={}, stopped=0)
    run.processes = dict
    run.stop = lambda: setattr(run, "stopped", run.stopped + 1)
    return run


def test_a_run_is_told_of_and_ended_from_the_page_and_outlives_it(station: Station, caplog, monkeypatch) -> None:
    run = run_that_goes()
    run.notes = {"front": {"verdict": {"state": "doubtful", "reasons": ["it is <b>dark</b>"]}}}

    def told() -> dict:
        station.follow(run)
        return ask(station, "GET", "/state")[1]

    wait_for(lambda: told().get("phase") == "running")
    assert told()["verdict"]["reasons"] == ["it is <b>dark</b>"]
    assert {"stop", "save"} == {*told()["can"]}
    assert ask(station, "POST", "/command", {"do": "stop"})[0] == 202
    wait_for(lambda: (station.follow(run), run.stopped)[1] == 1)

    pages = [p for p in psutil.Process().children(recursive=True) if is_of_a_run(p)]
    assert len(pages) == 1
    pages[0].kill()
    monkeypatch.setattr("vislam.live.web.station._SHOW_S", 0.0)
    with caplog.at_level(logging.WARNING):
        wait_for(lambda: (station.follow(run), not station.is_well)[1])
        for _ in range(20):
            station.follow(run)
    assert sum("the run goes on without the page" in record.message for record in caplog.records) == 1


@pytest.mark.parametrize(
    "said",
    [
        {}, {"do": "shell"}, {"do": ["stop"]}, {"do": None}, {"do": "calibrate", "kind": ["imu"]},
        {"do": "calibrate", "kind": "x" * 65}, {"do": "undo"}, {"do": "undo", "loop": "-1"}, {"do": "undo", "loop": 7},
        {"do": "calibrate", **{str(k): "x" for k in range(9)}},
    ],
)  # fmt: skip
def test_what_is_no_command_is_refused_and_reaches_nobody(said: dict) -> None:
    from vislam.live.web.web_process import _Commands

    taken: list[object] = []
    box = SimpleNamespace(put=lambda value: taken.append(value) or True)
    assert _Commands(box, box, box).take(said).status == 400
    assert taken == []


def test_commands_that_nobody_takes_are_bounded() -> None:
    from vislam.live.web.web_process import _Commands

    full = SimpleNamespace(put=lambda value: False)
    for said in ({"do": "stop"}, {"do": "save"}, {"do": "undo", "loop": "7"}):
        assert _Commands(full, full, full).take(said).status == 503


@pytest.mark.parametrize("at", ["8765", "no such:1", "no-such-host.invalid:80", "203.0.113.7:80"])
def test_an_address_that_cannot_be_listened_at_ends_with_code_2_and_leaves_no_folder(tmp_path, capsys, at: str) -> None:
    out = tmp_path / "drive"
    assert run_verb(["live", "--source", "virtual-cart", "--out", str(out), "--web", at]) == 2
    assert "--web" in capsys.readouterr().err
    assert not out.exists()


def test_a_folder_that_holds_calibrations_only_takes_a_run_and_keeps_them(tmp_path: Path) -> None:
    out = tmp_path / "drive"
    (out / "calibration").mkdir(parents=True)
    (out / "calibration" / "camera.yaml").write_text("x")
    prepare(out, overwrite=False)
    (out / "log.txt").write_text("a sensor was missing\n")
    prepare(out, overwrite=False)
    assert (out / "calibration" / "camera.yaml").read_text() == "x"
    (out / "other.txt").write_text("somebody's")
    with pytest.raises(UsageError):
        prepare(out, overwrite=False)


def test_what_is_compiled_is_counted_and_the_page_says_how_long_that_may_take() -> None:
    run, notes = run_that_goes(), []

    def body(life: SimpleNamespace) -> None:
        def kernel(x: float) -> float:
            return x + 1.0

        kernel.__module__ = "vislam.made_up"
        njit(kernel)(1.0)

    measured(SimpleNamespace(note=lambda **values: notes.append(values)), body)
    run.is_going, run.waits_for = False, ["front"]
    assert status_line(run) == "getting ready: loading front: under a minute unless the machine is busy"
    run.notes = {"front": {**notes[0]}, "fast": {"compiled": 2}}
    line = status_line(run)
    assert line.startswith("getting ready: compiling, once for this machine: 3 functions so far, 5 minutes or so")
    assert line.endswith("waiting for front")
