"""The report says what the files say, leaves out what is absent, and survives damage."""

import base64
import hashlib
import json
import re
import shutil
from html.parser import HTMLParser
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from run_folder import DEGRADED, LOST, make_run
from vislam.cli import run_verb
from vislam.core.errors import DataError, StorageError
from vislam.core.memory import GraphRecord, KeyframeEntry, PackedScan
from vislam.core.messages import GraphUpdate
from vislam.mapping.formats.ply import write_ply
from vislam.runs.report import write_figures, write_report
from vislam.runs.report.run_files import read_run
from vislam.runs.report.scene import build_scene, loop_segments
from vislam.runs.session import SessionWriter
from worlds.lap import RIG, World
from worlds.parts import GRAVITY_M_S2


class Page(HTMLParser):
    """Collects the texts, headings and anything that would leave the page; fails on tags that do not match."""

    VOID = ("meta", "img", "br", "link", "use", "path", "input")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.headings, self.texts, self.open, self.outside, self.tags = [], [], [], [], []
        self.feed(re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL))  # libraries take the parser seconds
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "xlink:href") and not value.startswith(("data:", "#")):
                self.outside.append(value)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script":
            return
        self.texts.append(data)
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)

    @property
    def text(self):
        return " ".join(self.texts)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "cart")


@pytest.fixture
def copy(run, tmp_path):
    """A run folder of one's own to damage."""
    target = tmp_path / "cart"
    (target / "map").mkdir(parents=True)
    for path in run.rglob("*"):
        if path.is_file() and path.name != "report.html":
            (target / path.relative_to(run)).write_bytes(path.read_bytes())
    return target


def test_a_whole_run_becomes_one_self_contained_page(run):
    path = write_report(run)
    assert path == run / "report.html"
    text = path.read_text()
    page = Page(text)
    assert page.headings == [
        "Map",
        "Accuracy",
        "Trajectories",
        "Over time",
        "Loops",
        "Time",
        "Inertial biases",
        "What was lost or rejected",
        "How it was made",
    ]
    assert page.outside == []
    assert page.tags.count("script") == 1  # the data; the scripts that may run are named by their hashes
    written = re.findall(r"<script>(.*?)</script>", text, flags=re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in written]
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', text)[1]
    assert re.findall(r"sha256-([^&]+)&#x27;", policy) == hashes
    assert policy.startswith("default-src &#x27;none&#x27;; img-src data:;")
    assert not re.search(r"url\((?!#)|@import", re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL))
    assert page.tags.count("svg") == 6
    assert not re.search(r"#0[0-9a-f]0[0-9a-f]0[0-9a-f]\b", text)  # every stand-in colour was replaced
    assert text.count("var(--ekf)") > 5
    metrics = json.loads((run / "metrics.json").read_text())
    for name in ("ekf", "live", "graph"):
        assert f"{metrics['accuracy'][name]['ate_rmse_m']:.3f}" in page.texts
    assert "Tracks scatter by 0.53 px; the graph uses 2.10 px, 1.00 given." in page.text
    assert "60 candidates: 12 accepted, 12 pending, 36 rejected." in page.text
    assert "scene <looks> alike, but 2.4 m apart" in page.texts  # escaped in the file, whole on the page
    assert "<looks>" not in text
    assert str(len(LOST)) in page.texts
    assert "frames lost, in 1 outage" in page.texts
    assert {"of CPU per frame", "of memory at most", "of recording until the first pose", "3.15"} <= set(page.texts)
    assert re.search(r"24\s*ms", page.text) and re.search(r"812\s*MB", page.text) and re.search(r"1\.25\s*s", page.text)
    assert "28.7 s of CPU in all, beside 0.0 s of compilation; 0.4 s of it until the first pose." in page.text
    assert f"degraded: … inliers {len(DEGRADED)}" in re.sub(r"\s+", " ", page.text)
    assert "unreadable image" in page.texts
    assert "vislam run sim:workshop-cart --out runs/cart" in page.texts
    assert '"code_revision": "0123456789abcdef"' in page.text


