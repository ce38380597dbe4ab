"""Small files that ask for much, for `fuzz.py`: aliases, depth, packed zeros, forged sizes, damage at every level.

Of run folders: what is stored with its checksums put right, values of other types, links that lead elsewhere.
"""

from __future__ import annotations

import bz2
import importlib
import io
import json
import re
import sqlite3
import struct
import sys
import tempfile
import zipfile
import zlib
from contextlib import closing, suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np

_MOST_UNPACKED = 2**26
_ODD: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2**31, 2**62, 2**64, 10**30, 1e308, -1e-320, float("nan"), float("inf"), "", "nan",
    "x" * 10**5, "../../etc/passwd", "\x1b[31m\u202e", [], {}, [[]], [0] * 10**4, {"": None}, {"a": {"a": {"a": 1}}},
)  # fmt: skip


class Link(bytes):
    """What a link leads to, in the place of what a file holds."""


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


def message_bomb(rng: np.random.Generator, messages: list[tuple[str, str, bytes]]) -> bytes:
    """Return an MCAP file of messages (topic, type, CDR), each packed by zstd, of which some go on with many zeros."""
    zstd = importlib.import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
    names = sorted({(topic, type_) for topic, type_, _ in messages})
    out, share, left = bytearray(b"\x89MCAP0\r\n"), rng.random(), 2 * _MOST_UNPACKED
    for k, (topic, type_) in enumerate(names):
        out += _record(3, struct.pack("<H", k + 1) + _text(type_) + _text("ros2msg") + _text(""))
        out += _record(4, struct.pack("<HH", k, k + 1) + _text(topic) + _text("cdr") + bytes(4))
    for t_ns, (topic, type_, body) in enumerate(messages * int(10 ** rng.uniform(0, 2))):
        more = bytes(int(10 ** rng.uniform(0, 7.5))) if rng.random() < share * 0.2 and left > 0 else b""
        left -= len(more)
        head = struct.pack("<HIQQ", names.index((topic, type_)), t_ns, t_ns, t_ns)
        out += _record(5, head + zstd.compress(body + more))
    return _cut(bytes(out), rng)


def database_bomb(rng: np.random.Generator, sound: bytes) -> bytes:
    """Return a rosbag 2 in a database of which a table is a view without end, or has blobs of zeros."""
    rows = (1, 10**4, 10**7, 10**12)[int(rng.integers(4))]
    count = f"WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT {rows})"
    columns = "id, name, type, serialization_format, offered_qos_profiles, type_description_hash"
    what = (
        ("ALTER TABLE messages RENAME TO m", f"CREATE VIEW messages AS {count} SELECT m.id, topic_id, timestamp, data "
         "FROM m, n"),
        ("ALTER TABLE topics RENAME TO t", f"CREATE VIEW topics AS {count} SELECT n.i AS {columns} FROM t, n"),
        (f"UPDATE messages SET data = zeroblob({int(10 ** rng.uniform(0, 6.5))}) WHERE id % 5 = 1",),
        (f"UPDATE topics SET name = printf('%.{int(10 ** rng.uniform(0, 6))}c', 'x')",),
        [f"INSERT INTO topics SELECT id + {10**k}, name || {k}, {columns[10:]} FROM topics" for k in range(1, 13)],
    )[int(rng.integers(5))]  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "a.db3"
        path.write_bytes(sound)
        with closing(sqlite3.connect(path)) as database:
            for line in what:
                database.execute(line)
            database.commit()
        return _cut(path.read_bytes(), rng)


