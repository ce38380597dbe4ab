"""Nothing compiles in front of a user without saying so, and what is compiled already is not talked about."""

from dataclasses import dataclass

import numba
import pytest

from vislam.cli.verbs import VERBS
from vislam.cli.verbs.arguments import parse
from vislam.core.compiling import _Listener


class Event:
    def __init__(self, is_start: bool) -> None:
        self.is_start, self.is_end = is_start, not is_start


START, END = Event(True), Event(False)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch):
    """Return what notifies a listener at times in s, and what it said."""
    said: list[float] = []
    now = [0.0]
    monkeypatch.setattr("vislam.core.compiling.time.process_time", lambda: now[0])
    listener = _Listener(lambda: said.append(now[0]))

    def tell(*events: tuple[float, Event]) -> list[float]:
        for at_s, event in events:
            now[0] = at_s
            listener.notify(event)
        return said

    return tell


def test_it_is_said_once_after_a_second_of_compilation(told) -> None:
    assert told((10.0, START), (10.1, START), (10.9, END)) == []
    assert told((11.2, START)) == [11.2]  # not only when the outermost ends
    assert told((15.0, END), (16.0, END), (20.0, START), (30.0, END)) == [11.2]


def test_time_between_compilations_does_not_count(told) -> None:
    assert told((0.0, START), (0.6, END), (100.0, START), (100.3, END)) == []
    assert told((200.0, START), (200.2, END)) == [200.2]


@dataclass
class NoOptions:
    """Options of a verb that has none."""


def test_a_verb_says_that_it_compiles_and_has_its_jobs_done_first(capsys, monkeypatch) -> None:
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr("vislam.core.compiling._WORTH_SAYING_S", 0.0)
    monkeypatch.setattr("vislam.cli.verbs.arguments.compile_ahead", lambda jobs, shown: asked.append(jobs))
    parse(NoOptions, [], "run alone", summary="once in this process")
    numba.njit(lambda x: x + 1)(1)
    assert VERBS["run"].compiles in asked  # verbs that other tests parsed ask, too
    assert "compiling for this processor" in capsys.readouterr().err
    numba.njit(lambda x: x + 2)(1)
    assert capsys.readouterr().err == ""
