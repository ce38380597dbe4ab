"""The report's page in a real browser: nothing fails, nothing leaves it, nothing is cut, and its parts are linked."""

import os
from dataclasses import replace

import cv2
import numpy as np
import pytest

from browser import CUT, NO_WEBGL, PATIENCE_MS, SMALLEST, is_readable_on_a_phone_and_on_paper
from run_folder import LOST, PERIOD_NS, make_run
from vislam.cli import run_verb
from vislam.loop import loops_text, read_loops
from vislam.mapping.formats.ply import write_ply
from vislam.mapping.semantic.classes import LabelClasses
from vislam.mapping.semantic.layer import LabelLayer
from vislam.mapping.semantic.layer_files import write_layer
from vislam.mapping.semantic.votes import voxel_keys
from vislam.runs.report import write_report
from vislam.trajectory import read_states_csv

COLORS = """() => {
    const view = window.vislamReport.view, gl = view.renderer.getContext();
    view.rest(); view.draw();
    const w = gl.drawingBufferWidth, h = gl.drawingBufferHeight, pixels = new Uint8Array(4 * w * h);
    gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return new Set(new Uint32Array(pixels.buffer)).size;
}"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    run = make_run(tmp_path_factory.mktemp("runs") / "cart")
    rng = np.random.default_rng(1)
    points = rng.uniform([-8, -5, 0], [8, 5, 0.5], (20_000, 3)).astype(np.float32)
    write_ply(run / "map" / "cloud.ply", points, rng.integers(0, 255, (20_000, 3), dtype=np.uint8))
    return write_report(run)


class Opened:
    """A page that is ready, with what went wrong in it and what it asked of the network."""

    def __init__(self, chromium, path, width=1400, scheme="light", javascript=True, webgl=True):
        self.context = chromium.new_context(
            viewport={"width": width, "height": 900},
            color_scheme=scheme,
            has_touch=width < 500,
            java_script_enabled=javascript,
        )
        self.page = self.context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        if not webgl:
            self.page.add_init_script(NO_WEBGL)
        self.faults, self.requests = [], []
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        known = "nothing" if webgl else "creating WebGL context"
        self.page.on(
            "console", lambda said: said.type == "error" and known not in said.text and self.faults.append(said.text)
        )
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.resolve().as_uri())
        if javascript:
            self.page.wait_for_selector("html[data-ready]")

    def __enter__(self):
        return self.page

    def __exit__(self, kind, *rest):
        self.context.close()
        if kind is None:
            assert self.faults == []
            assert [url for url in self.requests[1:] if not url.startswith(("data:", "blob:"))] == []


@pytest.fixture(scope="module")
def page(chromium, report):
    """The report on a desk's screen, for tests that do one thing after another on one page."""
    with Opened(chromium, report) as opened:
        yield opened


def move_to(page, share):
    """Point at the first plot, at a share of its width."""
    over = page.locator(".plot .u-over").first
    over.scroll_into_view_if_needed()
    box = over.bounding_box()
    page.mouse.move(box["x"] + share * box["width"], box["y"] + 0.5 * box["height"])


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1400, 400])
def test_nothing_fails_or_is_cut_and_the_map_is_drawn(chromium, report, tmp_path, width, scheme):
    with Opened(chromium, report, width, scheme) as page:
        assert page.evaluate("document.documentElement.scrollWidth") == width
        assert page.evaluate(CUT) == []
        assert page.evaluate(SMALLEST) >= 11.0
        assert page.evaluate(COLORS) > 500
        background = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (min(map(int, background[4:-1].split(","))) > 128) == (scheme == "light")
        if folder := os.environ.get("VISLAM_SCREENSHOTS"):
            page.screenshot(path=f"{folder}/report_{width}_{scheme}.png")


def test_pointing_at_a_plot_moves_the_camera_and_the_facts(page):
    place = "() => Array.from(window.vislamReport.view.marker.matrix.elements)"
    before = page.evaluate(place)
    move_to(page, (LOST[0] + 20) * PERIOD_NS * 1e-9 / 60.0)
    page.wait_for_function("() => Number(document.documentElement.dataset.time) > 30")
    assert page.evaluate(place) != before
    details = page.locator("#view-details").inner_text()
    assert "lost, 7 inliers" in details
    assert "7 inliers of 30, image too dark" in details
    t = float(page.evaluate("document.documentElement.dataset.time"))
    assert f"{t:.2f} s" in details


def test_layers_can_be_turned_off(page):
    whole = page.evaluate(COLORS)
    page.locator("#view-layers input[name=map]").uncheck()
    assert page.evaluate(COLORS) < 0.5 * whole
    page.locator("#view-layers input[name=map]").check()
    assert page.evaluate(COLORS) == whole


