"""Where the web page of a live run listens: HOST:PORT, opened before anything else starts."""

import ipaddress
import re
import socket
from dataclasses import dataclass

from vislam.core.errors import UsageError

DEFAULT = "127.0.0.1:8765"
_BACKLOG = 16
_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?")


@dataclass(frozen=True, slots=True)
class WebAddress:
    """Host and port as they were asked for; port 0: any that is free."""

    host: str
    port: int

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach it."""
        return self.host == "localhost" or (is_address(self.host) and ipaddress.ip_address(self.host).is_loopback)


def is_address(host: str) -> bool:
    """Return whether a host is an IP address: a name that is none may be made to point anywhere."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def is_name(host: str) -> bool:
    """Return whether this may be the name of a host."""
    return _NAME.fullmatch(host) is not None


def parsed(text: str) -> WebAddress:
    """Return HOST:PORT, [IPv6]:PORT or :PORT (of the loopback) as an address; raises UsageError for what is none."""
    host, colon, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") or "127.0.0.1"
    is_port = port.isascii() and port.isdigit() and len(port) <= 5 and int(port) < 65536
    if not colon or not is_port or not (is_address(host) or is_name(host)):
        raise UsageError(f"'{text}' is no address to listen at; write --web HOST:PORT, such as --web {DEFAULT}")
    return WebAddress(host, int(port))


def listening(at: WebAddress) -> socket.socket:
    """Return a socket that listens there; raises UsageError where that cannot be."""
    try:
        family, _, _, _, where = socket.getaddrinfo(at.host, at.port, type=socket.SOCK_STREAM)[0]
        sock = socket.socket(family, socket.SOCK_STREAM)
    except OSError as error:
        raise UsageError(f"--web {at.host}:{at.port}: no such host here ({error}); give an address") from error
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(where)
        sock.listen(_BACKLOG)
    except OSError as error:
        sock.close()
        raise UsageError(
            f"the web page cannot listen at {at.host}:{at.port}: {error}; give another address with --web HOST:PORT"
        ) from error
    return sock
