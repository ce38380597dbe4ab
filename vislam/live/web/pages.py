"""The page of a live run and the one on which one signs in: static text; all that changes comes by requests."""

from __future__ import annotations

from pathlib import Path

from vislam.live.web.server import Answer
from vislam.runs.report.html import stylesheet
from vislam.runs.report.page_assets import assets

_SHARED = ("data.js", "view.js", "layers.js", "plots.js", "vendor/three.min.js", "vendor/uplot.min.js")
_OWN = ("live.js", "map.js", "wizard.js")
_HEAD = (
    '<!doctype html><html lang="en"><head><meta charset="utf-8">'
    '<meta name="viewport" content="width=device-width, initial-scale=1"><title>vislam live</title>'
    '<link rel="icon" href="data:,"><link rel="stylesheet" href="/style.css">'
)
_SIGN_IN = (
    _HEAD + '<script type="module" src="/sign_in.js"></script></head><body><main class="sign-in"><h1>vislam live</h1>'
    "<p>The run printed the whole address, with the token in it, where it was started.</p>"
    '<form id="form"><label for="token">Token</label><input id="token" autocomplete="off" spellcheck="false" '
    'autocapitalize="none"><button type="submit">Sign in</button></form><p class="note" id="said" role="status"></p>'
    "<noscript><p>This page needs JavaScript.</p></noscript></main></body></html>"
)
_PAGE = (
    _HEAD + '<script src="/vendor/three.min.js"></script><script src="/vendor/uplot.min.js"></script>'
    '<script type="module" src="/live.js"></script></head><body><main>'
    '<header class="bar"><h1 id="run-name">vislam live</h1><span class="badge" id="phase">connecting</span>'
    '<div class="commands" id="commands"></div></header>'
    '<p class="verdict" id="verdict"></p><p class="note line" id="line"></p>'
    '<section class="wizard" id="wizard" hidden></section>'
    '<div class="view" id="view"><div class="stage">'
    '<div class="canvas"><div class="surface">'
    '<canvas id="view-canvas" aria-label="Map and trajectories in 3-D"></canvas></div>'
    '<div class="corner"><button type="button" id="view-home">Whole</button>'
    '<button type="button" id="view-above">From above</button></div>'
    '<div class="legend" id="view-layers"></div></div>'
    '<p class="note of-map" id="of-map"></p></div>'
    '<aside class="details"><img class="frame" id="picture" alt="What the camera sees" hidden>'
    '<p class="of-frame" id="of-picture"></p><dl class="facts" id="facts"></dl><p class="reason" id="reason"></p>'
    '<div class="flags" id="health"></div><h3>Processes</h3><ul class="processes" id="processes"></ul></aside>'
    '<div class="plots" id="view-plots"></div></div>'
    '<section class="card notices" id="notices-card" hidden><h3>Notices</h3><ul id="notices"></ul></section>'
    "<noscript><p>This page needs JavaScript.</p></noscript></main></body></html>"
)


def sign_in() -> dict[str, Answer]:
    """Return what may be seen without the token: how one signs in with it."""
    return {"/": _html(_SIGN_IN), "/sign_in.js": _script(_own("sign_in.js")), "/style.css": _style()}


def page() -> dict[str, Answer]:
    """Return the page and its scripts, by path."""
    scripts = {name: assets(name) for name in _SHARED} | {name: _own(name) for name in _OWN}
    return {"/": _html(_PAGE), **{f"/{name}": _script(text) for name, text in scripts.items()}}


def _own(name: str) -> str:
    return (Path(__file__).with_name("assets") / name).read_text(encoding="utf-8")


def _html(text: str) -> Answer:
    return Answer("text/html; charset=utf-8", text.encode())


def _script(text: str) -> Answer:
    return Answer("text/javascript; charset=utf-8", text.encode())


def _style() -> Answer:
    text = stylesheet() + assets("vendor/uplot.min.css") + assets("view.css") + _own("live.css")
    return Answer("text/css; charset=utf-8", text.encode())