def archive_bomb(rng: np.random.Generator, sound: bytes) -> bytes:
    """Return an archive of arrays of which one is of many zeros, states another shape, or lies in itself."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(sound)) as there, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as made:
        chosen = str(rng.choice(there.namelist()))
        for name in there.namelist():
            data = there.read(name)
            if name == chosen and rng.random() < 0.5:
                data += bytes(int(10 ** rng.uniform(0, 7.5)))
            elif name == chosen:
                rows, columns = 10 ** int(rng.integers(0, 18)), b" 32" * int(rng.integers(2))
                shape = b"'shape': (%d,%s), }" % (rows, columns)
                data = re.sub(rb"'shape': .*?}", shape, data[:128])[:127].ljust(127) + b"\n" + data[128:]
            made.writestr(name, data)
    return forged_numbers(rng, out.getvalue(), 200) if rng.random() < 0.2 else out.getvalue()


def forged_numbers(rng: np.random.Generator, data: bytes, within: int) -> bytes:
    """Return data of which numbers in the first bytes, of text or binary, are very large."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        written = list(re.finditer(rb"\d+", bytes(out[:within])))
        if written and rng.random() < 0.7:
            match = written[int(rng.integers(len(written)))]
            out[match.start() : match.end()] = b"%d" % int(10 ** rng.uniform(0, 18.5))
        elif out:
            at, width = int(rng.integers(min(within, len(out)))), int(rng.choice([1, 2, 4, 8]))
            value = int(min(2.0 ** rng.uniform(0, 8 * width), 2 ** (8 * width) - 1))
            out[at : at + width] = value.to_bytes(width, str(rng.choice(["little", "big"])))
    return _cut(bytes(out), rng) if rng.random() < 0.3 else bytes(out)


def long_text(rng: np.random.Generator, sound: bytes) -> bytes:
    """Return a table with very many rows or columns, a very long field, or one that goes on in the middle of it."""
    lines = sound.split(b"\n")
    at, count = int(rng.integers(len(lines))), int(10 ** rng.uniform(0, 5))
    kind = int(rng.integers(5))
    lines[at] = (
        lines[at] + lines[at][-6:] * count, b"\n".join([lines[at]] * min(count, 20_000)), lines[at] + b"0" * count,
        lines[at] + b"\r" * count, lines[at].replace(b" ", b" " * min(count, 20_000)),
    )[kind]  # fmt: skip
    return b"\n".join(lines)[: 2**22]


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


def run_bomb(rng: np.random.Generator, sound: dict[str, bytes], outside: Path) -> dict[str, bytes]:
    """Return the files of a run folder of which one to three lack, lead elsewhere, or hold something else."""
    files = dict(sound)
    for _ in range(int(rng.integers(1, 4))):
        endings = sorted({Path(name).suffix for name in files})
        ending = str(rng.choice(endings))
        name = str(rng.choice(sorted(name for name in files if name.endswith(ending))))
        kind, data = int(rng.integers(12)), files[name]
        if isinstance(data, Link) or (kind == 0 and len(files) > 1):
            del files[name]
        elif kind == 1:
            there = sorted(map(str, outside.iterdir()))
            files[name] = Link(str(rng.choice([*there, "/dev/zero", "/proc/self/mem", ".", Path(name).name])).encode())
        elif kind == 2:
            files[f"{name}/x"] = files.pop(name)  # a folder of its name
        elif kind == 3:
            files[name] = data[: int(rng.integers(len(data) + 1))]
        elif kind == 4:
            files |= {"map": Link(str(outside).encode())}
            files = {name: data for name, data in files.items() if not name.startswith("map/")}
        else:
            with suppress(ValueError, sqlite3.Error):  # what was cut short in an earlier round
                files[name] = _stored_bomb(rng, ending, data)
    return files


def _stored_bomb(rng: np.random.Generator, ending: str, data: bytes) -> bytes:
    if ending == ".json":
        return json_bomb(rng, data)
    if ending == ".db":
        return session_bomb(rng, data)
    if ending == ".yaml":
        return yaml_bomb(rng, data)
    if ending in (".jpg", ".png"):
        return forged_image(rng, data)
    return table_bomb(rng, data) if ending in (".csv", ".tum", ".txt") else forged_numbers(rng, data, 400)


def json_bomb(rng: np.random.Generator, sound: bytes) -> bytes:
    """Return an object of which some values, at any depth, are of another type, very many, or no numbers."""
    data = json.loads(sound)
    for _ in range(int(10 ** rng.uniform(0, 1.5))):
        at, key = data, None
        while isinstance(at, dict | list) and at and (key is None or rng.random() < 0.8):
            holder, key = at, (str(rng.choice(sorted(at))) if isinstance(at, dict) else int(rng.integers(len(at))))
            at = at[key]
        if key is not None:
            holder[key] = deepcopy(_ODD[int(rng.integers(len(_ODD)))])
    text = json.dumps(data)
    depth = int(10 ** rng.uniform(0, 4.5))
    return (
        text.replace("null", ("[" * depth, "9" * depth)[int(rng.integers(2))], 1) if rng.random() < 0.1 else text
    ).encode()


