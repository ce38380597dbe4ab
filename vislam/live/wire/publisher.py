"""Hands poses out: the newest in shared memory, each as a datagram. And the reader of both."""

import os
import socket
from contextlib import suppress
from pathlib import Path

from vislam.core.errors import DataError, UsageError
from vislam.live.wire.published_pose import SIZE, PublishedPose, pack, unpack
from vislam.live.wire.slot import SlotReader, SlotWriter, give_to_group

_LOOPBACK = ("127.0.0.1", "::1", "localhost")


def socket_path(name: str) -> Path:
    """Return the default destination of datagrams: in the user's runtime folder, else in /tmp."""
    return Path(os.environ.get("XDG_RUNTIME_DIR", "/tmp")) / f"{name}.sock"


def send_address(to: str, name: str, allow_remote: bool) -> tuple[socket.AddressFamily, str | tuple[str, int]]:
    """Return family and address of "unix", "unix:PATH" or "udp:HOST:PORT".

    Raises UsageError for what is none of these, or beyond this machine without `allow_remote`.
    """
    kind, _, rest = to.partition(":")
    if kind == "unix":
        return socket.AF_UNIX, rest or str(socket_path(name))
    host, _, port = rest.rpartition(":")
    if kind != "udp" or not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise UsageError(f"'{to}' is no place to send poses to; write unix, unix:PATH or udp:HOST:PORT")
    if host not in _LOOPBACK and not allow_remote:
        raise UsageError(
            f"'{to}' is beyond this machine, where anybody may listen; --live.allow-remote sends all the same"
        )
    try:
        found = socket.getaddrinfo(host, int(port), type=socket.SOCK_DGRAM)[0]
    except OSError as error:
        raise UsageError(f"'{to}': no such host ({error}); give its address") from error
    return found[0], (host, int(port))


class PosePublisher:
    """Owns the shared memory and the sockets; never waits for a reader.

    Attributes:
        counters: poses published, datagrams that a slow reader's full buffer refused.
    """

    def __init__(
        self, name: str, send_to: tuple[str, ...] = ("unix",), allow_remote: bool = False, group: str | None = None
    ) -> None:
        """Open everything.

        Args:
            name: of the shared memory, /dev/shm/NAME, and of the default socket.
            send_to: where each pose goes as a datagram: "unix" (NAME.sock in the runtime folder), "unix:PATH",
                "udp:HOST:PORT".
            allow_remote: whether hosts beyond this machine are meant.
            group: whose members may read the shared memory, too.

        Raises:
            UsageError: an address that is none, or beyond this machine without `allow_remote`; a group that is none.
            StorageError: the shared memory cannot be made.
        """
        self.counters = {"published": 0, "datagrams_refused": 0}
        addresses = [send_address(to, name, allow_remote) for to in send_to]
        self._targets = [(socket.socket(family, socket.SOCK_DGRAM), address) for family, address in addresses]
        for target, _ in self._targets:
            target.setblocking(False)
        self._usual, self._is_shared = str(socket_path(name)), "XDG_RUNTIME_DIR" not in os.environ
        self._slot = SlotWriter(name, SIZE, group)

    def publish(self, pose: PublishedPose) -> None:
        """Hand a pose out; without a listener, nothing happens."""
        data = pack(pose)
        self._slot.write(data)
        self.counters["published"] += 1
        for target, address in self._targets:
            try:
                if self._is_shared and address == self._usual and os.stat(address).st_uid not in (os.geteuid(), 0):
                    continue  # another was first at this name in /tmp
                target.sendto(data, address)
            except BlockingIOError:
                self.counters["datagrams_refused"] += 1
            except OSError:  # no listener there (yet), or one that is not to hear it
                continue

    def close(self) -> None:
        """Remove the shared memory and close the sockets; may be called twice."""
        self._slot.close()
        for target, _ in self._targets:
            target.close()


class PoseReader:
    """Reads the newest pose from shared memory: for a controller that asks when it wants to know."""

    def __init__(self, name: str, owner: str | None = None) -> None:
        """Open what `vislam live --live.name NAME` publishes; another user's `--live.group` wants its `owner` named.

        Raises DataError when it does not run.
        """
        self._name, self._owner, self._slot = name, owner, SlotReader(name, owner)

    def latest(self) -> PublishedPose | None:
        """Return the newest pose, None before the first.

        A restarted `vislam live` is followed. After one that has gone its last pose comes again: look at `age_s`.
        """
        if self._slot.is_replaced:
            with suppress(DataError):  # it has gone again, or is not ours
                follower = SlotReader(self._name, self._owner)
                self._slot.close()
                self._slot = follower
        read = self._slot.read()
        return None if read is None else unpack(read[1])

    def close(self) -> None:
        """Let go of the memory; may be called twice."""
        self._slot.close()


class PoseListener:
    """Receives every pose as a datagram: for a controller that is to run when a pose comes."""

    def __init__(self, at: str, group: str | None = None) -> None:
        """Bind to "unix:PATH" or "udp:HOST:PORT", one of the addresses that `vislam live` sends to.

        Members of `group` may send there, too. Raises UsageError when it cannot be bound or there is no such group.
        """
        family, address = send_address(at, "vislam", allow_remote=True)
        self._path = Path(address) if isinstance(address, str) else None
        if self._path is not None:
            with suppress(OSError):  # left by a listener that was killed
                if self._path.is_socket():
                    self._path.unlink()
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            if self._path is not None:  # before it has a name: no other user may send poses to it
                os.fchmod(self._socket.fileno(), 0o600)
            self._socket.bind(address)
            if self._path is not None:
                give_to_group(self._path, group, 0o660)
        except UsageError:
            self.close()
            raise
        except OSError as error:
            self._socket.close()
            raise UsageError(f"cannot listen at {at}: {error}; choose another address") from error
        self.refused = 0  # datagrams that were no sound pose

    def next(self, timeout_s: float) -> PublishedPose | None:
        """Return the next pose, waiting at most so long; None if none came. What is no pose is counted and skipped."""
        self._socket.settimeout(timeout_s)
        while True:
            try:
                return unpack(self._socket.recv(SIZE + 1))
            except (TimeoutError, BlockingIOError):
                return None
            except DataError:
                self.refused += 1

    def close(self) -> None:
        """Give the address back; may be called twice."""
        self._socket.close()
        if self._path is not None:
            with suppress(FileNotFoundError):
                self._path.unlink()