def test_drawings_become_files_for_a_paper(run, tmp_path):
    paths = write_figures(run, tmp_path / "figures")
    named = {"from_above", "from_the_side", "over_time", "timing", "gyroscope_bias", "accelerometer_bias"}
    assert {path.name for path in paths} == {f"{name}.svg" for name in named}
    for text in (path.read_text() for path in paths):
        assert ElementTree.fromstring(text).tag.endswith("svg") and "var(" not in text


def add_map_and_session(run):
    """Give a run folder a cloud and a session of two keyframes that keep their colours."""
    world = World(5.0, seed=3)
    rng = np.random.default_rng(3)
    points = rng.uniform(-5.0, 5.0, (3000, 3)).astype(np.float32)
    write_ply(run / "map" / "cloud.ply", points, rng.integers(0, 255, (3000, 3), dtype=np.uint8))
    writer = SessionWriter.create(run / "session.db", {"config": {}}, RIG, world.noise, GRAVITY_M_S2)
    for k in range(2):
        colors = cv2.imencode(".png", rng.integers(0, 255, (60, 80, 3), dtype=np.uint8))[1].tobytes()
        scan = PackedScan(k, cv2.imencode(".png", np.full((60, 80), 1000, np.uint16))[1].tobytes(), b"", colors)
        update = GraphUpdate(k + 1, np.array([k]), world.truth[k][None], np.eye(4), None)
        writer.add(KeyframeEntry(world.packet(k), world.truth[k], update, GraphRecord(), scans={k: scan}))
    writer.close(finished=True)


def test_a_copied_folder_with_map_and_session_gives_the_same_bytes(copy, tmp_path):
    add_map_and_session(copy)
    shutil.copytree(copy, tmp_path / "elsewhere" / copy.name)
    first = write_report(copy).read_bytes()
    assert write_report(tmp_path / "elsewhere" / copy.name).read_bytes() == first
    data = json.loads(re.search(rb'id="view-data">(.*?)</script>', first)[1])
    assert data["cloud"]["count"] == 3000
    assert [picture["id"] for picture in data["pictures"]] == [0, 1]


def test_what_batch_made_of_the_run_is_among_the_tiles(copy):
    metrics = json.loads((copy / "metrics.json").read_text())
    metrics["accuracy"]["batch"] = metrics["accuracy"]["graph"] | {"ate_rmse_m": 0.0123}
    metrics["batch"] = {"batch": {"cost_before": 542.6, "cost_after": 321.2}}
    metrics["truth"] = {"summary": "truth is off by +6.0 +- 0.1 ms"}
    (copy / "metrics.json").write_text(json.dumps(metrics))
    page = Page(write_report(copy).read_text())
    assert {"ATE of the batch", "0.012", "321", "cost of the batch, 543 before"} <= set(page.texts)
    assert "after all loops. truth is off by +6.0 +- 0.1 ms" in page.text


def test_errors_of_the_scene_are_those_of_the_metrics(run):
    files = read_run(run)
    scene = build_scene(files)
    for name, curve in scene.errors.items():
        rmse = np.sqrt(np.mean(curve.position_m**2))
        assert rmse == pytest.approx(files.metrics["accuracy"][name]["ate_rmse_m"], abs=1e-8)  # files round to nm
    assert scene.errors["ekf"].position_m.max() > 5 * scene.errors["graph"].position_m.max()
    # in the map frame the graph stays where it was, and the truth comes to it
    np.testing.assert_allclose(scene.paths["graph"].positions_m, files.estimates["graph"].positions_m, atol=1e-9)
    gap = np.linalg.norm(scene.truth.positions_m - scene.paths["graph"].positions_m, axis=1)
    np.testing.assert_allclose(gap, scene.errors["graph"].position_m, atol=1e-9)