def table_bomb(rng: np.random.Generator, sound: bytes) -> bytes:
    """Return a table of which fields or whole columns are something else, or that has very many rows."""
    if rng.random() < 0.3:
        return long_text(rng, sound)
    separator = b"," if b"," in sound else b" "
    rows = [line.split(separator) for line in sound.split(b"\n")]
    odd = (
        b"nan",
        b"inf",
        b"-1",
        b"",
        b"1e308",
        b"9" * 30,
        b"9" * 400,
        b"x",
        b"\xff",
        b"True",
        b"0.5",
        b"9223372036854775807",
    )
    column = int(rng.integers(max(map(len, rows))))
    whole, value = rng.random() < 0.5, odd[int(rng.integers(len(odd)))]
    for row in rows[1:]:
        if len(row) > column and (whole or rng.random() < 0.1):
            row[column] = value
    if rng.random() < 0.1:
        rows = [row[:column] + row[column + 1 :] for row in rows]
    return b"\n".join(separator.join(row) for row in rows)


def session_bomb(rng: np.random.Generator, sound: bytes) -> bytes:
    """Return a session of which some records are others, with checksums that are right for them."""
    from vislam.runs.session.checks import checksums

    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "session.db"
        path.write_bytes(sound)
        with closing(sqlite3.connect(path)) as db, db:
            tables = [row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            tables = [table for table in tables if db.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]]
            table = str(rng.choice(tables))
            columns = [row[1] for row in db.execute(f"PRAGMA table_info({table})")]
            values = [column for column in columns if not column.startswith("crc")]
            column, every = str(rng.choice(values)), int(10 ** rng.uniform(0, 1.7))
            rows = db.execute(f"SELECT rowid, * FROM {table}").fetchall()
            first = int(rng.integers(len(rows)))
            for row in rows[first::every]:
                changed = list(row[1:])
                changed[columns.index(column)] = _other_value(rng, changed[columns.index(column)])
                changed[len(values) :] = checksums(table, tuple(changed[: len(values)]))
                with suppress(sqlite3.Error, OverflowError):
                    places = ", ".join(f"{one} = ?" for one in columns)
                    db.execute(f"UPDATE {table} SET {places} WHERE rowid = ?", (*changed, row[0]))
            if rng.random() < 0.15:
                db.execute(f"DELETE FROM {table} WHERE rowid % {every + 1} = 0")
        return path.read_bytes()


def _other_value(rng: np.random.Generator, value: Any) -> Any:
    """Return something else for a value of a database, of its type or not."""
    if isinstance(value, bytes) and value and rng.random() < 0.8:
        out, at = bytearray(value), 8 * int(rng.integers(len(value) // 8 + 1))
        number = (float("nan"), float("inf"), 1e308, -1.0, 0.0, 1e-320, 5e17, 2.0)[int(rng.integers(8))]
        kind = int(rng.integers(5))
        if kind < 3:
            is_image = value.startswith((b"\x89PNG", b"\xff\xd8"))
            cut, zeros = int(rng.integers(len(out))), bytes(len(out) * int(10 ** rng.uniform(0, 3)))[: 2**21]
            many = bytes(out) * int(10 ** rng.uniform(0, 1.5))
            return forged_image(rng, value) if is_image else (bytes(out[:cut]), zeros, many)[kind]
        whole = int(10 ** rng.uniform(0, 18.9))
        out[at : at + 8] = struct.pack("<d", number) if kind == 3 else struct.pack("<q", whole)
        return bytes(out)
    if isinstance(value, str) and value.startswith(("{", "[")) and rng.random() < 0.8:
        return json_bomb(rng, value.encode()).decode()
    odd = _ODD[int(rng.integers(len(_ODD)))]
    return bytes(1000) if isinstance(odd, list | dict) else odd


def _ros_record(fields: list[bytes], data: bytes) -> bytes:
    head = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _record(kind: int, data: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(data)) + data


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(8, len(data) + 1))] if rng.random() < 0.3 else data