def test_the_map_turns_under_the_mouse(page):
    page.locator("#view-canvas").scroll_into_view_if_needed()
    stands = "() => window.vislamReport.view.camera.position.toArray()"
    before, box = page.evaluate(stands), page.locator("#view-canvas").bounding_box()
    page.mouse.move(box["x"] + 300, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 420, box["y"] + 240, steps=4)
    page.mouse.up()
    page.wait_for_function(f"(before) => ({stands})().join() !== before.join()", arg=before)


def test_the_view_goes_with_the_body_and_stays_where_it_is_left(page):
    stands = "() => window.vislamReport.view.camera.position.toArray()"
    away = (
        "() => { const v = window.vislamReport.view; return v.camera.position.toArray()"
        ".map((value, k) => value - v.marker.matrix.elements[12 + k]); }"
    )
    page.locator("#view-follow").click()
    before, off = np.array(page.evaluate(stands)), np.array(page.evaluate(away))
    page.evaluate("window.vislamReport.view.onTime(40.0)")
    assert page.evaluate(away) == pytest.approx(off, abs=1e-6)
    assert np.linalg.norm(np.array(page.evaluate(stands)) - before) > 0.1
    page.locator("#view-follow").click()
    before = page.evaluate(stands)
    page.evaluate("window.vislamReport.view.onTime(20.0)")
    assert page.evaluate(stands) == before
    page.locator("#view-home").click()


def test_a_distance_is_measured_between_two_points_of_the_map(page):
    page.locator("#view-measure").click()
    said = page.locator(".measured")
    ends = []
    for share in (0.4, 0.6):
        box = page.locator("#view-canvas").bounding_box()
        page.locator("#view-canvas").click(position={"x": share * box["width"], "y": 0.55 * box["height"]})
        ends.append(page.evaluate("window.vislamReport.view.ends.at(-1).toArray()"))
    step = np.subtract(*ends)
    across, up = np.hypot(*step[:2]), -step[2]
    assert said.inner_text() == f"{np.linalg.norm(step):.3f} m: {across:.3f} across, {up:.3f} up"
    points = np.array(page.evaluate("Array.from(window.vislamReport.data.cloud.position)")).reshape(-1, 3)
    assert max(np.linalg.norm(points - end, axis=1).min() for end in ends) == 0.0
    page.locator("#view-measure").click()
    assert not said.is_visible()


def test_a_picture_is_kept_as_it_is_seen(page, tmp_path):
    with page.expect_download() as kept:
        page.locator("#view-picture").click()
    kept.value.save_as(tmp_path / kept.value.suggested_filename)
    picture = cv2.imread(str(tmp_path / "map.png"))
    box = page.locator("#view-canvas").bounding_box()
    assert picture.shape[:2] == (round(box["height"]), round(box["width"]))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 500


def test_ellipsoids_are_as_large_as_the_covariance_says(page, report):
    states = read_states_csv(report.parent / "states_graph.csv")[1]
    drawn = np.array(
        page.evaluate(
            "() => Array.from(window.vislamReport.view.layers.get('sigmas').node.geometry.attributes.position.array)"
        )
    ).reshape(-1, 3 * 48, 3)
    most = [np.linalg.norm(corners - corners.mean(axis=0), axis=1).max() for corners in drawn]
    wanted = [3.0 * np.sqrt(np.linalg.eigvalsh(state.covariance[3:6, 3:6])[-1]) for state in states]
    assert 10 < len(drawn) <= 80
    assert most[0] == pytest.approx(wanted[0], rel=1e-3)
    assert most[-1] == pytest.approx(wanted[-1], rel=1e-3)


def test_a_loop_that_is_clicked_tells_its_reason(page):
    page.evaluate("window.vislamReport.view.fromAbove()")
    at = page.evaluate(
        "() => { const v = window.vislamReport.view, e = v.data.loops.ends;"
        "const a = v.project(e[0], e[1], e[2]), b = v.project(e[3], e[4], e[5]);"
        "return [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]; }"
    )
    page.locator("#view-canvas").click(position={"x": at[0], "y": at[1]})
    page.wait_for_selector("#view-details .loop:not([hidden])")
    assert "verified, 3 neighbours agree" in page.locator("#view-details .loop").inner_text()