def test_loops_are_drawn_between_their_keyframes(run):
    files = read_run(run)
    scene = build_scene(files)
    segments = loop_segments(files, scene, "accepted")
    accepted = [loop for loop in files.loops if loop.decision == "accepted"]
    assert len(segments) == len(accepted) == 12
    expected = scene.paths["graph"].positions_m[[accepted[3].from_id * 10, accepted[3].to_id * 10]]
    np.testing.assert_allclose(segments[3], expected, atol=1e-9)
    files.metrics["map"] = {"keyframes": accepted[3].from_id + 1}  # the older ends up to this one have foreign stamps
    inside = [loop for loop in accepted if loop.from_id > accepted[3].from_id]
    assert 0 < len(loop_segments(files, scene, "accepted")) == len(inside) < len(accepted)


def test_sections_without_files_are_left_out(copy):
    for name in ("states_ekf.csv", "states_graph.csv", "loops.csv", "tracking.csv", "map/picture.png", "config.json"):
        (copy / name).unlink()
    page = Page(write_report(copy).read_text())
    assert "Map" not in page.headings
    assert "Inertial biases" not in page.headings
    assert "Over time" in page.headings  # the errors remain
    assert "No candidates." in page.texts
    assert "Configuration" not in page.texts


def test_a_run_without_truth_has_no_errors_but_all_paths(tmp_path):
    page = Page(write_report(make_run(tmp_path / "live", with_truth=False)).read_text())
    assert "This run has no true trajectory to compare with." in page.texts
    assert "Trajectories" in page.headings
    assert not any("ATE" in text for text in page.texts)


def test_a_run_that_never_started_says_why(tmp_path):
    (tmp_path / "metrics.json").write_text(
        json.dumps(
            {
                "name": "dark",
                "frames": 40,
                "keyframes": 0,
                "duration_s": 2.0,
                "wall_s": 0.5,
                "realtime_factor": 4.0,
                "initialisation": {"status": "failed", "reason": "too little parallax", "t_s": None},
                "accuracy": {},
                "timing_ms": {},
                "loops": {"candidates": 0, "accepted": 0, "pending": 0, "rejected": 0},
            }
        )
    )
    for name in ("ekf", "graph"):
        (tmp_path / f"trajectory_{name}.tum").write_text("# t_s tx ty tz qx qy qz qw\n")
    page = Page(write_report(tmp_path).read_text())
    assert any("failed at – (too little parallax)" in text for text in page.texts)
    assert any("trajectory_ekf.tum holds no poses" in text for text in page.texts)


