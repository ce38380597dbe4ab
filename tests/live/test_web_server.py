"""The page of a live run as a stranger meets it: who is let in, what a request may be, and how much of it."""

import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from vislam.core.errors import UsageError
from vislam.live.web.address import listening, parsed
from vislam.live.web.feed import Feed
from vislam.live.web.server import WebServer, as_json
from vislam.live.web.web_gate import Gate, new_token
from vislam.live.web.web_process import routes
from waiting import wait_for

_TOKEN = "Zk3vQ9-this-is-a-token-of-tests_0aB7"  # a drawn one would name tests anew in each worker
_MOST, _REQUEST_S = 6, 0.5
_HANG_S = 300.0
_JSON = {"Content-Type": "application/json"}


class Site:
    """A server of the page, without a run."""

    def __init__(self) -> None:
        self.commands: list[dict] = []
        listener = listening(parsed("127.0.0.1:0"))
        self.port = listener.getsockname()[1]
        self.gate = Gate(_TOKEN, self.port, frozenset({"cart.example"}))
        self.server = WebServer(listener, self.gate, routes(Feed(), self._command), _MOST, _REQUEST_S)
        threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()

    def _command(self, said: dict):
        self.commands.append(said)
        return as_json({"taken": True})

    def ask(self, method: str, path: str, body: str | None = None, **headers: str) -> tuple[int, dict, bytes]:
        """Return status, headers and body of one request with the token, unless `headers` say otherwise."""
        sent = {"Authorization": f"Bearer {_TOKEN}", **{name.replace("_", "-"): v for name, v in headers.items()}}
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=_HANG_S)) as connection:
            connection.request(method, path, body, {name: value for name, value in sent.items() if value})
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()

    def raw(self, data: bytes) -> bytes:
        """Return what comes back to these bytes, until the connection ends."""
        with closing(socket.create_connection(("127.0.0.1", self.port), timeout=_HANG_S)) as sock:
            sock.sendall(data)
            said = b""
            try:
                while part := sock.recv(65536):
                    said += part
            except ConnectionResetError:
                pass
            return said


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    made = Site()
    yield made
    made.server.shutdown()
    made.server.server_close()


def all_places(site: Site) -> list[http.client.HTTPConnection]:
    """Return as many served connections as there may be, or none where one of before is not gone yet."""
    held = []
    for _ in range(_MOST):
        connection = http.client.HTTPConnection("127.0.0.1", site.port, timeout=_HANG_S)
        held.append(connection)
        try:
            connection.request("GET", "/state", headers={"Authorization": f"Bearer {_TOKEN}"})
            assert connection.getresponse().read()
        except (http.client.BadStatusLine, ConnectionError):
            for one in held:
                one.close()
            return []
    return held


def test_the_loopback_is_listened_at_where_nothing_is_said() -> None:
    assert parsed(":80").host == "127.0.0.1"
    assert parsed(":80").is_loopback
    assert not parsed("0.0.0.0:80").is_loopback
    assert parsed("[::1]:8765").host == "::1"