@pytest.mark.parametrize("width", [1400, 400])
def test_from_above_the_whole_path_is_seen(chromium, report, width):
    with Opened(chromium, report, width) as page:
        look_from_above(page)
        places = np.array(page.evaluate(
            "() => { const v = window.vislamReport.view, p = v.data.paths[v.data.best].xyz;"
            "return Array.from({ length: p.length / 3 }, (_, k) => v.project(...p.subarray(3 * k, 3 * k + 3))); }"
        ))  # fmt: skip
        size = page.evaluate("(({ clientWidth, clientHeight }) => [clientWidth, clientHeight])(view_canvas)".replace(
            "view_canvas", "document.getElementById('view-canvas')"))  # fmt: skip
        assert (places > 0.0).all() and (places < size).all()
        assert (np.ptp(places, axis=0) / size).max() > 0.75  # as large as it goes


@pytest.mark.parametrize("width", [1400, 400])
def test_without_webgl_a_picture_and_a_word_stand_where_the_map_is(chromium, report, width):
    with Opened(chromium, report, width, webgl=False) as page:
        assert "no WebGL" in page.locator(".canvas .note").inner_text()
        box = page.locator(".canvas svg").bounding_box()
        assert box["height"] > 200 and box["y"] < 500
        move_to(page, 0.5)
        page.wait_for_function("() => Number(document.documentElement.dataset.time) > 20")  # the rest lives
        assert page.evaluate("document.documentElement.scrollWidth") == width
        assert page.evaluate(CUT) == []


def test_loops_are_sorted_by_what_each_moved_and_by_any_column_that_is_clicked(chromium, tmp_path):
    run = make_run(tmp_path / "sorted")
    rows = read_loops(run / "loops.csv")
    places = {id(row): k for k, row in enumerate(row for row in rows if row.decision == "accepted")}
    rows = [replace(row, moved_max_m=0.01 * (7 * places[id(row)] % 12)) if id(row) in places else row for row in rows]
    (run / "loops.csv").write_text(loops_text(rows))
    with Opened(chromium, write_report(run)) as page:

        def column(name):
            heads = page.locator(".sortable table").first.locator("th").all_inner_texts()
            cells = page.locator(f".sortable td:nth-child({heads.index(name) + 1})").all_text_contents()
            assert len(cells) == 60
            return cells

        assert column("moved [m]")[:12] == [f"{0.01 * k:.3f}" for k in range(11, -1, -1)]
        page.locator(".sortable th button", has_text="inliers").first.click()
        inliers = [int(cell) for cell in column("inliers")]
        assert inliers == sorted(inliers, reverse=True)
        page.locator(".sortable th button", has_text="decision").first.click()
        assert column("decision") == sorted(column("decision"))


class Fingers:
    """What fingers on a phone's screen do, in pixels of the page."""

    def __init__(self, page):
        self.session = page.context.new_cdp_session(page)
        self.box = page.locator("#view-canvas").bounding_box()

    def move(self, *paths):
        """Move one or more fingers, each from its first to its last place on the canvas."""
        steps = 6
        for k in range(steps + 1):
            points = [
                {"x": self.box["x"] + a[0] + k / steps * (b[0] - a[0]),
                 "y": self.box["y"] + a[1] + k / steps * (b[1] - a[1]), "id": i}
                for i, (a, b) in enumerate(paths)
            ]  # fmt: skip
            self.send("touchMove" if k else "touchStart", points)
        self.send("touchEnd", [])

    def send(self, kind, points):
        self.session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def look_from_above(page):
    """Choose what looks from above; a tap held too long by a busy browser would be no click."""
    page.locator("#view-above").dispatch_event("click")


def test_the_map_turns_and_nears_under_fingers_and_a_tap_tells_of_a_loop(chromium, report):
    with Opened(chromium, report, width=400) as page:
        fingers, loops = Fingers(page), page.locator("#view-details .loop:not([hidden])")
        stands = "() => window.vislamReport.view.camera.position.toArray()"
        away = "() => { const v = window.vislamReport.view; return v.camera.position.distanceTo(v.controls.target); }"
        before = page.evaluate(stands)
        fingers.move([(200, 150), (280, 190)])
        page.wait_for_function(f"(before) => ({stands})().join() !== before.join()", arg=before)
        assert page.evaluate("window.scrollY") == 0
        far = page.evaluate(away)
        fingers.move([(170, 150), (90, 150)], [(230, 150), (310, 150)])
        page.wait_for_function(f"(far) => ({away})() < 0.7 * far", arg=far)
        assert page.evaluate("window.visualViewport.scale") == 1
        look_from_above(page)
        x, y = page.evaluate(
            "() => { const v = window.vislamReport.view, e = v.data.loops.ends;"
            "const a = v.project(e[0], e[1], e[2]), b = v.project(e[3], e[4], e[5]);"
            "return [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]; }"
        )
        fingers.move([(x, y), (x, y)], [(x + 60, y), (x + 90, y)])  # one of two fingers stays where it is
        assert loops.count() == 0
        look_from_above(page)
        fingers.move([(x - 4, y - 12), (x - 2, y - 4)])  # a finger misses, and rolls
        loops.wait_for()
        assert page.evaluate("window.vislamReport.view.chosen.visible")