def _half(data):
    return data[: len(data) // 2]


@pytest.mark.parametrize(
    "damages",
    [
        [
            ("metrics.json", _half, "metrics.json is not valid JSON"),
            ("trajectory_graph.tum", lambda data: data[:-30], "expected 8 columns"),
            ("loops.csv", lambda data: data[:-70], "loops.csv"),
            ("states_graph.csv", lambda data: data[:-500], "expected 138 columns"),
        ],
        [
            ("metrics.json", lambda data: b"[1, 2]", "holds a list instead of an object"),
            ("trajectory_ekf.tum", lambda data: data.replace(b"0.3", b"nan", 1), "trajectory_ekf.tum"),
            ("loops.csv", lambda data: data.replace(b"from_id", b"id", 1), "expected the columns"),
            ("tracking.csv", lambda data: data.replace(b",ok,", b",fine,", 1), "not a valid Tracking"),
        ],
        [
            ("metrics.json", lambda data: b"[" * 100_000, "metrics.json is not valid JSON"),
            ("trajectory_truth.tum", lambda data: b"\xff\xfe" + data, "not text"),
            ("loops.csv", lambda data: data.replace(b"\n0,60", b"\nzero,60", 1), "invalid literal"),
            ("config.json", lambda data: b"\xff", "config.json is not valid JSON"),
            ("map/picture.png", lambda data: data[:100], "From above"),
        ],
    ],
)
def test_damaged_files_are_named_and_the_rest_is_still_there(copy, damages):
    for name, damage, _ in damages:
        path = copy / name
        path.write_bytes(damage(path.read_bytes()))
    page = Page(write_report(copy).read_text())
    for _, _, says in damages:
        assert says in page.text
    assert "Trajectories" in page.headings


@pytest.mark.parametrize("damage", [_half, lambda data: data[:60], lambda data: b"", lambda data: data[::-1]])
def test_a_damaged_map_and_session_are_named_and_the_rest_is_still_there(copy, damage):
    add_map_and_session(copy)
    for path in (copy / "map" / "cloud.ply", copy / "session.db"):
        path.write_bytes(damage(path.read_bytes()))
    page = Page(write_report(copy).read_text())
    assert "map/cloud.ply left out: " in page.text
    assert "session.db left out: " in page.text
    assert "Trajectories" in page.headings


def test_metrics_of_the_wrong_types_do_not_break_the_page(copy):
    nonsense = {"name": None, "frames": "many", "accuracy": {"graph": 3, "ekf": {"ate_rmse_m": None}}, "loops": []}
    nonsense |= {"timing_ms": {"ekf": {"p50": "fast"}, "x": 1}, "warnings": "none", "counters": {"a": {"b": "c"}}}
    nonsense |= {
        "truth": "none",
        "cost": {"cpu_ms_per_frame": "dear", "stages_cpu_ms_per_frame": {"ekf": "much", "map": 0.0}},
    }
    (copy / "metrics.json").write_text(json.dumps(nonsense))
    assert "Trajectories" in Page(write_report(copy).read_text()).headings


def test_a_trajectory_from_another_clock_is_not_drawn_over_the_truth(copy):
    lines = (copy / "trajectory_ekf.tum").read_text().splitlines()
    (copy / "trajectory_ekf.tum").write_text(
        "\n".join(line.replace("17000000", "16000000", 1) for line in lines) + "\n"
    )
    text = write_report(copy).read_text()
    assert any(words.startswith("ekf cannot be aligned to the truth") for words in Page(text).texts)
    assert "EKF alone" not in re.findall(r">(EKF alone)</text>", text)


def test_large_pictures_are_made_smaller(copy):
    noise = np.random.default_rng(0).integers(0, 255, (1500, 2400, 3), dtype=np.uint8)
    cv2.imwrite(str(copy / "map" / "picture_above.png"), noise)
    text = write_report(copy).read_text()
    encoded = re.search(r'alt="above" src="data:image/jpeg;base64,([^"]+)"', text)[1]
    image = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (1000, 1600, 3)


def test_nothing_that_a_link_leads_to_is_in_a_report(copy, tmp_path_factory):
    elsewhere, loop = tmp_path_factory.mktemp("elsewhere"), next(loop for loop in read_run(copy).loops)
    (elsewhere / "secret.txt").write_text("not to be passed on")
    image = np.full((20, 30, 3), 90, np.uint8)
    cv2.imwrite(str(elsewhere / "private.png"), image)
    (copy / "loops").mkdir()
    name = f"loops/00_{loop.from_id}_{loop.to_id}_{loop.decision}.jpg"
    for link, target in ((name, "secret.txt"), ("map/picture_above.png", "private.png")):
        (copy / link).unlink(missing_ok=True)
        (copy / link).symlink_to(elsewhere / target)
    text = write_report(copy).read_text()
    assert base64.b64encode(b"not to be passed on").decode() not in text
    assert 'alt="above"' not in text
    assert text.count("is a link that leads out of the run folder") == 2


@pytest.mark.parametrize("link", ["log.txt", "map"])
@pytest.mark.parametrize("verb", [["loops", "--undo", "0"], ["optimize"]])
def test_nothing_is_written_to_where_a_link_leads(copy, verb, link, tmp_path_factory, capsys):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (elsewhere / "kept").write_text("as it was")
    shutil.rmtree(copy / "map")
    (copy / link).symlink_to(elsewhere if link == "map" else elsewhere / "kept")
    assert run_verb([verb[0], str(copy), *verb[1:]]) == 3
    assert f"{link} is a link that leads out of the run folder" in capsys.readouterr().err
    assert [(path.name, path.read_text()) for path in elsewhere.iterdir()] == [("kept", "as it was")]


def test_only_what_was_decoded_is_embedded(copy):
    image = cv2.imencode(".png", np.full((20, 30, 3), 90, np.uint8))[1].tobytes()
    line = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (1, 400_000), np.uint8))[1].tobytes()
    for name, data in (
        ("picture_a.png", image + b"what is behind it"), ("picture_b.png", b"text"), ("c.webp", image),
        ("picture_line.png", line),
    ):  # fmt: skip
        (copy / "map" / name).write_bytes(data)
    text = write_report(copy).read_text()
    embedded = base64.b64decode(re.search(r'alt="a" src="data:image/png;base64,([^"]+)"', text)[1])
    assert np.all(cv2.imdecode(np.frombuffer(embedded, np.uint8), cv2.IMREAD_COLOR) == 90)
    assert b"what is behind it" not in embedded
    assert "picture_b.png is not a readable image" in text


