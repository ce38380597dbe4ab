"""Take the picture of a report that README shows, in a real browser.

    ./run demo
    .venv/bin/python docs/picture_of_report.py demo/report.html

It needs Debian's chromium and the `dev` extra (playwright).
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

FLAGS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run",
         "--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # fmt: skip
SIZE = {"width": 1400, "height": 980}
PATIENCE_MS = 180_000
OUT = Path(__file__).parent / "images" / "report.jpg"


def main(report: Path) -> None:
    """Write OUT."""
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = chromium.new_page(viewport=SIZE, color_scheme="light")
        page.set_default_timeout(PATIENCE_MS)
        page.goto(report.resolve().as_uri())
        page.wait_for_selector("html[data-ready]")
        page.evaluate("() => { const v = window.vislamReport.view; v.rest(); v.draw(); }")
        page.screenshot(path=OUT, type="jpeg", quality=82)
        chromium.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