@pytest.mark.parametrize("text", ["", "8765", "host", "a b:1", "x:70000", "x:-1", "http://x:80", "x:٣", "../x:1"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--web HOST:PORT"):
        parsed(text)


def test_an_address_that_is_taken_is_told(site: Site) -> None:
    with pytest.raises(UsageError, match="another address"):
        listening(parsed(f"127.0.0.1:{site.port}"))


def test_with_the_token_the_page_and_all_its_parts_are_there(site: Site) -> None:
    status, headers, body = site.ask("GET", "/")
    assert status == 200
    assert b"view-canvas" in body
    assert headers["Content-Type"].startswith("text/html")
    for path in ("/live.js", "/view.js", "/vendor/three.min.js", "/style.css", "/state", "/map", "/seen"):
        assert site.ask("GET", path)[0] == 200
    assert site.ask("GET", "/camera.jpg")[0] == 404  # nothing was seen yet


@pytest.mark.parametrize("path", ["/state", "/map", "/seen", "/camera.jpg", "/live.js"])
@pytest.mark.parametrize("authorization", ["", "Bearer ", "Bearer wrong", f"Basic {_TOKEN}", f"Bearer {_TOKEN}x"])
def test_without_the_token_nothing_of_the_run_is_told(site: Site, path: str, authorization: str) -> None:
    assert site.ask("GET", path, Authorization=authorization)[0] == 401
    assert b"view-canvas" not in site.ask("GET", "/", Authorization=authorization)[2]


def test_without_the_token_no_command_is_taken(site: Site) -> None:
    before = len(site.commands)
    assert site.ask("POST", "/command", '{"do": "stop"}', Authorization="", **_JSON)[0] == 401
    assert len(site.commands) == before


def test_the_token_is_changed_for_a_cookie_that_no_script_reads_and_no_other_page_sends(site: Site) -> None:
    status, headers, _ = site.ask("POST", "/sign-in", json.dumps({"token": _TOKEN}), Authorization="", **_JSON)
    cookie = headers["Set-Cookie"]
    assert status == 200
    assert {"HttpOnly", "SameSite=Strict"} <= {part.strip() for part in cookie.split(";")}
    assert site.ask("GET", "/state", Authorization="", Cookie=cookie.partition(";")[0])[0] == 200
    assert site.ask("GET", "/state", Authorization="", Cookie=cookie.partition(";")[0] + "x")[0] == 401


@pytest.mark.parametrize("token", ["wrong", "", None, 7, ["x"], _TOKEN[:-1]])
def test_a_wrong_token_gets_no_cookie(site: Site, token: object) -> None:
    status, headers, _ = site.ask("POST", "/sign-in", json.dumps({"token": token}), Authorization="", **_JSON)
    assert (status, "Set-Cookie" in headers) == (401, False)


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "", "cart.example.evil", "127.0.0.1@evil", "a:b:c"]
)
def test_a_name_that_is_not_ours_is_refused_for_it_may_have_been_pointed_here(site: Site, host: str) -> None:
    assert site.raw(f"GET / HTTP/1.1\r\nHost: {host}\r\n\r\n".encode()).startswith(b"HTTP/1.1 403")


@pytest.mark.parametrize("host", ["localhost:9000", "127.0.0.1", "[::1]:1", "192.168.1.7:8765", "cart.example"])
def test_ways_of_the_user_to_the_page_are_let_in(site: Site, host: str) -> None:
    assert site.ask("GET", "/state", Host=host)[0] == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://localhost:1"},
        {"Origin": "file://"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
    ],
)
def test_requests_of_other_pages_are_refused(site: Site, headers: dict[str, str]) -> None:
    before = len(site.commands)
    for method, path, body in (("GET", "/state", None), ("GET", "/", None), ("POST", "/command", '{"do": "stop"}')):
        status, answered, _ = site.ask(method, path, body, **headers, **_JSON)
        assert status == 403
        assert not any(name.lower().startswith("access-control") for name in answered)
    assert len(site.commands) == before


def test_a_preflight_of_another_page_gets_nothing(site: Site) -> None:
    status, headers, _ = site.ask("OPTIONS", "/command", Origin="http://evil.example")
    assert status == 501
    assert not any(name.lower().startswith("access-control") for name in headers)


def test_the_own_page_may_command(site: Site) -> None:
    own = f"http://127.0.0.1:{site.port}"
    status, _, _ = site.ask("POST", "/command", '{"do": "stop"}', Origin=own, Sec_Fetch_Site="same-origin", **_JSON)
    assert status == 200
    assert site.commands[-1] == {"do": "stop"}


def test_no_answer_may_be_framed_sniffed_kept_or_run_scripts_of_others(site: Site) -> None:
    for path in ("/", "/state", "/nothing"):
        headers = site.ask("GET", path)[1]
        policy = headers["Content-Security-Policy"]
        assert "script-src 'self'" in policy
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Cache-Control"] == "no-store"
        assert headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.parametrize(
    "path",
    ["/../pyproject.toml", "/%2e%2e/etc/passwd", "/vendor/../page.js", "//etc/passwd", "/vendor/", "/static/live.js",
     "/live.js/", "/vendor/three.LICENSE", "/report.html", "/session.db", "/log.txt"],
)  # fmt: skip
def test_a_path_is_a_word_of_a_list_and_never_names_a_file(site: Site, path: str) -> None:
    assert site.ask("GET", path)[0] == 404


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ("", 400),
        ("x", 400),
        ("[]", 400),
        ("3", 400),
        ("NaN", 400),
        ('{"a": 1', 400),
        ("[" * 4000, 400),
        ("x" * 5000, 413),
    ],
)
def test_what_is_no_command_is_refused(site: Site, body: str, status: int) -> None:
    before = len(site.commands)
    assert site.ask("POST", "/command", body, **_JSON)[0] == status
    assert len(site.commands) == before