def test_folders_that_hold_no_run(tmp_path):
    with pytest.raises(DataError, match=r"neither metrics\.json nor a trajectory"):
        write_report(tmp_path)
    with pytest.raises(DataError, match="not a run folder"):
        write_report(tmp_path / "missing")


def test_a_report_that_cannot_be_written_is_one_clear_error(copy):
    (copy / "report.html").mkdir()
    with pytest.raises(StorageError, match=r"report.html cannot be written"):
        write_report(copy)


def test_without_an_imu_there_is_no_filter_to_speak_of(copy):
    metrics = json.loads((copy / "metrics.json").read_text()) | {"has_imu": False}
    (copy / "metrics.json").write_text(json.dumps(metrics))
    rows = (copy / "loops.csv").read_text().splitlines()
    rows[1] = re.sub(r"^(\d+,\d+),\d+,\d+,", r"\1,,,", rows[1])  # keyframes whose times are not known
    (copy / "loops.csv").write_text("\n".join(rows) + "\n")
    page = Page(write_report(copy).read_text())
    assert "ATE of the odometry" in page.texts
    assert "EKF alone" not in page.texts
    files = read_run(copy)
    assert len(loop_segments(files, build_scene(files), "accepted")) == 11


def test_without_gravity_the_truth_says_what_is_up(copy):
    metrics = json.loads((copy / "metrics.json").read_text()) | {"has_imu": False}
    (copy / "metrics.json").write_text(json.dumps(metrics))
    files = read_run(copy)
    scene = build_scene(files)
    np.testing.assert_allclose(scene.truth.positions_m, files.truth.positions_m, atol=1e-9)
    (copy / "trajectory_truth.tum").unlink()
    assert any("z is that of the first camera" in text for text in Page(write_report(copy).read_text()).texts)


def _evaluation():
    curve = {"threshold": [60.0, 30.0], "precision": [1.0, 0.9], "recall": [0.5, 0.7]}
    stage = {
        "answers": 40, "wrong": 4, "precision": 0.9, "recall": 0.7, "recall_at_full_precision": 0.5,
        "interval": [0.3, 0.6], "curve": curve,
    }  # fmt: skip
    spread = {"median": 0.01, "p95": 0.02, "max": 0.7}
    edges = {"accepted": 12, "apart": 9, "gross": 1, "error_m": spread, "error_deg": spread, "errors_m": [0.01, 0.7]}
    rule = {"min_apart_s": 10.0, "min_apart_keyframes": 30, "min_overlap": 0.3, "gross_m": 0.5, "gross_deg": 10.0}
    stages = dict.fromkeys(("appearance", "geometry", "graph"), stage)
    return {"rule": rule, "keyframes": 120, "revisits": 60, "stages": stages, "edges": edges}


