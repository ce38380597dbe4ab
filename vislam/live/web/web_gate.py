"""Access to the web page: with the token, from the page itself, at a name of this machine.

A foreign page that is open in the same browser must reach nothing: its requests carry its own Origin and
Sec-Fetch-Site, and a name of its own that it points at this machine (DNS rebinding) is in Host.
"""

import hmac
import secrets
from dataclasses import dataclass, field
from email.message import Message
from http.cookies import CookieError, SimpleCookie
from urllib.parse import urlsplit

from vislam.live.web.address import is_address

_TOKEN_BYTES = 24  # 192 bits
_COOKIE = "vislam-web"


def new_token() -> str:
    """Return a token that cannot be guessed."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


@dataclass(frozen=True, slots=True)
class Gate:
    """Judges requests by their headers alone.

    Attributes:
        token: who knows it may see and steer the run.
        port: on which it listens; it is in the cookie's name, for browsers share cookies between ports.
        hosts: names by which the page may be asked for, beside localhost and IP addresses.
    """

    token: str = field(repr=False)
    port: int
    hosts: frozenset[str] = frozenset()

    def refusal(self, headers: Message) -> str | None:
        """Return why a request is refused whatever its token; None: it is not."""
        host = headers.get("Host", "")
        name = _host_name(host)
        if name is None or not (name in {"localhost", *self.hosts} or is_address(name)):
            return "this name is not one of this page; --web-host NAME allows one"
        origin = headers.get("Origin")
        if origin is not None and _origin_host(origin) != host.lower():
            return "requests of other pages are refused"
        if headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            return "requests of other pages are refused; type or paste the address"
        return None

    def admits(self, headers: Message) -> bool:
        """Return whether a request carries the token, in the cookie or as `Authorization: Bearer TOKEN`."""
        kind, _, given = headers.get("Authorization", "").partition(" ")
        if kind == "Bearer":
            return self.is_token(given.strip())
        try:
            morsel = SimpleCookie(headers.get("Cookie", "")).get(self._cookie)
        except CookieError:
            return False
        return morsel is not None and self.is_token(morsel.value)

    def is_token(self, given: object) -> bool:
        """Return whether this is the token, in a time that does not depend on how much of it is right."""
        return isinstance(given, str) and hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode())

    def cookie(self) -> str:
        """Return the header Set-Cookie for a browser with the token: no script reads it, no other page sends it."""
        return f"{self._cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    @property
    def _cookie(self) -> str:
        return f"{_COOKIE}-{self.port}"


def _host_name(host: str) -> str | None:
    """Return the name in a Host header, without port and brackets; None where it is no such header."""
    try:
        split = urlsplit(f"//{host}")
        _ = split.port  # raises where it is none
    except ValueError:
        return None
    return split.hostname if host and split.netloc == host and split.username is None else None


def _origin_host(origin: str) -> str | None:
    """Return host and port of an Origin header as a Host header has them; None for one that has none ("null")."""
    try:
        split = urlsplit(origin)
    except ValueError:
        return None
    return split.netloc.lower() if split.scheme in ("http", "https") else None