def test_a_body_that_is_not_said_to_be_json_is_refused_as_forms_of_other_pages_are(site: Site) -> None:
    assert site.ask("POST", "/command", '{"do": "stop"}', Content_Type="text/plain")[0] == 415


@pytest.mark.parametrize(
    "head",
    [
        "POST /command HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99999999999999\r\n\r\n",
        "POST /command HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
        "POST /command HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        "POST /command HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\nContent-Length: 3\r\n\r\n{}",
        "GET /state HTTP/1.1\r\nHost: localhost\r\nHost: evil\r\n\r\n",
        "GET http://localhost/state HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "BREW / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "GET / HTTP/9.9\r\nHost: localhost\r\n\r\n",
        "\0\1\2\3\r\n\r\n",
        "GET /\r\n\r\n",
    ],
)
def test_what_is_no_request_ends_its_connection_and_no_other(site: Site, head: str) -> None:
    sent = head.replace("Host: localhost\r\n", f"Host: localhost\r\nAuthorization: Bearer {_TOKEN}\r\n", 1)
    said = site.raw(sent.encode())
    assert b" 200 " not in said.partition(b"\r\n")[0]
    assert b"Traceback" not in said
    assert site.ask("GET", "/state")[0] == 200


@pytest.mark.parametrize(
    "head",
    [
        b"GET /" + b"x" * 100_000,
        b"GET / HTTP/1.1\r\nHost: localhost\r\nCookie: " + b"x" * 100_000,
        b"GET / HTTP/1.1\r\n" + b"".join(b"X-%d: %s\r\n" % (k, b"y" * 100) for k in range(1000)),
    ],
)
def test_heads_are_bounded(site: Site, head: bytes) -> None:
    said = site.raw(head + b"\r\n\r\n")
    assert said == b"" or said.startswith((b"HTTP/1.1 431", b"HTTP/1.1 414"))
    assert site.ask("GET", "/state")[0] == 200


def test_a_request_whose_bytes_drip_is_given_up(site: Site) -> None:
    with closing(socket.create_connection(("127.0.0.1", site.port), timeout=_HANG_S)) as sock:
        sock.sendall(b"GET /state HTTP/1.1\r\nX: ")
        end = time.monotonic() + _HANG_S
        try:
            while time.monotonic() < end:
                sock.sendall(b"y")
                time.sleep(0.025)
        except OSError:
            return  # the server has closed it
    pytest.fail("the connection was kept")


def test_a_body_that_never_comes_is_given_up(site: Site) -> None:
    head = f"POST /command HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {_TOKEN}\r\nContent-Length: 50\r\n"
    assert b" 200 " not in site.raw(f"{head}Content-Type: application/json\r\n\r\n{{".encode())


def test_connections_are_so_many_and_when_some_end_others_are_let_in(site: Site) -> None:
    held: list[http.client.HTTPConnection] = []
    wait_for(lambda: bool(held.extend(all_places(site)) or held))
    try:
        before = site.server.counters.connections_refused
        assert site.raw(b"") == b""
        assert site.server.counters.connections_refused == before + 1
    finally:
        for connection in held:
            connection.close()
    again: list[http.client.HTTPConnection] = []
    wait_for(lambda: bool(again.extend(all_places(site)) or again))
    for connection in again:
        connection.close()


def test_idle_connections_lock_nobody_out(site: Site) -> None:
    idle = [socket.create_connection(("127.0.0.1", site.port)) for _ in range(_MOST + 8)]
    own: list[http.client.HTTPConnection] = []
    try:
        wait_for(lambda: bool(own.extend(all_places(site)) or own))
        assert len(own) == _MOST  # the user's own have taken the places of those that show no token
        for connection in own:  # and keep them
            connection.request("GET", "/state", headers={"Authorization": f"Bearer {_TOKEN}"})
            assert connection.getresponse().status == 200
    finally:
        for one in (*idle, *own):
            one.close()


def test_tokens_are_long_and_no_two_are_alike() -> None:
    assert len({new_token() for _ in range(100)}) == 100
    assert len(new_token()) >= 32
    assert _TOKEN not in repr(Gate(_TOKEN, 1))
