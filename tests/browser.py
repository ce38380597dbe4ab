"""How tests start a browser, and what they ask of every page: no text is cut, none is too small to read."""

from waiting import HUNG_S

PATIENCE_MS = 1000.0 * HUNG_S
FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip
NO_WEBGL = """HTMLCanvasElement.prototype.getContext = new Proxy(HTMLCanvasElement.prototype.getContext, {
    apply: (get, canvas, [kind, ...rest]) => (kind.startsWith("webgl") ? null : get.call(canvas, kind, ...rest)) });"""
CUT = """() => [...document.querySelectorAll('h1, h2, h3, p, dt, dd, button, label, summary, figcaption, .tile b')]
    .filter((e) => e.offsetParent && e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display !== 'inline')
    .map((e) => e.tagName + ': ' + e.textContent.slice(0, 60))"""
SMALLEST = """() => Math.min(...[...document.querySelectorAll('main *')]
    .filter((e) => e.offsetParent && !e.closest("svg")
        && [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim()))
    .map((e) => parseFloat(getComputedStyle(e).fontSize)))"""
DRAWN = """() => Math.min(...[...document.querySelectorAll('main svg text')].filter((e) => e.getClientRects().length)
    .map((e) => [e.getScreenCTM(), parseFloat(getComputedStyle(e).fontSize)])
    .map(([{ a, b }, size]) => size * Math.hypot(a, b)))"""
WIDE = """() => [...document.querySelectorAll('.scroll')].filter((e) => e.offsetParent)
    .filter((e) => e.scrollWidth > e.clientWidth + 1).map((e) => e.textContent.slice(0, 60))"""
ALONE = """() => [...document.querySelectorAll('h2')].filter((e) => e.offsetParent)
    .filter((e) => getComputedStyle(e).breakAfter !== 'avoid' || ![...e.parentElement.children].some((other) =>
        other !== e && other.offsetHeight > 0)).map((e) => e.textContent)"""
PAPER_PX = 703  # between the margins of A4


def is_readable_on_a_phone_and_on_paper(chromium, path) -> None:
    """On a phone no letter is smaller than 11 px; on paper no table is cut and no heading stands alone."""
    page = chromium.new_page(viewport={"width": 400, "height": 900})
    page.set_default_timeout(PATIENCE_MS)
    page.goto(path.resolve().as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == 400
    assert page.evaluate(CUT) == []
    assert min(page.evaluate(SMALLEST), page.evaluate(DRAWN)) >= 11.0
    page.set_viewport_size({"width": PAPER_PX, "height": 1000})
    page.emulate_media(media="print")
    assert page.evaluate(WIDE) == []
    assert page.evaluate(ALONE) == []
    page.close()