def test_plots_zoom_together(page):
    spans = "() => window.vislamReport.plots.plots.map((p) => p.scales.x.max - p.scales.x.min)"
    whole = page.evaluate(spans)
    move_to(page, 0.3)
    page.mouse.down()
    box = page.locator(".plot .u-over").first.bounding_box()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 20, steps=4)
    page.mouse.up()
    page.wait_for_function(f"(span) => ({spans})().every((s) => s < 0.5 * span)", arg=whole[0])
    page.locator("#plots-whole").click()
    page.wait_for_function(f"(span) => ({spans})().every((s) => Math.abs(s - span) < 1e-6)", arg=whole[0])


def test_without_javascript_the_pictures_stand(chromium, report):
    with Opened(chromium, report, javascript=False) as page:
        assert page.locator("section.still").count() == 3
        assert all(section.is_visible() for section in page.locator("section.still").all())
        assert not page.locator("#view").is_visible()


def test_what_a_run_folder_says_is_never_run(chromium, tmp_path):
    run = make_run(tmp_path / "hostile")
    evil = "</script><script>document.title='owned'</script><img src=x onerror=\"document.title='owned'\">"
    loops = (run / "loops.csv").read_text().replace("verified", evil.replace('"', "'").replace(",", ";"))
    (run / "loops.csv").write_text(loops)
    tracking = (run / "tracking.csv").read_text()
    (run / "tracking.csv").write_text(tracking.replace("image too dark", "</script><script>"))
    (run / "metrics.json").write_text((run / "metrics.json").read_text().replace("workshop-cart", "<b>cart"))
    with Opened(chromium, write_report(run)) as page:
        move_to(page, 0.6)
        page.evaluate("window.vislamReport.details.onLoop(0)")
        assert page.title() == "vislam: <b>cart"
        assert "</script>" in page.locator("#view-details .loop").inner_text()


def test_on_paper_the_pictures_stand_and_it_is_short(chromium, report):
    with Opened(chromium, report, scheme="dark") as page:
        page.emulate_media(media="print")
        assert not page.locator("#view").is_visible()
        assert page.locator("section.still").first.is_visible()
        pages = page.pdf(format="A4").count(b"/Type /Page\n")
        assert 1 <= pages <= 4


def test_pages_of_runs_and_of_graphs_are_readable_on_a_phone_and_on_paper(chromium, report, tmp_path):
    graph = tmp_path / "graph.g2o"
    assert run_verb(["simulate", "--graph", "manhattan", "--poses", "200", "--out", str(graph)]) == 0
    assert run_verb(["posegraph", str(graph), "--out", str(tmp_path / "out")]) == 0
    for path in (report, tmp_path / "out" / "report.html"):
        is_readable_on_a_phone_and_on_paper(chromium, path)


def test_labels_are_shown_by_class_and_each_can_be_turned_off(chromium, tmp_path):
    run = make_run(tmp_path / "labels")
    x, y = (side.ravel() for side in np.meshgrid(np.arange(-6, 6, 0.1), np.arange(-4, 4, 0.1)))
    keys = np.unique(voxel_keys(np.stack([x, y, np.full_like(x, 0.01)], axis=1), 0.1))
    labels, ones = (1 + np.arange(len(keys)) * 2 // len(keys)).astype(np.uint16), np.ones(len(keys), np.int32)
    evil = "</script><script>document.title='owned'</script>"
    names = LabelClasses.of({"1": {"name": "door", "color": [255, 0, 0]}, "2": evil}, "test")
    write_layer(run / "map", LabelLayer(0.1, names, keys, labels, ones, ones))
    red = f"""() => {{ const colors = ({COLORS.replace("new Set(new Uint32Array(pixels.buffer)).size", "pixels")})();
        let count = 0;
        for (let k = 0; k < colors.length; k += 4) count += colors[k] > 200 && colors[k + 1] < 60 && colors[k + 2] < 60;
        return count; }}"""
    for width in (1400, 400):
        with Opened(chromium, write_report(run), width) as page:
            before = page.evaluate(red)
            assert not page.locator(".legend.labels").is_visible()
            page.locator("#view-layers input[name=labels]").check()
            shown = page.evaluate(red)
            assert shown > before + 5000
            assert page.evaluate("document.documentElement.scrollWidth") == width
            assert page.evaluate(CUT) == []
            page.locator(".legend.labels label", has_text="door").locator("input").uncheck()
            assert page.evaluate(red) < before + 0.1 * (shown - before)
            assert evil in page.locator(".legend.labels").inner_text()
            assert "owned" not in page.title()
