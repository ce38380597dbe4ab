"""The server of the page: the standard library's, with bounds on everything and nothing that names a path.

What can be asked for is a table; a request chooses among its entries and never names a file.
"""

import json
import logging
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from vislam.live.web.web_gate import Gate

_LOG = logging.getLogger(__name__)
_MOST_CONNECTIONS = 32
_IDLE_S, _REQUEST_S, _ANSWER_S = 20.0, 10.0, 20.0
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
MOST_HEAD_BYTES = 16_384
MOST_BODY_BYTES = 4096
_CHUNK = 4096


class TooLarge(Exception):
    """A request has more bytes than any of ours."""


class RequestReader:
    """In the place of a socket's file: no request is read longer than its time, however slowly its bytes drip."""

    def __init__(self, sock: socket.socket, idle_s: float, request_s: float) -> None:
        """Read from a socket.

        Args:
            sock: a connected one.
            idle_s: that a connection may wait for its next request.
            request_s: from the first byte of a request to its last.
        """
        self._socket, self._idle_s, self._request_s = sock, idle_s, request_s
        self._pending = bytearray()
        self._left = MOST_HEAD_BYTES
        self._deadline = 0.0
        self._is_begun = False
        self.closed = False

    def begin(self) -> None:
        """Expect a new request: with it, bounds begin again."""
        self._left = MOST_HEAD_BYTES
        self._is_begun = False
        self._deadline = time.monotonic() + self._idle_s

    def readline(self, limit: int = -1) -> bytes:
        """Return the next line, with its end; shorter at the end of the stream. `limit` is that of the whole head.

        Raises TooLarge, or TimeoutError when the request takes too long.
        """
        while (end := self._pending.find(b"\n")) < 0:
            if len(self._pending) > self._left:
                raise TooLarge
            if not self._fill():
                return self._take(len(self._pending))
        if end + 1 > self._left:
            raise TooLarge
        self._left -= end + 1
        return self._take(end + 1)

    def read(self, count: int) -> bytes:
        """Return `count` bytes of a body, fewer at the end of the stream; raises as `readline`."""
        if count > MOST_BODY_BYTES:
            raise TooLarge
        while len(self._pending) < count and self._fill():
            continue
        return self._take(min(count, len(self._pending)))

    def close(self) -> None:
        """Do nothing: the socket belongs to the caller."""
        self.closed = True

    def _fill(self) -> bool:
        left_s = self._deadline - time.monotonic()
        if left_s <= 0.0:
            raise TimeoutError("the request took too long")
        self._socket.settimeout(left_s)
        data = self._socket.recv(_CHUNK)
        if data and not self._is_begun:
            self._is_begun = True
            self._deadline = time.monotonic() + self._request_s
        self._pending += data
        return bool(data)

    def _take(self, count: int) -> bytes:
        taken = bytes(self._pending[:count])
        del self._pending[:count]
        return taken


@dataclass(frozen=True, slots=True)
class Answer:
    """What is sent back."""

    kind: str  # the media type
    body: bytes
    status: HTTPStatus = HTTPStatus.OK


