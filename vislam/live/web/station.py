"""The page's side in the process that owns the run: starts the server, sends it the run's state, takes commands."""

import logging
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from vislam.core.files import plain
from vislam.live.processes.child import Child, Failure, Flag, Signals
from vislam.live.run_live import LiveRun
from vislam.live.status import status_line
from vislam.live.web import web_process
from vislam.live.web.address import WebAddress, listening
from vislam.live.web.updates import Asked, Status, StepPicture, WebEnds
from vislam.live.web.web_gate import Gate, new_token
from vislam.live.wire.mail import Inbox, Outbox

_LOG = logging.getLogger(__name__)
_SHOW_S = 0.1
_LINGER_S = 1.5  # that browsers have to hear of the end
_NOTICES = 12
_MAX_TEXT = 300
_TOLD_OF_FRONT = ("verdict", "every", "sensors")
_TOLD_OF_MAP = ("found_in_map", "map_left_out", "zero_ns")


class Station:
    """Owns the process of the page. What goes wrong with it is said once; the run goes on without.

    Attributes:
        url: where the page is, with the token.
        is_well: whether the process lives.
    """

    def __init__(self, at: WebAddress, hosts: tuple[str, ...], pose_name: str, out: Path) -> None:
        """Listen, and start the process; raises UsageError where nothing can listen there."""
        listener = listening(at)
        port = listener.getsockname()[1]
        gate = Gate(new_token(), port, frozenset(name.lower() for name in (at.host, *hosts)))
        host = f"[{at.host}]" if ":" in at.host else at.host
        self.address = f"http://{host}:{port}/"
        self.url = f"{self.address}#{gate.token}"  # a fragment is in no log: browsers do not send it
        self._out, self.is_well, self._due_s = out, True, 0.0
        self._notices: deque[tuple[str, str, int]] = deque(maxlen=_NOTICES)
        context = get_context("spawn")
        owner, to_owner = context.Pipe()
        frames, to_frames = context.Pipe(duplex=False)
        map_wire, to_map = context.Pipe()
        from_back, back_wire = context.Pipe(duplex=False)
        self.ends = WebEnds(to_frames, to_map, from_back)
        self._signals = Signals(Flag(), Flag())
        self._signals.go.set()
        body = partial(
            web_process.run, listener=listener, gate=gate, owner=to_owner, frames=frames, map_wire=map_wire,
            back_wire=back_wire, pose_name=pose_name,
        )  # fmt: skip
        self._child = Child.started("web", self._signals, body)
        for end in (to_owner, frames, map_wire, back_wire):
            end.close()
        listener.close()
        self._box, self._inbox = Outbox(owner, 2), Inbox(owner)

    def update(self, phase: str, **values: Any) -> None:
        """Show browsers the run's state; the one before is forgotten."""
        self._watch()
        status = {"phase": phase, "run": self._out.name, "notices": list(self._notices), **values}
        self._box.put(Status(plain(status)))

    def show(self, jpeg: bytes) -> None:
        """Show a picture, if the one before was taken."""
        self._box.put(StepPicture(jpeg))

    def follow(self, run: LiveRun) -> None:
        """Show a run's state, a few times a second, and end it where the page asks for that."""
        for command in self.asked():
            if command.do == "stop":
                _LOG.info("the web page asked for the end of the run")
                run.stop()
        if time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + _SHOW_S
            self.update(_phase(run), **_values(run))

    def asked(self) -> Iterator[Asked]:
        """Yield the commands that have come since."""
        while (command := self._inbox.get()) is not None:
            if isinstance(command, Asked):
                yield command

    @contextmanager
    def noticing(self) -> Iterator[None]:
        """Show the page what is logged meanwhile."""
        handler = _Notices(self._notices)
        logging.getLogger().addHandler(handler)
        try:
            yield
        finally:
            logging.getLogger().removeHandler(handler)

    def end(self, metrics: dict[str, Any]) -> None:
        """Show browsers that the run is over, with its verdict; they have a moment to fetch it."""
        if self.is_well:
            verdict = {name: metrics.get(name) for name in ("frames", "keyframes", "verdict")}
            self.update("ended", line="the run folder is written, with its report", **verdict)
            time.sleep(_LINGER_S)

    def close(self) -> None:
        """End the process; may be called twice."""
        self._signals.stop.set()
        self._child.process.join(1.0)
        if self._child.process.is_alive():
            self._child.process.kill()
            self._child.process.join()
        for end in (self.ends.frames, self.ends.map, self.ends.back):
            end.close()

    def _watch(self) -> None:
        """Log the process's messages, and that it died, once."""
        for message in self._child.messages():
            if isinstance(message, Failure):
                _LOG.error("the web process failed:\n%s", message.traceback)
        if self.is_well and not self._child.process.is_alive() and not self._signals.stop.is_set():
            self.is_well = False
            _LOG.warning("the process of the web page died; the run goes on without the page")


class _Notices(logging.Handler):
    """Keeps the newest of what is logged."""

    def __init__(self, kept: deque[tuple[str, str, int]]) -> None:
        super().__init__(logging.INFO)
        self._kept = kept

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the first line, and when that was."""
        said = record.getMessage().partition("\n")[0][:_MAX_TEXT]
        self._kept.append((record.levelname.lower(), said, time.monotonic_ns()))


def _phase(run: LiveRun) -> str:
    if run.is_ending:
        return "ending"
    return "running" if run.is_going else "getting ready"


def _values(run: LiveRun) -> dict[str, Any]:
    waits = {*run.waits_for}
    fast, front, of_map = (run.notes.get(role, {}) for role in ("fast", "front", "map"))
    states = {
        role: "getting ready" if role in waits else "runs" if process.is_alive() else "ended"
        for role, process in run.processes().items()
    }
    return {
        "line": status_line(run).strip(),
        "processes": states,
        "latency_ms": fast.get("latency_ms", {}),
        "can": [] if run.is_ending else ["stop", "save"] if run.is_going else ["stop"],
        **{name: front[name] for name in _TOLD_OF_FRONT if name in front},
        **{name: of_map[name] for name in _TOLD_OF_MAP if name in of_map},
    }
