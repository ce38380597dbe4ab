"""What all tests of live runs share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from vislam.live import run_live


@pytest.fixture(autouse=True, scope="module")
def patient_end() -> Iterator[None]:
    """Let a run write down what there is after a signal, on however slow a machine; tests that hurry say so."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_live, "_BRIEF_S", 60.0)
        yield
