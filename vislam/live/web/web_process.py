"""The process that serves the page: it has copies only, and whatever becomes of it, the run goes on."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from http import HTTPStatus
from multiprocessing.connection import Connection
from typing import Any

from vislam.core.errors import DataError
from vislam.live.processes.child import Life
from vislam.live.web.feed import Feed
from vislam.live.web.pages import page, sign_in
from vislam.live.web.server import Answer, Routes, WebServer, as_json
from vislam.live.web.updates import Asked, Save
from vislam.live.web.web_gate import Gate
from vislam.live.wire.mail import Inbox, Outbox
from vislam.live.wire.publisher import PoseReader

_TURN_S = 0.05
_REOPEN_S = 0.5  # between two looks for the published pose
_MOST_ASKED = 16  # commands that may wait
_MOST_VALUES = 6
_MOST_VALUE = 64  # letters of a word that comes with a command
COMMANDS = ("start", "stop", "calibrate", "next", "cancel")  # for the process that owns the run


def run(
    life: Life, listener: socket.socket, gate: Gate, owner: Connection, frames: Connection, map_wire: Connection,
    pose_name: str,
) -> None:  # fmt: skip
    """Serve until the run is over.

    Args:
        life: of this process.
        listener: bound and listening.
        gate: who may ask.
        owner: `Status` from the process that owns the run, `Asked` to it.
        frames: `FrameUpdate` from the front process.
        map_wire: `MapUpdate` and `Saved` from the map process, `Save` to it.
        pose_name: of the published pose in shared memory.
    """
    feed = Feed()
    commands = _Commands(Outbox(owner, _MOST_ASKED), Outbox(map_wire, 1))
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

    def __init__(self, owner: Outbox, map_box: Outbox) -> None:
        self._owner, self._map = owner, map_box

    def take(self, said: dict[str, Any]) -> Answer:
        do = said.get("do")
        if do == "save":
            is_taken = self._map.put(Save())
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