def as_json(value: Any, status: HTTPStatus = HTTPStatus.OK) -> Answer:
    """Return an answer in JSON; raises ValueError for numbers that JSON does not have."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return Answer("application/json", text.encode(), status)


@dataclass(frozen=True, slots=True)
class Routes:
    """What can be asked for, by its whole path.

    Attributes:
        public: without the token: what one signs in with.
        private: with it; the query's entries are given, whose names and values are short text.
        command: takes what was posted to /command, and answers.
    """

    public: Mapping[str, Answer]
    private: Mapping[str, Callable[[Mapping[str, str]], Answer]]
    command: Callable[[dict[str, Any]], Answer]


@dataclass(slots=True)
class Counters:
    """What the server met, for the log."""

    requests: int = 0
    refused: int = 0
    connections_refused: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, name: str) -> None:
        """Count one."""
        with self.lock:
            setattr(self, name, getattr(self, name) + 1)


class WebServer(ThreadingHTTPServer):
    """Serves at a socket that listens already: a thread for each of a bounded number of connections."""

    daemon_threads = True
    block_on_close = False

    def __init__(
        self, listener: socket.socket, gate: Gate, routes: Routes, most: int = _MOST_CONNECTIONS,
        request_s: float = _REQUEST_S,
    ) -> None:  # fmt: skip
        """Take over a socket.

        Args:
            listener: bound and listening.
            gate: decides who may ask.
            routes: what for.
            most: connections at a time. A further one takes the place of the oldest that has shown no token, so that
                idle ones lock no user out; where all have shown one, it is closed at once.
            request_s: that a request may take to arrive.
        """
        super().__init__(listener.getsockname(), _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listener
        self.gate, self.routes, self.counters, self.request_s = gate, routes, Counters(), request_s
        self._most = most
        self._open: dict[Any, bool] = {}  # connections, the oldest first, and whether each has shown the token

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread; where there are too many, one that has shown no token is closed."""
        refused: Any = None
        with self.counters.lock:
            if len(self._open) >= self._most:
                refused = next((one for one, is_known in self._open.items() if not is_known), request)
                self._open.pop(refused, None)
            if refused is not request:
                self._open[request] = False
        if refused is not None:
            self.counters.add("connections_refused")
            with suppress(OSError):
                refused.shutdown(socket.SHUT_RDWR)  # its thread ends by that
        if refused is request:
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:  # no thread could be started
            self.forget(request)
            raise

    def know(self, request: Any) -> None:
        """Keep the place of a connection, which has shown the token."""
        with self.counters.lock:
            if request in self._open:
                self._open[request] = True

    def forget(self, request: Any) -> None:
        """Free the place of a connection."""
        with self.counters.lock:
            self._open.pop(request, None)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection to its end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.forget(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log what a connection raised: most went away, and others need none of the rest."""
        _LOG.debug("a connection to the web page failed", exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    """One connection: request after request."""

    protocol_version = "HTTP/1.1"
    server: WebServer

    def setup(self) -> None:
        super().setup()
        self.rfile.close()
        self.request_version, self.requestline, self.command = self.protocol_version, "", ""  # until one was read
        self._reader = RequestReader(self.connection, _IDLE_S, self.server.request_s)
        self.rfile = self._reader  # type: ignore[assignment]

    def handle_one_request(self) -> None:
        """Answer one request; what is no request of ours ends the connection."""
        self._reader.begin()
        try:
            super().handle_one_request()
        except TooLarge:
            self.close_connection = True
            with suppress(OSError):
                self.send_error(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE)
        except OSError:
            self.close_connection = True

    def do_GET(self) -> None:
        """Answer what can be seen."""
        self.server.counters.add("requests")
        path, query = self._asked()
        if path is None or not self._is_ours():
            return
        make, public = self.server.routes.private.get(path), self.server.routes.public.get(path)
        if make is not None and self.server.gate.admits(self.headers):
            self.server.know(self.connection)
            self._send(make(query))
        elif public is not None:
            self._send(public)
        elif make is not None:
            self._refuse(HTTPStatus.UNAUTHORIZED, "the token is missing")
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such thing")

    def do_POST(self) -> None:
        """Take a command, or the token."""
        self.server.counters.add("requests")
        path, _ = self._asked()
        if path is None or not self._is_ours():
            return
        if path == "/command":
            if not self.server.gate.admits(self.headers):
                self._refuse(HTTPStatus.UNAUTHORIZED, "the token is missing")
                return
            self.server.know(self.connection)
        if path not in ("/command", "/sign-in"):
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such thing")
            return
        said = self._body()
        if said is None:
            return
        if path == "/command":
            self._send(self.server.routes.command(said))
        elif self.server.gate.is_token(said.get("token")):
            self._send(as_json({"signed_in": True}), {"Set-Cookie": self.server.gate.cookie()})
        else:
            self._refuse(HTTPStatus.UNAUTHORIZED, "this is not the token")

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Say what the base class found wrong with a request, and end the connection."""
        self._refuse(HTTPStatus(code), HTTPStatus(code).phrase)

    def version_string(self) -> str:
        """Return the header Server: no versions."""
        return "vislam"

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: requests come ten times a second."""

    def _asked(self) -> tuple[str | None, dict[str, str]]:
        """Return path and query; None where the target is none, which is answered then."""
        if not self.path.startswith("/"):
            self._refuse(HTTPStatus.BAD_REQUEST, "this is no path")
            return None, {}
        try:
            split = urlsplit(self.path)
            query = dict(parse_qsl(split.query, max_num_fields=8))
        except ValueError:
            self._refuse(HTTPStatus.BAD_REQUEST, "this is no path")
            return None, {}
        return split.path, query

    def _is_ours(self) -> bool:
        """Return whether a request may be looked at; refuse it otherwise."""
        for name in ("Host", "Origin", "Content-Length", "Cookie", "Authorization"):
            if len(self.headers.get_all(name, [])) > 1:
                self._refuse(HTTPStatus.BAD_REQUEST, f"{name} is there twice")
                return False
        reason = self.server.gate.refusal(self.headers)
        if reason is not None:
            self._refuse(HTTPStatus.FORBIDDEN, reason)
        return reason is None

    def _body(self) -> dict[str, Any] | None:
        """Return the object that was posted; None where there is none, which is answered then."""
        length = self.headers.get("Content-Length", "")
        if "Transfer-Encoding" in self.headers or not (length.isascii() and length.isdigit() and len(length) < 10):
            self._refuse(HTTPStatus.LENGTH_REQUIRED, "the length of the body is missing")
            return None
        if int(length) > MOST_BODY_BYTES:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a body has at most {MOST_BODY_BYTES} bytes")
            return None
        if self.headers.get_content_type() != "application/json":
            self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "a body is JSON")
            return None
        data = self.rfile.read(int(length))
        try:
            said = json.loads(data) if len(data) == int(length) else None
        except (ValueError, RecursionError):
            said = None
        if not isinstance(said, dict):
            self._refuse(HTTPStatus.BAD_REQUEST, "the body is no JSON object")
            return None
        return said

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        """Say no, and end the connection: what follows on it may not be a request."""
        self.server.counters.add("refused")
        self.close_connection = True
        self._send(as_json({"error": why}, status), {"Connection": "close"})

    def _send(self, answer: Answer, further: Mapping[str, str] | None = None) -> None:
        self.connection.settimeout(_ANSWER_S)  # of the whole answer
        self.send_response(answer.status)
        for name, value in {**_HEADERS, **(further or {})}.items():
            self.send_header(name, value)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(answer.body)))
        self.end_headers()
        self.wfile.write(answer.body)
