"""A GoPro's MP4 written by hand from gpmf-parser's description: a real video track, and a track `gpmd` of GPMF."""

import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

SECOND = 1000  # ticks of the telemetry's track


def klv(key: str, kind: str, size: int, count: int, data: bytes) -> bytes:
    assert len(data) == size * count, (key, len(data), size, count)
    head = key.encode() + (b"\0" if kind == "" else kind.encode()) + struct.pack(">BH", size, count)
    return head + data + b"\0" * (-len(data) % 4)


def nest(key: str, *values: bytes) -> bytes:
    data = b"".join(values)
    return klv(key, "", 4, len(data) // 4, data)


def text(key: str, value: str) -> bytes:
    data = value.encode("latin-1")
    return klv(key, "c", len(data), 1, data)


def number(key: str, kind: str, value: int) -> bytes:
    data = struct.pack({"L": ">L", "J": ">Q", "s": ">h", "S": ">H", "l": ">l"}[kind], value)
    return klv(key, kind, len(data), 1, data)


def shorts(key: str, rows: np.ndarray) -> bytes:
    data = np.asarray(rows).astype(">i2")
    return klv(key, "s", 2 * data.shape[1], len(data), data.tobytes())


def longs(key: str, rows: np.ndarray) -> bytes:
    data = np.asarray(rows).astype(">i4")
    return klv(key, "l", 4 * data.shape[1], len(data), data.tobytes())


def inertial(
    key: str, rows: np.ndarray, scale: int, total: int, stamp_us: int | None = None, extra: bytes = b"", **told: str
) -> bytes:
    """A stream of samples [N, 3] in the order that they are stored; `told` are texts such as ORIN and SIUN."""
    values = [] if stamp_us is None else [number("STMP", "J", stamp_us)]
    values += [number("TSMP", "L", total)]
    values += [text(name, value) for name, value in told.items()]
    values += [extra, number("SCAL", "s", scale), shorts(key, np.rint(rows * scale))]
    return nest("STRM", *values)


def gps5(rows: np.ndarray, fix: int, precision: int) -> bytes:
    """Samples [N, 5]: latitude, longitude (deg), altitude (m), speeds (m/s)."""
    scales = np.array([10_000_000, 10_000_000, 1000, 1000, 100])
    values = [number("GPSF", "L", fix), klv("GPSU", "U", 16, 1, b"200703123656.940"), number("GPSP", "S", precision)]
    return nest("STRM", *values, longs("SCAL", scales[:, None]), longs("GPS5", np.rint(rows * scales)))


def gps9(rows: np.ndarray) -> bytes:
    """Samples [N, 9]: as GPS5, then days since 2000, seconds of the day, DOP, fix."""
    scales = np.array([10_000_000, 10_000_000, 1000, 1000, 100, 1, 1000, 100, 1])
    whole = np.rint(rows * scales).astype(np.int64)
    data = b"".join(struct.pack(">7l2H", *row) for row in whole.tolist())
    return nest(
        "STRM", text("TYPE", "lllllllSS"), longs("SCAL", scales[:, None]), klv("GPS9", "?", 32, len(rows), data)
    )


def payload(device: str, *streams: bytes) -> bytes:
    return nest("DEVC", number("DVID", "L", 1), text("DVNM", device), *streams)


def box(kind: str, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">I", 8 + len(body)) + kind.encode() + body


def full(kind: str, *parts: bytes, version: int = 0) -> bytes:
    return box(kind, struct.pack(">I", version << 24), *parts)


def table(kind: str, rows: Sequence[Sequence[int]]) -> bytes:
    return full(kind, struct.pack(">I", len(rows)), *(struct.pack(f">{len(row)}I", *row) for row in rows))


def telemetry_track(offsets: list[int], sizes: list[int], durations: list[int], edit: bytes = b"") -> bytes:
    """A `trak` of GPMF, a payload a chunk."""
    header = full("mdhd", struct.pack(">IIIIHH", 0, 0, SECOND, sum(durations), 0, 0))
    handler = full("hdlr", b"mhlr", b"meta", bytes(12), b"GoPro MET\0")
    described = full("stsd", struct.pack(">I", 1), box("gpmd", bytes(8)))
    tables = box(
        "stbl",
        described,
        table("stts", [(1, duration) for duration in durations]),
        table("stsc", [(1, 1, 1)]),
        full("stsz", struct.pack(">II", 0, len(sizes)), struct.pack(f">{len(sizes)}I", *sizes)),
        table("stco", [(offset,) for offset in offsets]),
    )
    media = box("mdia", header, handler, box("minf", box("gmhd"), tables))
    return box("trak", full("tkhd", bytes(80)), edit, media)


def boxes(data: bytes) -> list[tuple[str, int, int]]:
    """Kind, begin and length of the boxes side by side in a file."""
    found, at = [], 0
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        found.append((data[at + 4 : at + 8].decode(), at, length))
        at += length
    return found


def write_video(path: Path, frames: int, rate_hz: float = 20.0, size: tuple[int, int] = (64, 48)) -> Path:
    """An MP4 as OpenCV writes it, frame i of one grey."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), rate_hz, size)
    for i in range(frames):
        writer.write(np.full((size[1], size[0], 3), 20 + 8 * (i % 25), np.uint8))
    writer.release()
    return path


def add_telemetry(path: Path, payloads: list[bytes], durations: list[int], edit: bytes = b"") -> Path:
    """Put a track of payloads into an MP4 whose header is its last box: what is before it stays where it is."""
    data = path.read_bytes()
    kind, at, length = boxes(data)[-1]
    assert kind == "moov"
    begins = at + 8
    offsets = [begins + sum(map(len, payloads[:k])) for k in range(len(payloads))]
    track = telemetry_track(offsets, [len(p) for p in payloads], durations, edit)
    moov = box("moov", data[at + 8 : at + length], track)
    path.write_bytes(data[:at] + box("mdat", *payloads) + moov)
    return path
