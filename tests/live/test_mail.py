"""Queues between processes end on both sides, whoever goes first."""

import threading
from multiprocessing import Pipe

from vislam.live.wire.mail import Inbox, Outbox
from waiting import HUNG_S, wait_for


def closed(box: Outbox) -> bool:
    """Return whether closing it comes to an end."""
    thread = threading.Thread(target=box.close, daemon=True)
    thread.start()
    return bool(wait_for(lambda: not thread.is_alive()))


def test_what_waits_is_sent_before_the_end() -> None:
    takes, sends = Pipe(duplex=False)
    outbox, inbox = Outbox(sends, 8), Inbox(takes)
    assert all(outbox.put(k) for k in range(3))
    assert closed(outbox)
    assert [inbox.get(HUNG_S) for _ in range(3)] == [0, 1, 2]
    wait_for(lambda: inbox.get() is None and inbox.is_over)


def test_where_the_other_side_is_gone_closing_ends() -> None:
    """The other process was killed: what is put in is lost, and the stream ends though nobody takes its end."""
    takes, sends = Pipe(duplex=False)
    outbox = Outbox(sends, 2)
    takes.close()
    wait_for(lambda: outbox.put(b"lost") and outbox.is_broken)
    assert outbox.put(b"lost, too")
    assert closed(outbox)