def test_loops_against_the_truth_and_their_pictures_are_shown(copy):
    (copy / "loops_eval.json").write_text(json.dumps(_evaluation()))
    (copy / "loops").mkdir()
    loop = next(loop for loop in read_run(copy).loops if loop.decision == "accepted")
    picture = cv2.imencode(".jpg", np.full((100, 300, 3), 90, np.uint8))[1].tobytes()
    for name in (f"00_{loop.from_id}_{loop.to_id}_accepted.jpg", "01_900_901_rejected.jpg", "02_odd.jpg"):
        (copy / "loops" / name).write_bytes(picture)
    text = write_report(copy).read_text()
    page = Page(text)
    assert "Against the truth" in page.texts
    assert any("1 of 12 edges in the graph are off by more than 0.5 m" in part for part in page.texts)
    assert any("moved the map by 1.3 cm rms, 8.2 cm at most" in part for part in page.texts)
    assert (
        re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL).count("data:image/jpeg") == 1
    )  # only what loops.csv knows
    assert page.outside == []


@pytest.mark.parametrize("spoil", [lambda e: e["stages"]["graph"].pop("curve"), lambda e: e.update(stages=3)])
def test_an_evaluation_of_another_shape_is_named(copy, spoil):
    evaluation = _evaluation()
    spoil(evaluation)
    (copy / "loops_eval.json").write_text(json.dumps(evaluation))
    page = Page(write_report(copy).read_text())
    assert any("loops_eval.json cannot be drawn" in part for part in page.texts)


def _with_sensors(copy, sensors, nis):
    metrics = json.loads((copy / "metrics.json").read_text())
    metrics["sensors"], metrics["nis"] = sensors, nis
    metrics["counters"]["sensor wheels"] = {"readings": 396, "unusable": 7, "too_early": 17}
    metrics["counters"]["ekf"] = {"wheels_accepted": 371, "wheels_gated": 6, "wheels_refused": 5}
    (copy / "metrics.json").write_text(json.dumps(metrics))
    return Page(write_report(copy).read_text())


def test_further_sensors_are_shown_with_their_readings_and_own_variables(copy):
    found = {"values": [1.0125], "sigmas": [0.0021]}
    wheels = {
        "begun": True,
        "variables": ["scale_left"],
        "filter": found,
        "graph": {"values": [0.9987], "sigmas": [0.0032]},
        "readings": {"graph": {"used": 291, "outliers": 13, "late": 21, "unplaced": 2, "begun": "x"}},
    }
    broken = {"begun": False, "variables": ["offset_m"], "note": "left out, it cannot <begin>"}
    page = _with_sensors(copy, {"wheels": wheels, "broken": broken}, {"wheels": [371, 742.0, 1484]})
    assert "Further sensors" in page.headings
    assert {"396", "371", "6", "5", "7", "0.50", "1.0125", "0.0021", "0.9987", "0.0032"} | {
        "291",
        "13",
        "23",
    } <= set(page.texts)
    assert {"scale_left", "left out, it cannot <begin>"} <= set(page.texts)


@pytest.mark.parametrize(
    ("sensors", "nis"),
    [
        ({"wheels": 3}, {"wheels": [1, 2]}),
        (
            {"wheels": {"begun": True, "variables": ["a", "b"], "filter": {"values": [1.0]}, "graph": 7}},
            {"wheels": [1, "x", 3]},
        ),
        ({"wheels": {"variables": 4}}, []),
    ],
)
def test_further_sensors_of_another_shape_do_not_stop_the_report(copy, sensors, nis):
    assert "Further sensors" in _with_sensors(copy, sensors, nis).headings


def test_a_run_without_further_sensors_has_no_section_about_them(copy):
    assert "Further sensors" not in _with_sensors(copy, {}, {}).headings
