"""Faults put into a recording end in a verdict that names them; what is sound is trusted. Metrics, report and print."""

import json

import pytest

from vislam.cli.verbs.results import print_metrics
from vislam.config import load
from vislam.core.errors import UsageError, VislamError
from vislam.core.messages import Frame, ImuSample
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.report import write_report
from vislam.runs.sources import open_source
from vislam.sim.faults.faults import FAULTS, FaultyRecording

_URI = "points:laps,rig=stereo,duration_s=12,camera_hz=10,tracks=80"


def run(out, fault="", uri=_URI):
    prepare(out, overwrite=False)
    config = load(None, {"view.enabled": False, "map.enabled": False})
    return execute(FaultyRecording(open_source(uri), fault), config, out, uri, [])


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    out = tmp_path_factory.mktemp("verdict") / "run"
    return out, run(out)


def test_a_sound_run_is_trusted_and_its_files_say_so(sound):
    out, metrics = sound
    assert metrics["verdict"]["state"] == "trusted", metrics["verdict"]["reasons"]
    stored = json.loads((out / "metrics.json").read_text())["verdict"]
    assert (stored["state"], stored["reasons"]) == ("trusted", [])
    assert stored["evidence"]["frames"] == metrics["frames"]


def test_the_verdict_is_the_first_line_printed_and_the_first_sentence_of_the_report(sound, capsys):
    out, metrics = sound
    print_metrics(metrics, out, as_json=False)
    assert capsys.readouterr().out.splitlines()[0] == "Trusted: nothing in the run contradicts itself."
    page = write_report(out).read_text()
    assert '<p class="verdict trusted">Trusted: nothing in the run contradicts itself.</p>' in page


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("turned", "the camera is turned by"),
        ("slow", "inertial samples come at"),
        ("missing", "no inertial sample for 1.5"),
        ("in g", "gravity was not found"),
        ("dropped", "frames never arrived"),
    ],
)
def test_a_fault_is_named(tmp_path, fault, words):
    verdict = run(tmp_path / "run", fault)["verdict"]
    assert verdict["state"] == "doubtful"
    assert any(words in reason for reason in verdict["reasons"]), verdict["reasons"]


def test_swapped_cameras_are_no_trusted_run(tmp_path):
    with pytest.raises(VislamError):
        run(tmp_path / "run", "swapped")
    assert json.loads((tmp_path / "run/metrics.json").read_text())["verdict"]["state"] == "lost"


def test_a_fault_that_does_not_exist_is_refused_with_the_list():
    with pytest.raises(UsageError, match="black, one black"):
        FaultyRecording(open_source(_URI), "gremlins")


def test_faults_fit_what_a_recording_has():
    points, mono = open_source(_URI), open_source(_URI.replace("stereo", "mono"))
    assert FAULTS["swapped"].fits(points, has_images=False)
    assert not FAULTS["swapped"].fits(mono, has_images=False)
    assert not FAULTS["black"].fits(points, has_images=False)
    assert not FAULTS["depth"].fits(points, has_images=True)


@pytest.mark.parametrize("fault", sorted(name for name, f in FAULTS.items() if "depth" not in f.needs))
def test_a_faulty_stream_stays_in_order_and_is_the_same_again(fault):
    source = "points:laps,rig=stereo,duration_s=7,camera_hz=5,tracks=20"

    def stream():
        values = list(FaultyRecording(open_source(source), fault, seed=3).events())
        return [(type(v).__name__, v.t_ns) for v in values], values

    kinds, values = stream()
    assert kinds == stream()[0]
    for kind in (Frame, ImuSample):
        stamps = [v.t_ns for v in values if isinstance(v, kind)]
        assert stamps == sorted(stamps) and len(stamps) > 20


def test_a_piece_ends_where_it_should():
    values = list(FaultyRecording(open_source(_URI), length_s=3.0).events())
    frames = [value.t_ns for value in values if isinstance(value, Frame)]
    assert 2.9e9 <= frames[-1] - frames[0] <= 3.0e9
