"""The bridge's frames: what was sent comes back, and damage never becomes a sample."""

import pickle
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.hw.bridge import protocol
from vislam.hw.bridge.protocol import (
    Ages,
    Chips,
    Counts,
    FrameDecoder,
    Hello,
    OtherVersion,
    Passed,
    RawSample,
    Status,
    encode,
)

int16 = st.integers(-(2**15), 2**15 - 1)
triples = st.tuples(int16, int16, int16)
samples = st.builds(
    RawSample,
    sequence=st.integers(0, 2**16 - 1),
    t_us=st.integers(0, 2**32 - 1),
    status=st.integers(0, 31).map(Status),
    accel=triples,
    gyro=triples,
    mag=triples,
    temperature=int16,
)
counts16, counts32 = st.integers(1, 2**16 - 1), st.integers(1, 2**32 - 1)
hellos = st.builds(
    Hello,
    sequence=st.integers(0, 2**16 - 1),
    t_us=st.integers(0, 2**32 - 1),
    chips=st.sampled_from([Chips(0), Chips.ACCEL, Chips(7), Chips(0x87)]),
    accel_id=st.integers(0, 255),
    gyro_id=st.integers(0, 255),
    mag_id=st.binary(min_size=3, max_size=3),
    rate_hz=counts16,
    accel_nm_s2=counts32,
    gyro_nrad_s=counts32,
    mag_pt=counts32,
    temperature_nk=counts32,
    temperature_mc=st.integers(-(2**31), 2**31 - 1),
    accel_limit=counts16,
    gyro_limit=counts16,
    mag_limit=counts16,
)
int32, sequences, times = st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**16 - 1), st.integers(0, 2**32 - 1)
counts = st.builds(Counts, sequence=sequences, t_us=times, left=int32, right=int32)
passed = st.builds(Passed, sequence=sequences, t_us=times, data=st.binary(min_size=1, max_size=protocol.MOST_PASSED))

counts_us = st.integers(0, 2**16 - 1)
ages = st.builds(
    Ages, sequence=sequences, t_us=times, accel_id=st.integers(0, 255), gyro_us=counts_us, accel_us=counts_us,
    mag_us=counts_us,
)  # fmt: skip


@given(st.binary(max_size=1000))
def test_stuffing_comes_back_without_zeros(data: bytes) -> None:
    stuffed = protocol.stuff(data)
    assert 0 not in stuffed
    assert protocol.unstuff(stuffed) == data
    assert len(data) < len(stuffed) <= len(data) + 1 + len(data) // 254


@pytest.mark.parametrize(
    ("data", "stuffed"),
    [  # the examples of COBS' description
        ("00", "0101"),
        ("0000", "010101"),
        ("00110022", "0102110222"[:10]),
        ("11223300 44", "0411223302 44"),
        ("11000000", "0211010101"),
    ],
)
def test_stuffing_is_that_of_cobs(data: str, stuffed: str) -> None:
    assert protocol.stuff(bytes.fromhex(data)) == bytes.fromhex(stuffed)


@given(st.lists(st.one_of(samples, hellos, counts, passed, ages), max_size=20), st.randoms(use_true_random=False))
def test_messages_come_back_however_they_are_cut(sent: list, rng: random.Random) -> None:
    stream = b"".join(encode(message) for message in sent)
    decoder, got, at = FrameDecoder(), [], 0
    while at < len(stream):
        length = rng.randint(1, 100)
        got += decoder.feed(stream[at : at + length])
        at += length
    assert got == sent
    assert decoder.bad == 0


def spoil(stream: bytes, rng: random.Random, rate: float) -> bytes:
    """Drop, flip, double and insert bytes, each at `rate`."""
    spoiled = bytearray()
    for byte in stream:
        fate = rng.random()
        if fate < rate:
            continue
        spoiled.append(byte ^ 1 << rng.randrange(8) if fate < 2 * rate else byte)
        if fate > 1 - rate:
            spoiled.append(rng.randrange(256))
        elif fate > 1 - 2 * rate:
            spoiled.append(byte)
    return bytes(spoiled)


@settings(max_examples=60)
@given(
    st.lists(st.one_of(samples, counts, passed), min_size=1, max_size=8), st.integers(0, 2**32), st.floats(0.0001, 0.02)
)
def test_no_wrong_frame_passes(few: list, seed: int, rate: float) -> None:
    decoder, rng = FrameDecoder(), random.Random(seed)
    sent = few * 50
    got = decoder.feed(spoil(b"".join(encode(message) for message in sent), rng, rate))
    places = iter(sent)
    assert all(any(message == original for original in places) for message in got)  # right ones, in their order
    assert decoder.feed(b"\0" + encode(sent[0])) == [sent[0]]  # and what follows is read again


@given(st.binary(max_size=3000))
def test_noise_is_no_frame_and_is_not_kept(noise: bytes) -> None:
    decoder = FrameDecoder()
    assert decoder.feed(noise) == []
    assert len(pickle.dumps(decoder)) <= protocol.MAX_STUFFED_BYTES + len(pickle.dumps(FrameDecoder())) + 16


@given(samples, st.integers(0, 8 * protocol.SAMPLE_WIRE_BYTES - 9))
def test_every_single_flip_is_found(sample: RawSample, bit: int) -> None:
    frame = bytearray(encode(sample))
    frame[bit // 8] ^= 1 << bit % 8
    assert sample not in (got := FrameDecoder().feed(bytes(frame)))
    assert got == []


def test_endless_noise_without_a_zero_takes_no_memory() -> None:
    decoder = FrameDecoder()
    for _ in range(1000):
        assert decoder.feed(b"\xaa" * 4096) == []
    assert len(pickle.dumps(decoder)) <= protocol.MAX_STUFFED_BYTES + len(pickle.dumps(FrameDecoder())) + 16
    assert decoder.bytes_since_good == 1000 * 4096
    sample = RawSample(1, 2, Status(0), (0, 0, 0), (0, 0, 0), (0, 0, 0), 0)
    assert decoder.feed(b"\0" + encode(sample)) == [sample]
    assert decoder.bytes_since_good == 0


def test_another_version_is_told_and_never_interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    hello = Hello(0, 0, Chips(7), 0xE5, 0x68, b"H43", 400, 1, 1, 1, 1, 0, 1, 1, 1)
    with monkeypatch.context() as patch:
        patch.setattr(protocol, "PROTOCOL_VERSION", 2)
        frame = encode(hello)
    assert FrameDecoder().feed(frame) == [OtherVersion(2)]


def test_a_hello_without_scales_is_none() -> None:
    assert FrameDecoder().feed(encode(Hello(0, 0, Chips(7), 0xE5, 0x68, b"H43", 400, 0, 1, 1, 1, 0, 1, 1, 1))) == []


def test_a_sample_takes_the_stated_bytes_on_the_wire() -> None:
    sample = RawSample(0, 0, Status(0), (0, 0, 0), (0, 0, 0), (0, 0, 0), 0)
    assert len(encode(sample)) == protocol.SAMPLE_WIRE_BYTES == 32
