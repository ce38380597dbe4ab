"""The process that serves the page: it has copies only, and whatever becomes of it, the run goes on."""

import socket
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from http import HTTPStatus
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from vislam.core.errors import DataError
from vislam.live.processes.child import Life
from vislam.live.web.feed import Feed
from vislam.live.web.server import Answer, Routes, WebServer, as_json
from vislam.live.web.updates import Asked, Save, Undo
from vislam.live.web.web_gate import Gate
from vislam.live.wire.mail import Inbox, Outbox
from vislam.live.wire.publisher import PoseReader
from vislam.runs.report.html import stylesheet
from vislam.runs.report.page_assets import assets

_TURN_S = 0.05
_REOPEN_S = 0.5  # between two looks for the published pose
_MOST_ASKED = 16  # commands that may wait
_MOST_VALUES = 6
_MOST_VALUE = 64  # letters of a word that comes with a command
COMMANDS = ("start", "stop", "calibrate", "next", "cancel")  # for the process that owns the run
_SHARED = (
    "data.js", "shade.js", "shapes.js", "pick.js", "view.js", "tools.js", "layers.js", "plots.js",
    "vendor/three.min.js", "vendor/uplot.min.js",
)  # fmt: skip
_OWN = ("live.js", "map.js", "plan.js", "wizard.js")
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
    '<p class="verdict" id="verdict" role="status"></p>'
    '<header class="bar"><h1 id="run-name">vislam live</h1><span class="badge" id="phase">connecting</span>'
    '<div class="commands" id="commands"></div></header><p class="note line" id="line"></p>'
    '<section class="wizard" id="wizard" hidden></section>'
    '<div class="view" id="view"><div class="stage">'
    '<div class="canvas"><div class="surface">'
    '<canvas id="view-canvas" aria-label="Map and trajectories in 3-D"></canvas>'
    '<div class="over" id="invalid" hidden><b>INVALID</b><span id="invalid-sigma"></span>'
    '<p id="invalid-reason"></p></div></div>'
    '<div class="corner" id="view-tools"></div><div class="legend" id="view-layers"></div></div>'
    '<p class="note of-map" id="of-map"></p></div>'
    '<aside class="details"><img class="frame" id="picture" alt="What the camera sees" hidden>'
    '<p class="of-frame" id="of-picture"></p><div class="loop" id="loop" hidden></div>'
    '<details id="more"><summary>Details</summary><ul class="reasons" id="reasons"></ul>'
    '<dl class="facts" id="facts"></dl><p class="reason" id="reason"></p><div class="flags" id="health"></div>'
    '<h3>Processes</h3><ul class="processes" id="processes"></ul></details></aside>'
    '<div class="plots" id="view-plots"></div></div>'
    '<details class="notices" id="notices-card" hidden><summary>Notices</summary><ul id="notices"></ul></details>'
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


def run(
    life: Life, listener: socket.socket, gate: Gate, owner: Connection, frames: Connection, map_wire: Connection,
    back_wire: Connection, pose_name: str,
) -> None:  # fmt: skip
    """Serve until the run is over.

    Args:
        life: of this process.
        listener: bound and listening.
        gate: who may ask.
        owner: `Status` from the process that owns the run, `Asked` to it.
        frames: `FrameUpdate` from the front process.
        map_wire: `MapUpdate` and `Saved` from the map process, `Save` to it.
        back_wire: `Undo` to the back process.
        pose_name: of the published pose in shared memory.
    """
    feed = Feed()
    commands = _Commands(Outbox(owner, _MOST_ASKED), Outbox(map_wire, 1), Outbox(back_wire, _MOST_ASKED))
    server = WebServer(listener, gate, routes(feed, commands.take))
    threading.Thread(target=server.serve_forever, name="web", daemon=True).start()
    inboxes = [Inbox(owner), Inbox(frames), Inbox(map_wire)]
    poses = _Poses(pose_name)
    life.ready()
    while not life.stopped:
        for inbox in inboxes:
            while (update := inbox.get()) is not None:
                feed.take(update)
        poses.show(feed)
        time.sleep(_TURN_S)
    server.shutdown()


def routes(feed: Feed, command: Callable[[dict[str, Any]], Answer]) -> Routes:
    """Return what can be asked for."""
    static: dict[str, Callable[[Mapping[str, str]], Answer]] = {
        path: partial(_same, answer) for path, answer in page().items()
    }
    changing: dict[str, Callable[[Mapping[str, str]], Answer]] = {
        "/state": lambda query: as_json(feed.state(query)),
        "/map": lambda query: as_json(feed.map(query)),
        "/seen": lambda query: as_json(feed.seen()),
        "/camera.jpg": lambda query: _picture(feed.picture()),
    }
    return Routes(sign_in(), static | changing, command)


class _Commands:
    """Hands on what was posted, if it is one of ours."""

    def __init__(self, owner: Outbox, map_box: Outbox, back: Outbox) -> None:
        self._owner, self._map, self._back = owner, map_box, back

    def take(self, said: dict[str, Any]) -> Answer:
        do = said.get("do")
        if do == "save":
            is_taken = self._map.put(Save())
        elif do == "undo" and _is_plain(said) and (loop_id := said.get("loop", "")).isdecimal():
            is_taken = self._back.put(Undo(int(loop_id)))
        elif do in COMMANDS and _is_plain(said):
            is_taken = self._owner.put(Asked(do, {name: value for name, value in said.items() if name != "do"}))
        else:
            return as_json({"error": "there is no such command"}, HTTPStatus.BAD_REQUEST)
        if not is_taken:
            return as_json({"error": "too many commands wait"}, HTTPStatus.SERVICE_UNAVAILABLE)
        return as_json({"taken": do}, HTTPStatus.ACCEPTED)


def _is_plain(said: dict[str, Any]) -> bool:
    """Return whether a command has a few short words and nothing else."""
    return len(said) <= _MOST_VALUES and all(
        isinstance(value, str) and len(value) <= _MOST_VALUE for value in said.values()
    )


class _Poses:
    """Follows the published pose, as any controller does, from when it is there."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._reader: PoseReader | None = None
        self._due_s = 0.0

    def show(self, feed: Feed) -> None:
        """Show the newest pose, if there is one."""
        if not feed.is_going:
            return
        try:
            if self._reader is None and time.monotonic() >= self._due_s:
                self._due_s = time.monotonic() + _REOPEN_S
                self._reader = PoseReader(self._name)
            pose = None if self._reader is None else self._reader.latest()
        except DataError:  # not yet, or another's
            return
        if pose is not None:
            feed.follow(pose)


def _same(answer: Answer, query: Mapping[str, str]) -> Answer:
    return answer


def _picture(jpeg: bytes) -> Answer:
    return Answer("image/jpeg", jpeg) if jpeg else as_json({"error": "no picture yet"}, HTTPStatus.NOT_FOUND)
