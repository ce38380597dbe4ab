"""What all tests of live runs share."""

import json
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path

import pytest
from live_runs import PATIENCE_S, begin, has_map, interrupt, left_behind, until

from vislam.core import Recording
from vislam.live import replay, run_live
from vislam.live.processes import child
from vislam.live.replayed_imu import InertialTable
from waiting import HUNG_S
from worlds.shared import shared


@pytest.fixture(autouse=True, scope="session")
def patient_end() -> Iterator[None]:
    """Let a run write down what there is after a signal or failure, on however slow a machine; who hurries says so."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_live, "_BRIEF_S", HUNG_S)
        patch.setattr(run_live, "_AFTER_FAILURE_S", HUNG_S)
        yield


@pytest.fixture(autouse=True, scope="session")
def imported_once() -> Iterator[None]:
    """Fork the processes of a run from one that has imported what they do: 4 s of CPU a run. Who spawns says so."""
    context = get_context("forkserver")
    context.set_forkserver_preload([f"vislam.live.processes.{role}" for role in ("fast", "front", "back", "map")])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(child, "get_context", lambda _: context)
        yield


@pytest.fixture(autouse=True, scope="session")
def read_once() -> Iterator[None]:
    """Read the samples of a recording once: ten minutes of them are half a second of CPU, and each run needs them."""
    tables, read = {}, vars(replay)["_inertial_table"]

    def kept(recording: Recording, uri: str, rate_hz: float) -> InertialTable:
        if (uri, rate_hz) not in tables:
            tables[uri, rate_hz] = read(recording, uri, rate_hz)
        return tables[uri, rate_hz]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay, "_inertial_table", kept)
        yield


@pytest.fixture(scope="session")
def interrupted(patient_end: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """A run that was ended by Ctrl-C when it had a map, and its metrics; of all workers: who resumes it copies it."""

    def make(folder: Path) -> None:
        live = begin(folder / "run", name="shared")
        live.execute(until(has_map, interrupt), PATIENCE_S)
        assert live.is_brief
        assert left_behind("shared") == []

    out = shared(tmp_path_factory, "interrupted-live", make) / "run"
    return out, json.loads((out / "metrics.json").read_text())
