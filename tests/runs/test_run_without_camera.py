"""What a run without a camera writes: nothing of it is lost, and its report says and draws only what is there."""

import csv
import json
import re

import pytest

from vislam.config import load
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.report import write_report
from vislam.runs.sources import open_source


@pytest.fixture(scope="module")
def blind(tmp_path_factory):
    out = tmp_path_factory.mktemp("blind") / "run"
    prepare(out, overwrite=False)
    uri = "points:cart-drive,rig=none,duration_s=6"
    return out, execute(open_source(uri), load(None, {"view.enabled": False}), out, uri, [])


def test_no_frame_without_a_camera_is_lost_or_ok(blind):
    out, metrics = blind
    with open(out / "tracking.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 60
    assert {(row["tracking"], row["localisation"]) for row in rows} == {("blind", "tracking")}
    assert metrics["counters"]["front"]["frames_lost"] == metrics["counters"]["ekf"]["vo_lost"] == 0


def test_its_report_has_no_word_and_no_band_of_vision(blind):
    page = write_report(blind[0]).read_text()
    data = json.loads(re.search(r'id="view-data">(.*?)</script>', page)[1])
    assert data["tracking"] == {} and not data["has_camera"]
    said = re.sub(r"<script.*?</script>|<style.*?</style>|<details.*?</details>", "", page, flags=re.DOTALL)
    assert "Mode: no camera, inertial." in said
    for word in ("inliers", "lost, in", "vision was degraded", "red lost", "<h2>Loops</h2>", "loops of"):
        assert word not in said
