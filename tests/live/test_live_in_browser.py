"""The page of a live run in a real browser: it begins a run, shows it, saves its map and ends it; nothing is cut."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from browser import CUT, PATIENCE_MS, SMALLEST
from waiting import HUNG_S

_WORLD = "replay:points:laps,rig=rgbd,camera_hz=10,duration_s=600"


class Live:
    """`vislam live --web` as a process, and the address that it printed."""

    def __init__(self, out: Path, *options: str) -> None:
        self.out = out
        name = f"vislam-test-page-{os.getpid()}-{out.name}"
        command = [sys.executable, "-m", "vislam", "live", "--out", str(out), "--web", "127.0.0.1:0"]
        command += ["--live.name", name, "--live.send-to", "unix", "--view.no-enabled", "--map.no-enabled", *options]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        assert self.process.stderr is not None
        found = None
        while found is None:
            line = self.process.stderr.readline()
            assert line, "it ended before it said where its page is"
            found = re.search(r"http://127\.0\.0\.1:\d+/#\S+", line)
        self.url = found.group(0)

    def ended(self) -> int:
        """Return the exit code when it ends."""
        self.process.communicate(timeout=HUNG_S)
        return self.process.returncode

    def kill(self) -> None:
        """End it at once, if it has not ended."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.communicate(timeout=60)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.communicate()


@pytest.fixture
def waiting(tmp_path: Path) -> Iterator[Live]:
    live = Live(tmp_path / "drive", "--source", _WORLD, "--web-waits")
    yield live
    live.kill()


def opened(chromium, url: str, width: int = 1400, scheme: str = "light"):
    """Return a page that has signed in, and what goes wrong in it."""
    context = chromium.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme, has_touch=width < 500)
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(url)
    page.wait_for_selector("html[data-phase]")
    return page, faults


def phase(page, name: str) -> None:
    page.wait_for_selector(f'html[data-phase="{name}"]')


def looks_right(page, width: int) -> None:
    """Nothing is cut or too small to read, and the page is as wide as the screen."""
    assert page.evaluate("document.documentElement.scrollWidth") == width
    assert page.evaluate(CUT) == []
    assert page.evaluate(SMALLEST) >= 11.0


def undo_a_loop(page) -> None:
    """Click a loop that is in the graph, and take it out; the graph's own word for that comes back."""
    rows = "window.vislamLive.view.data.loops.rows"
    page.wait_for_function(f"() => {rows}.some((row) => row.decision === 'accepted')")
    loop_id = page.evaluate(
        f"() => {{ const k = {rows}.findIndex((row) => row.decision === 'accepted');"
        f" window.vislamLive.view.onLoop(k); return {rows}[k].id; }}"
    )
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("button", name="Really undo?").click()
    page.wait_for_function(f"(id) => {rows}.some((row) => row.id === id && row.decision === 'undone')", arg=loop_id)
    page.locator("#facts").get_by_text("Loops undone").wait_for()


def test_a_run_is_begun_seen_saved_and_ended_in_a_browser(chromium, waiting) -> None:
    page, faults = opened(chromium, waiting.url)
    phone, phone_faults = opened(chromium, waiting.url, 400, "dark")
    phase(page, "waiting")
    assert "#" not in page.url  # the token is not left in the address
    looks_right(page, 1400)
    page.get_by_role("button", name="Start").click()
    phase(page, "running")
    page.wait_for_function("() => Number(document.documentElement.dataset.points) > 100")
    place = "() => Array.from(window.vislamLive.view.marker.matrix.elements)"
    before = page.evaluate(place)
    page.wait_for_function(f"(before) => ({place})().join() !== before.join()", arg=before)
    page.get_by_text("Details", exact=True).click()
    facts = page.locator("#facts").inner_text()
    assert "x, y, z [m]" in facts
    assert "Keyframes" in facts
    assert page.locator("#processes li").count() == 4
    first = page.locator("main > *").first
    assert first.get_attribute("id") == "verdict" and "±" in first.inner_text()
    phone.wait_for_function("() => Number(document.documentElement.dataset.points) > 100")
    looks_right(page, 1400)
    looks_right(phone, 400)
    undo_a_loop(page)
    page.get_by_role("button", name="Save map").click()
    page.get_by_text("saved/trajectory.tum").first.wait_for()
    assert (waiting.out / "saved" / "trajectory.tum").stat().st_size > 0
    page.get_by_role("button", name="Stop").click()
    page.get_by_role("button", name="Really stop?").click()
    phase(page, "ended")
    assert waiting.ended() == 0
    assert {"metrics.json", "report.html", "trajectory_graph.tum"} <= {path.name for path in waiting.out.iterdir()}
    assert faults == phone_faults == []
