"""The sketch as Arduino's own core and avr-gcc build it, run in simavr with chips by their data sheets on its bus.

Time is that of the simulated processor. Debian's arduino-core-avr, gcc-avr, avr-libc and libsimavr-dev are needed.
"""

import re
import shutil
import subprocess
from importlib.resources import files
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from needs import missing
from vislam.hw.bridge.protocol import Chips, Counts, FrameDecoder, Hello, RawSample, Spent, Status

SKETCH = Path(str(files("vislam.hw"))) / "firmware" / "vislam_bridge" / "vislam_bridge.ino"
HERE = Path(__file__).parent / "real_avr"
BOARDS = {
    "standard": ("atmega328p", 32_256, 2048),
    "leonardo": ("atmega32u4", 28_672, 2560),
    "mega": ("atmega2560", 253_952, 8192),
}
FAULT_MS, FAULT_US = 1000, 1_000_000
pytestmark = pytest.mark.slow


def build(folder: Path, variant: str, *told: str) -> tuple[Path, str]:
    if shutil.which("avr-g++") is None or not Path("/usr/share/arduino/hardware/arduino/avr").is_dir():
        missing("no avr-gcc or no arduino-core-avr for the sketch")
    command = ["sh", HERE / "build.sh", BOARDS[variant][0], variant, folder, SKETCH, *told]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "vislam_bridge" not in done.stderr, done.stderr  # no warnings
    return folder / "firmware.elf", done.stdout


class Board:
    """An Uno with a GY-85 that runs for a while, and what it sent."""

    def __init__(self, tools: tuple[Path, Path], seconds: float, *faults: str) -> None:
        simulator, firmware = tools
        command = [simulator, firmware, "atmega328p", str(seconds), *faults]
        done = subprocess.run(command, capture_output=True, check=True)
        decoder = FrameDecoder()
        self.messages = decoder.feed(done.stdout)
        assert decoder.bad == 0
        self.samples = [m for m in self.messages if isinstance(m, RawSample)]
        self.hellos = [m for m in self.messages if isinstance(m, Hello)]
        self.log = done.stderr.decode()

    def failed(self, error: Status) -> list[RawSample]:
        return [sample for sample in self.samples if error in sample.status]

    def times_us(self, what: str) -> np.ndarray:
        return np.array([float(t) for t in re.findall(rf"^{what} (\S+)$", self.log, re.MULTILINE)])


