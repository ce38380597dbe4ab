"""Small pictures of keyframes, from the colours that a session keeps for its map; no image of the recording is read."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.encoded_image import decoded
from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.factors import rig_from
from vislam.runs.report.run_files import RunFiles
from vislam.runs.session import Session

_MAX_PICTURES = 120
_MAX_BYTES = 1_200_000  # of all of them
_WIDTH_PX = 240
_QUALITY = 55
_MAX_STORED_BYTES = 4 * 2**20  # of one stored picture
_MAX_SESSION_BYTES = 2**30  # of a larger one no pictures are taken: checking it would take longer than the report


@dataclass(slots=True, eq=False)
class Thumbnails:
    """Keyframes of a run with their pictures: id, stamp and JPEG, evenly over the run, in order of time."""

    t_ns: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))  # [K] of all keyframes
    images: list[tuple[int, int, bytes]] = field(default_factory=list)
    T_body_cam: Array | None = None  # [4, 4] of the first camera


def read_thumbnails(run: RunFiles) -> Thumbnails:
    """Return what the session of a run has to show; nothing, with the reason in `run.unread`, when it is damaged."""
    path = run.folder / "session.db"
    if not run.has(path.name):
        return Thumbnails()
    try:
        if path.stat().st_size > _MAX_SESSION_BYTES:
            return Thumbnails()
        session = Session(path)
        try:
            return _of_session(session)
        finally:
            session.close()
    except (DataError, OSError, sqlite3.Error, KeyError, TypeError, ValueError) as error:
        run.unread[path.name] = str(error)
        return Thumbnails()


def _of_session(session: Session) -> Thumbnails:
    first = session.first_id
    stamps = [t_ns for i, t_ns in session.rows("SELECT id, t_ns FROM keyframes ORDER BY id") if i >= first]
    query = (
        f"SELECT id FROM scans WHERE id >= {first} AND length(depth_png) > 0 "
        f"AND length(colors) <= {_MAX_STORED_BYTES} ORDER BY id"
    )
    ids = [row[0] for row in session.rows(query)]
    places = np.linspace(0, max(len(ids) - 1, 0), min(len(ids), _MAX_PICTURES)).round().astype(int)
    out = Thumbnails(np.array(stamps, np.int64))
    rig = session.info().get("rig")
    if rig is not None:
        out.T_body_cam = rig_from(rig).T_body_cam0
    left = _MAX_BYTES
    for place in places:
        for i, t_ns, data in session.rows(f"SELECT id, t_ns, colors FROM scans WHERE id = {int(ids[place])}"):
            jpeg = _small(data)
            if jpeg is not None and len(jpeg) <= left:
                out.images.append((i, t_ns, jpeg))
                left -= len(jpeg)
    return out


def _small(data: bytes) -> bytes | None:
    """Return a stored picture made small; None when it is none, or claims to be larger than any camera's."""
    image = decoded(data, cv2.IMREAD_COLOR)
    if image is None:
        return None
    scale = _WIDTH_PX / image.shape[1]
    size = (_WIDTH_PX, max(round(image.shape[0] * scale), 1))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
