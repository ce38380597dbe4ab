"""How tests start a browser, and what they ask of every page: no text is cut, none is too small to read."""

FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip
CUT = """() => [...document.querySelectorAll('h1, h2, h3, p, dt, dd, button, label, summary, figcaption, .tile b')]
    .filter((e) => e.offsetParent && e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display !== 'inline')
    .map((e) => e.tagName + ': ' + e.textContent.slice(0, 60))"""
SMALLEST = """() => Math.min(...[...document.querySelectorAll('main *')]
    .filter((e) => e.offsetParent && !e.closest("svg")
        && [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim()))
    .map((e) => parseFloat(getComputedStyle(e).fontSize)))"""
