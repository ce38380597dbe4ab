"""The sketch for the microcontroller, compiled for this machine on a small imitation of Arduino's core."""

import os
import shutil
import subprocess
from dataclasses import replace
from importlib.resources import files
from itertools import pairwise
from pathlib import Path

import pytest

from needs import missing
from vislam.hw.bridge.protocol import (
    MOST_PASSED,
    SAMPLE_WIRE_BYTES,
    Ages,
    Chips,
    Counts,
    FrameDecoder,
    Hello,
    Passed,
    RawSample,
    Spent,
    Status,
    encode,
)
from vislam.hw.emulator.bridge import bridged

SKETCH = Path(str(files("vislam.hw"))) / "firmware" / "vislam_bridge"
FAKE = Path(__file__).parent / "fake_arduino"
NOBODY = ("0", "0", "0")
GYRO, MAG = str(0x68), str(0x1E)


PINS = ("-DLEFT_A=2", "-DLEFT_B=3", "-DRIGHT_A=4", "-DRIGHT_B=5", "-DGNSS_PORT=Serial1")
SENTENCE = "$GNGGA,120000.00,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"


@pytest.fixture(scope="module")
def bridge(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(tmp_path_factory.mktemp("sketch"))


@pytest.fixture(scope="module")
def full_bridge(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sketch that was told of encoders and of a receiver."""
    return compiled(tmp_path_factory.mktemp("full_sketch"), *PINS)


def compiled(folder: Path, *told: str) -> Path:
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        missing("no C++ compiler for the sketch")
    program = folder / "bridge"
    sources = ["-I", FAKE, "-I", SKETCH, FAKE / "main.cpp", "-o", program]
    core = [] if "-DESP32" in told else ["-DARDUINO_ARCH_AVR"]
    strict = [*core, "-std=c++11", "-Wall", "-Wextra", "-Wconversion", "-Wno-psabi", "-Werror=return-type", "-O1"]
    result = subprocess.run([compiler, *strict, *told, *sources], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "vislam_bridge.ino" not in result.stderr, result.stderr  # no warnings
    return program


def run(
    bridge: Path,
    seconds: float,
    begin_us: int = 0,
    silent: tuple = NOBODY,
    blocked: tuple = ("0", "0"),
    forgets_at: int = -1,
    further: tuple = (),
    mpu: str = "",
) -> tuple[list, bytes, str]:
    """Return messages, the bytes they came in, and the registers that the sketch set."""
    command = [str(bridge), str(seconds), str(begin_us), *silent, *blocked, str(forgets_at), *further]
    surroundings = {**os.environ, "MPU": mpu} if mpu else None
    done = subprocess.run(command, capture_output=True, check=True, timeout=60, env=surroundings)
    decoder = FrameDecoder()
    messages = decoder.feed(done.stdout)
    assert decoder.bad == 0
    return messages, done.stdout, done.stderr.decode()


def parts(messages: list) -> tuple[list[RawSample], list[Hello]]:
    return [m for m in messages if isinstance(m, RawSample)], [m for m in messages if isinstance(m, Hello)]


def test_its_frames_are_ours_byte_for_byte(bridge: Path) -> None:
    messages, wire, registers = run(bridge, 3.0)
    assert b"".join(encode(message) for message in messages) == wire
    spent = [m for m in messages if isinstance(m, Spent)]
    assert [m.sequence for m in spent] == [0, 1, 2]
    samples, hellos = parts(messages)
    assert len(samples) == pytest.approx(2.88 * 400, abs=3)  # the chips take 0.12 s to start
    assert registers == "0b 1a 20"  # full resolution and 16 g; 2000 deg/s and 98 Hz; 1.3 gauss
    assert [m.sequence for m in messages if m not in spent] == list(range(len(messages) - len(spent)))
    for n, sample in enumerate(samples):
        assert sample.accel == (n % 500, -(n % 500), 256)
        assert sample.gyro == (-(n % 700), 0, n % 700)
        assert sample.temperature == -13200
        reading = n // 8  # the magnetometer is read in every eighth
        assert sample.mag == (200 + reading % 9, reading % 9, -400)  # x, y, z from the chip's x, z, y
        new = n % 8 == 0 and reading >= 2
        assert sample.status == (Status.MAG_NEW if new else 0)
    intervals = [b.t_us - a.t_us for a, b in pairwise(samples)]
    assert min(intervals) > 2400
    assert max(intervals) < 2600
    assert [h.chips for h in hellos] == [Chips(0x87), Chips(7), Chips(7)]
    hello = hellos[0]
    assert (hello.accel_id, hello.gyro_id, hello.mag_id, hello.rate_hz) == (0xE5, 0x69, b"H43", 400)


def test_the_scales_are_those_of_the_data_sheets(bridge: Path) -> None:
    hello = parts(run(bridge, 0.3)[0])[1][0]
    assert hello.accel_nm_s2 * 1e-9 * 256 == pytest.approx(9.80665, rel=1e-7)
    assert hello.gyro_nrad_s * 1e-9 * 14.375 == pytest.approx(0.017453293, rel=1e-6)
    assert hello.mag_pt * 1e-6 * 1090 == pytest.approx(100.0, rel=1e-5)
    assert hello.temperature_mc * 1e-3 - 13200 * hello.temperature_nk * 1e-9 == pytest.approx(35.0, abs=1e-3)


def test_its_clock_wraps_without_a_hole(bridge: Path) -> None:
    samples, _ = parts(run(bridge, 2.0, begin_us=2**32 - 1_000_000)[0])
    assert samples[0].t_us > samples[-1].t_us
    assert all(2400 < (b.t_us - a.t_us) % 2**32 < 2600 for a, b in pairwise(samples))


@pytest.mark.parametrize(
    "usb", [(), ("-DARDUINO_USB_CDC_ON_BOOT=1",), ("-DARDUINO_USB_CDC_ON_BOOT=1", "-DARDUINO_USB_MODE=1")]
)
def test_it_compiles_for_an_esp32_with_any_of_its_ports(tmp_path: Path, usb: tuple[str, ...]) -> None:
    samples, _ = parts(run(compiled(tmp_path, "-DESP32", *usb), 0.5)[0])
    assert len(samples) > 100


def test_one_transfer_without_an_answer_costs_an_mpu_8_ms(bridge: Path) -> None:
    samples, _ = parts(run(bridge, 2.0, silent=(GYRO, "1000", "1001"), mpu="104 104 none 0")[0])
    failed = [n for n, sample in enumerate(samples) if Status.GYRO_ERROR in sample.status]
    assert len(failed) == 1
    assert samples[failed[0] + 1].t_us - samples[failed[0] - 1].t_us <= 8000


def test_a_chip_that_goes_away_is_told_and_set_up_again(bridge: Path) -> None:
    messages = run(bridge, 3.0, silent=(GYRO, "100", "120"))[0]
    samples, _ = parts(messages)
    failed = [i for i, s in enumerate(samples) if Status.GYRO_ERROR in s.status]
    assert failed[-1] - failed[0] + 1 == len(failed)
    assert 40 < len(failed) < 1200
    assert all(Status.ACCEL_ERROR not in s.status for s in samples)
    assert samples[-1].gyro != samples[failed[0]].gyro
    assert max((b.t_us - a.t_us) for a, b in pairwise(samples)) < 10_000  # the others are read on time


def test_without_a_magnetometer_the_rest_goes_on(bridge: Path) -> None:
    samples, hellos = parts(run(bridge, 2.0, silent=(MAG, "0", "1000000"))[0])
    assert hellos[0].chips == Chips.ACCEL | Chips.GYRO | Chips.STARTED
    assert all(sample.status in (Status.MAG_ERROR, Status.MAG_ERROR | Status.MISSED) for sample in samples)
    assert samples[-1].gyro[2] == (len(samples) - 1) % 700


def test_a_line_that_takes_nothing_leaves_holes_and_stops_nothing(bridge: Path) -> None:
    messages = run(bridge, 2.0, blocked=("1000", "1100"))[0]
    gaps = [(b.sequence - a.sequence) % 2**16 for a, b in pairwise(m for m in messages if not isinstance(m, Spent))]
    assert max(gaps) == pytest.approx(41, abs=2)
    assert sorted(gaps)[-2] == 1
    samples, _ = parts(messages)
    assert samples[-1].t_us - samples[-2].t_us < 2600


@pytest.mark.parametrize("begin_us", [0, 2**32 - 1_500_000])
def test_encoders_and_a_receiver_travel_beside_the_samples(full_bridge: Path, begin_us: int) -> None:
    messages, wire, told = run(full_bridge, 4.0, begin_us, further=("4800", "-1200", SENTENCE))
    assert b"".join(encode(message) for message in messages) == wire
    samples, hellos = parts(messages)
    assert all(Chips.ENCODERS | Chips.GNSS in hello.chips for hello in hellos)
    counts = [m for m in messages if isinstance(m, Counts)]
    passed = [m for m in messages if isinstance(m, Passed)]
    *_, left_quarters, right_quarters, lost = told.split()
    for wheel, quarters in (("left", left_quarters), ("right", right_quarters)):  # both edges of A: a half of them
        assert getattr(counts[-1], wheel) == pytest.approx(int(quarters) / 2, abs=0.02 * abs(int(quarters) / 8) + 2)
    for before, after in pairwise(counts):
        since_s = (after.t_us - before.t_us) % 2**32 * 1e-6
        assert 0.019 < since_s < 0.025
        assert after.left - before.left == pytest.approx(2400 * since_s, abs=2)
        assert after.right - before.right == pytest.approx(-600 * since_s, abs=2)
    said = b"".join(message.data for message in passed).decode()
    assert len(said) > 3500
    begun = int(lost)  # while the chips started; nothing later
    assert begun < 100
    assert said == (SENTENCE * 60)[begun : begun + len(said)]
    assert max(len(message.data) for message in passed) == MOST_PASSED
    for kind in (counts, passed):
        assert [message.sequence for message in kind] == list(range(len(kind)))
    shared = [m.sequence for m in messages if isinstance(m, RawSample | Hello)]
    assert shared == list(range(len(shared)))  # no sample was lost for their sake, to an old host neither
    assert all(Status.MISSED not in sample.status for sample in samples)


@pytest.mark.parametrize(("edges_s", "is_fast"), [(9_000, False), (11_000, True)])
def test_edges_too_fast_to_be_counted_for_sure_are_stated(full_bridge: Path, edges_s: int, is_fast: bool) -> None:
    quarters_s = str(2 * edges_s)  # of each wheel, one of which goes back; the limit is 20 000 edges of both
    hellos = parts(run(full_bridge, 3.0, further=(quarters_s, f"-{quarters_s}", SENTENCE))[0])[1]
    assert [Chips.FAST_EDGES in hello.chips for hello in hellos[1:]] == [is_fast] * 2


def test_a_line_that_takes_nothing_costs_no_count(full_bridge: Path) -> None:
    messages = run(full_bridge, 2.0, blocked=("1000", "1100"), further=("4800", "4800", SENTENCE))[0]
    counts = [m for m in messages if isinstance(m, Counts)]
    gaps_s = [(b.t_us - a.t_us) * 1e-6 for a, b in pairwise(counts)]
    assert max(gaps_s) > 0.09
    assert counts[-1].left == pytest.approx(2400 * counts[-1].t_us * 1e-6, abs=5)


MPU = "104 104 none 0"  # id, address, magnetometer, when it begins to answer


@pytest.mark.parametrize(
    ("who", "name", "magnetometer"),
    [
        (0x68, "MPU-6050", "none"), (0x68, "MPU-6050", "hmc"), (0x70, "MPU-6500", "none"), (0x71, "MPU-9250", "ak"),
        (0x73, "MPU-9255", "ak"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("address", [0x68, 0x69])
def test_an_mpu_is_found_and_its_frames_are_ours_byte_for_byte(
    bridge: Path, who: int, name: str, magnetometer: str, address: int
) -> None:
    messages, wire, _ = run(bridge, 3.0, mpu=f"{who} {address} {magnetometer} 0")
    assert b"".join(encode(message) for message in messages) == wire
    # who it is stands twice before the first sample, and each time how old its values are
    assert [type(m) for m in messages[:5]] == [Ages, Hello, Ages, Hello, RawSample]
    samples, hellos = parts(messages)
    shared = [m.sequence for m in messages if isinstance(m, RawSample | Hello)]
    assert shared == list(range(len(shared)))
    assert Chips.STARTED in hellos[0].chips
    assert not any(Chips.STARTED in hello.chips for hello in hellos[1:])
    expected = Chips.ACCEL | Chips.GYRO | (Chips.MAG if magnetometer != "none" else 0)
    for hello in hellos:
        assert hello.chips & ~Chips.STARTED == expected
        assert (hello.accel_id, hello.gyro_id) == (who, who)
        assert hello.accel_nm_s2 * 1e-9 * 4096 == pytest.approx(9.80665, rel=1e-6)
        assert hello.gyro_nrad_s * 1e-9 * 65.5 == pytest.approx(0.017453293, rel=4e-6)
    data_sheet_c = -1234 / 340 + 36.53 if who == 0x68 else -1234 / 333.87 + 21.0
    assert -1234e-9 * hellos[0].temperature_nk + 1e-3 * hellos[0].temperature_mc == pytest.approx(
        data_sheet_c, abs=1e-3
    )
    ages = [m for m in messages if isinstance(m, Ages)]
    assert [a.sequence for a in ages] == list(range(len(hellos)))
    if magnetometer != "hmc":  # the emulator has what the sketch says
        emulated = bridged(name)
        assert replace(hellos[1], sequence=0, t_us=0) == emulated.hello
        assert {replace(a, sequence=0, t_us=0) for a in ages} == {emulated.ages}
    for n, sample in enumerate(samples):
        assert sample.accel == (n % 500, -(n % 500), 4096)
        assert sample.gyro == (-(n % 700), 0, n % 700)
        assert sample.temperature == -1234
        assert sample.status & ~Status.MAG_NEW == 0
    steps_us = [b.t_us - a.t_us for a, b in pairwise(samples)]
    assert 2400 < min(steps_us) < max(steps_us) < 2600
    fields = [(n // 8, sample.mag) for n, sample in enumerate(samples) if Status.MAG_NEW in sample.status]
    if magnetometer == "none":
        assert not fields
    elif magnetometer == "hmc":
        assert all(mag == (200 + n % 9, n % 9, -400) for n, mag in fields)
    else:
        # x and y change places and z is turned over; fuses 176, 128, 80: 1.1875, 1 and 0.8125 times what is read
        assert all(mag == (-100, (19 * (160 + n % 9) + 8) // 16, -208) for n, mag in fields if n != 20)
        assert all(n % 5 != 4 for n, _ in fields)
        assert [mag[2] for n, mag in fields if n == 20] == [-32767]  # an overflow
        assert hellos[0].mag_limit == 32760
    if magnetometer != "none":
        assert 40 < len(fields) < 50 * 3


def test_ranges_of_an_mpu_are_told_to_the_host(tmp_path: Path) -> None:
    wide = compiled(tmp_path, "-DMPU_GYRO_RANGE=3", "-DMPU_ACCEL_RANGE=3")
    hello = parts(run(wide, 0.5, mpu=MPU)[0])[1][0]
    assert hello.accel_nm_s2 * 1e-9 * 32768 == pytest.approx(16 * 9.80665, rel=1e-6)
    assert hello.gyro_nrad_s * 1e-9 * 16.4 == pytest.approx(0.017453293, rel=1e-6)


def test_an_mpu_that_comes_late_is_told_before_its_first_sample(bridge: Path) -> None:
    messages, _, _ = run(bridge, 3.0, mpu="104 104 none 1500000")
    first = next(i for i, m in enumerate(messages) if isinstance(m, RawSample) and not m.status & Status.GYRO_ERROR)
    told = [m for m in messages[:first] if isinstance(m, Hello) and m.accel_id == 0x68]
    assert len(told) >= 2
    assert all(m.accel_id == 0 for m in messages[:first] if isinstance(m, Hello) and m not in told)
    samples, _ = parts(messages[first:])
    assert samples[0].t_us > 1_500_000 + 90_000  # its gyro has to start
    assert all(sample.status == 0 for sample in samples)


@pytest.mark.parametrize("who", [0x68, 0x71])
def test_an_mpu_that_lost_its_settings_is_not_believed(bridge: Path, who: int) -> None:
    messages = run(bridge, 2.0, silent=(GYRO, "0", "0"), forgets_at=1000, mpu=f"{who} 104 none 0")[0]
    samples, _ = parts(messages)
    failed = [i for i, s in enumerate(samples) if Status.GYRO_ERROR | Status.ACCEL_ERROR in s.status]
    assert 40 <= len(failed) <= 100  # tried again after a tenth of a second, and a tenth until it has started
    assert failed[-1] - failed[0] + 1 == len(failed)
    assert samples[-1].accel[2] == 4096


def test_a_chip_that_the_sketch_does_not_know_is_told(bridge: Path) -> None:
    samples, hellos = parts(run(bridge, 2.0, mpu=f"{0x98} 104 none 0")[0])
    assert {hello.accel_id for hello in hellos} == {0x98}
    assert not any(hello.chips & (Chips.ACCEL | Chips.GYRO) for hello in hellos)
    assert all(Status.GYRO_ERROR | Status.ACCEL_ERROR in sample.status for sample in samples)


def test_an_mpu_carries_encoders_and_a_receiver_as_well(full_bridge: Path) -> None:
    messages = run(full_bridge, 4.0, further=("4800", "-1200", SENTENCE), mpu="113 104 ak 0")[0]
    shared = [m.sequence for m in messages if isinstance(m, RawSample | Hello)]
    assert shared == list(range(len(shared)))
    assert all(Status.MISSED not in m.status for m in messages if isinstance(m, RawSample))
    for kind in (Counts, Passed, Ages):
        numbers = [m.sequence for m in messages if isinstance(m, kind)]
        assert numbers == list(range(len(numbers)))
        assert numbers


def test_a_sample_fits_the_smallest_buffer() -> None:
    assert SAMPLE_WIRE_BYTES < 64  # SERIAL_TX_BUFFER_SIZE of an AVR
