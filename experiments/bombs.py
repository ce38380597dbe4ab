"""Small files that ask for much, for `fuzz.py`: aliases, depth, packed zeros, forged sizes, damage at every level."""

from __future__ import annotations

import bz2
import struct
import zlib

import lz4.frame
import numpy as np

_MOST_UNPACKED = 2**26


def yaml_bomb(rng: np.random.Generator, sound: bytes) -> bytes:
    """Return a calibration with what multiplies, nests, refers to itself or is of an odd type."""
    times, levels = int(rng.integers(1, 12)), int(rng.integers(1, 60))
    one = (b"[%s]", b"{<<: [%s]}", b"{a: %s}", b"[[%s], 1]")[int(rng.integers(4))]
    lines = [b"a0: &a0 {k: 1, l: [1, 2]}"]
    for i in range(1, levels):
        back = max(0, i - int(rng.integers(1, 3))) if rng.random() > 0.02 else i  # at times an alias of itself
        lines.append(b"a%d: &a%d " % (i, i) + one % b",".join([b"*a%d" % back] * (times if b"{a" not in one else 1)))
    deep, depth = (b"[", b"{a: ", b"- ", b"? ")[int(rng.integers(4))], int(rng.integers(1, 30_000))
    odd = (
        b"!!int ''", b"!!timestamp x", b"1" + b":1" * depth, b"9" * depth, b"*a%d" % (levels - 1), b"2020-13-45",
        b"!!binary '='", b"!!python/object:os.system x", b"{[a]: b}", b"!!omap [1]", b".inf", deep * depth,
    )[int(rng.integers(12))]  # fmt: skip
    rows = sound.splitlines()
    at = int(rng.integers(0, len(rows)))
    key = rows[at].partition(b":")[0]
    rows[at] = key + b": " + odd if rng.random() < 0.8 else b"<<: *a%d" % (levels - 1)
    return b"\n".join([*lines, *rows]) + b"\n"


def toml_bomb(rng: np.random.Generator, sound: bytes) -> bytes:
    """Return settings with deep keys, tables and values, or very many of them."""
    depth, count = int(10 ** rng.uniform(0, 4.7)), int(10 ** rng.uniform(0, 3))
    name = (b"a", b'"="', b"'.'", b"window", b"1")[int(rng.integers(5))]
    key = b" . ".join([name] * depth) if rng.random() < 0.3 else b".".join([name] * depth)
    what = (
        key + b" = 1", b"[" + key + b"]\n" + b"".join(b"b%d = 1\n" % i for i in range(count)), b"a = " + b"[" * depth,
        b"a = " + b"{a = " * depth, b"".join(b"[[%s]]\n" % name for _ in range(depth)), b"seed = " + b"9" * depth,
        b'a = ["""\n""", {' + key + b" = 1}]", b"".join(b"[a%d]\nx = 1\n" % i for i in range(depth)),
    )[int(rng.integers(8))]  # fmt: skip
    return (what + b"\n" + sound if rng.random() < 0.5 else sound + b"\n" + what)[: 2**20]


def bag_bomb(rng: np.random.Generator) -> bytes:
    """Return a bag of rosbag 1 of chunks that unpack to much, lie in each other, or end in the middle."""
    out = b"#ROSBAG V2.0\n"
    for _ in range(int(10 ** rng.uniform(0, 1.5))):
        record = _ros_record([b"op=" + bytes([int(rng.integers(0, 9))])], bytes(int(rng.integers(0, 20))))
        filling = (record, b"\0", b"\x04\0\0\0op=\x05", rng.bytes(50))[int(rng.integers(4))]
        body = filling * int(min(10 ** rng.uniform(0, 6.5), _MOST_UNPACKED // len(filling)))
        method = (b"bz2", b"lz4", b"none")[int(rng.integers(3))]
        if method == b"none" or (method == b"bz2" and filling != b"\0"):  # bz2 packs what repeats itself slowly
            body = body[: 2**20]
        packed = {b"bz2": bz2.compress, b"lz4": lz4.frame.compress, b"none": bytes}[method](body)
        declared = len(body) if rng.random() < 0.7 else int(rng.integers(0, 2**32))
        fields = [b"op=\x05", b"compression=" + method, b"size=" + struct.pack("<I", declared)]
        chunk = _ros_record(fields, packed)
        out += chunk * int(10 ** rng.uniform(0, 2)) if len(chunk) < 20_000 else chunk
    return _cut(out, rng)


def mcap_bomb(rng: np.random.Generator) -> bytes:
    """Return an MCAP file of such chunks, with an index to all, some or overlapping places."""
    magic, places, out = b"\x89MCAP0\r\n", [], bytearray(b"\x89MCAP0\r\n")
    for _ in range(int(10 ** rng.uniform(0, 3.3))):
        body = _record(int(rng.integers(0, 20)), bytes(int(rng.integers(0, 30)))) * int(10 ** rng.uniform(0, 2))
        if rng.random() < 0.01:
            body *= int(10 ** rng.uniform(0, 3.5))
        method = (b"", b"lz4")[int(rng.random() < 0.2)]
        packed = lz4.frame.compress(body) if method else body[: int(rng.integers(1, len(body) + 1))]
        places.append(len(out))
        length = len(packed) if rng.random() < 0.9 else int(rng.integers(0, 2**20))
        head = struct.pack("<QQQII", 0, 0, len(body), 0, len(method)) + method + struct.pack("<Q", length)
        out += struct.pack("<BQ", 6, len(head) + length) + head + packed
    at = len(out) + 13
    index = b"".join(
        struct.pack("<BQQQQ", 8, 64, 0, 0, place + int(rng.random() < 0.1)) + bytes(40) for place in places
    )
    out += struct.pack("<BQI", 15, 4, 0) + index + struct.pack("<BQQQI", 2, 20, at, 0, 0) + magic
    return _cut(bytes(out), rng)


def forged_image(rng: np.random.Generator, sound: bytes) -> bytes:
    """Return a PNG whose head states another size or kind, or one that unpacks to far more than it is."""
    width, height = (int(10 ** rng.uniform(0, 5.5)) for _ in range(2))
    head = struct.pack(">IIBBBBB", width, height, int(rng.choice([1, 8, 16])), int(rng.choice([0, 2, 3, 6])), 0, 0, 0)
    data = zlib.compress(bytes(int(10 ** rng.uniform(0, 7))))
    parts = [(b"IHDR", head), *[(b"IDAT", data)] * int(rng.integers(1, 4)), (b"IEND", b"")]
    if rng.random() < 0.3:
        return sound[:16] + struct.pack(">II", width, height) + sound[24:]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in parts
    )


def _ros_record(fields: list[bytes], data: bytes) -> bytes:
    head = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def _record(kind: int, data: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(data)) + data


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(8, len(data) + 1))] if rng.random() < 0.3 else data