@pytest.fixture(scope="module")
def tools(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("avr")
    firmware, _ = build(folder, "standard")
    simulator = folder / "simulate"
    strict = ["-std=gnu11", "-O2", "-Wall", "-Wextra"]
    command = ["cc", *strict, HERE / "simulate.c", "-o", simulator, "-lsimavr", "-lelf", "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if "sim_avr.h" in done.stderr:
        missing("no libsimavr-dev for the sketch")
    assert done.returncode == 0, done.stderr
    return simulator, firmware


@pytest.fixture(scope="module")
def calm(tools: tuple[Path, Path]) -> Board:
    return Board(tools, 3.0)


@pytest.mark.parametrize("variant", BOARDS)
@pytest.mark.parametrize("told", [(), ("-DLEFT_A=2", "-DLEFT_B=4", "-DRIGHT_A=3", "-DRIGHT_B=5")])
def test_it_builds_without_a_warning_and_fits(tmp_path: Path, variant: str, told: tuple[str, ...]) -> None:
    _, flash, ram = BOARDS[variant]
    text, data, bss = map(int, build(tmp_path, variant, *told)[1].splitlines()[1].split()[:3])
    print(f"{variant}: {text + data} of {flash} bytes of flash, {data + bss} of {ram} of memory")
    assert text + data < 0.6 * flash
    assert data + bss < 0.6 * ram  # the rest is the stack's


def test_it_samples_400_times_a_second_what_the_chips_measure(calm: Board) -> None:
    assert len(calm.samples) == pytest.approx(2.88 * 400, abs=3)  # the chips take 0.12 s to start
    intervals = np.diff([sample.t_us for sample in calm.samples])
    assert abs(intervals.mean() - 2500.0) < 1.0
    assert intervals.min() > 2000 and intervals.max() < 3000
    hello = calm.hellos[-1]
    rates = np.array([sample.gyro for sample in calm.samples]) * hello.gyro_nrad_s * 1e-9
    forces = np.array([sample.accel for sample in calm.samples]) * hello.accel_nm_s2 * 1e-9
    assert np.rad2deg(rates.mean(axis=0)) == pytest.approx([0.0, 0.0, 20.0], abs=0.1)
    assert forces.mean(axis=0) == pytest.approx([0.0, 0.0, 9.807], abs=0.02)
    assert all(sample.status | Status.MAG_NEW == Status.MAG_NEW for sample in calm.samples)
    assert len(calm.failed(Status.MAG_NEW)) == pytest.approx(2.88 * 50, abs=4)


def test_the_time_of_a_sample_is_when_its_gyro_was_read_and_the_host_knows_what_it_took(calm: Board) -> None:
    latched = calm.times_us("gyro")[-len(calm.samples) - 1 :]
    stamps = np.array([sample.t_us for sample in calm.samples])
    begun = np.array(
        [t[0] for t in (latched[(latched > s - 200) & (latched < s + 1500)] for s in stamps + 20) if len(t)]
    )
    late = begun - stamps[: len(begun)]
    print(f"latched {late.min():.0f} to {late.max():.0f} us after the time that the sample has")
    assert np.abs(late - np.median(late)).max() < 100.0  # its clock begins a little after the processor
    first_bytes = calm.times_us("byte")
    took = np.array([first_bytes[first_bytes > t][0] - t for t in begun[-200:]])
    stated = [m.spent_us for m in calm.messages if isinstance(m, Spent)][-1]
    print(f"{took.min():.0f} us to the first byte at least, stated {stated}")
    assert abs(took.min() - stated) < 100.0


@pytest.mark.parametrize(("chip", "error"), [("53", Status.ACCEL_ERROR), ("68", Status.GYRO_ERROR)])
def test_one_transfer_without_an_answer_costs_one_sample(tools: tuple[Path, Path], chip: str, error: Status) -> None:
    board = Board(tools, 1.5, f"{FAULT_MS}:nack:{chip}")
    assert len(board.failed(error)) == 1
    assert len(board.failed(Status.ACCEL_ERROR | Status.GYRO_ERROR)) == 0
    sound = [sample.t_us for sample in board.samples if error not in sample.status]
    assert max(b - a for a, b in pairwise(sound)) < 8000


@pytest.mark.parametrize(
    ("chip", "error", "most_ms"),
    [("53", Status.ACCEL_ERROR, 20), ("68", Status.GYRO_ERROR, 20), ("1e", Status.MAG_ERROR, 250)],
)
def test_a_chip_that_lost_its_supply_is_named_and_set_up_again(
    tools: tuple[Path, Path], chip: str, error: Status, most_ms: int
) -> None:
    board = Board(tools, 2.0, f"{FAULT_MS}:power:{chip}")
    failed = [sample.t_us for sample in board.failed(error)]
    assert failed and failed[0] < FAULT_US + 30_000 and failed[-1] - failed[0] < most_ms * 1000
    assert board.samples[-1].gyro[2] == pytest.approx(287, abs=3)
    assert board.samples[-1].accel[2] == pytest.approx(256, abs=3)


@pytest.mark.parametrize("held_ms", [20, 300, 2000])
def test_a_stuck_bus_stops_nothing_and_is_freed(tools: tuple[Path, Path], held_ms: int) -> None:
    board = Board(tools, 2.0 + held_ms / 1000, f"{FAULT_MS}:hold", f"{FAULT_MS + held_ms}:free")
    within = [s.t_us for s in board.samples if FAULT_US < s.t_us < FAULT_US + 1000 * held_ms]
    assert len(within) > 0.5 * held_ms / 10, "it goes on and reports"
    bad = Status.ACCEL_ERROR | Status.GYRO_ERROR
    after = [s.t_us for s in board.samples if s.t_us > FAULT_US + 1000 * held_ms and not s.status & bad]
    assert after[0] - (FAULT_US + 1000 * held_ms) < 50_000
    assert all(not s.status & bad for s in board.samples[-100:])


@pytest.mark.parametrize(
    ("edges_s", "right_a", "is_fast", "is_exact"),
    [(10_000, 3, False, True), (14_000, 3, True, True), (20_000, 3, True, False),
     (18_000, 7, False, True), (32_000, 7, True, False)],
)  # fmt: skip
def test_no_edge_is_counted_wrong_without_being_stated(
    tmp_path: Path, tools: tuple[Path, Path], edges_s: int, right_a: int, is_fast: bool, is_exact: bool
) -> None:
    pins = ("-DLEFT_A=2", "-DLEFT_B=4", f"-DRIGHT_A={right_a}", "-DRIGHT_B=5")  # pin 7 stands still
    firmware, _ = build(tmp_path, "standard", *pins)
    board = Board((tools[0], firmware), 3.4, f"500:edges:{edges_s:x}", "1500:edges:0")
    made = [int(n) for n in re.findall(r"^edges (\d+) (\d+)$", board.log, re.MULTILINE)[0]]
    counts = [m for m in board.messages if isinstance(m, Counts)][-1]
    wrong = max(abs(counts.left - made[0]), abs(counts.right - made[1]) if right_a == 3 else 0)
    print(f"{edges_s} edges a second: {wrong} of {made[0]} wrong")
    assert (wrong <= 1) == is_exact
    assert any(Chips.FAST_EDGES in hello.chips for hello in board.hellos) == is_fast
    assert Chips.FAST_EDGES not in board.hellos[-1].chips, "it is over"


def test_a_reset_is_stated(tools: tuple[Path, Path]) -> None:
    board = Board(tools, 2.5, f"{FAULT_MS}:reset")
    assert [Chips.STARTED in hello.chips for hello in board.hellos].count(True) == 2
    assert board.samples[-1].gyro[2] == pytest.approx(287, abs=3)
