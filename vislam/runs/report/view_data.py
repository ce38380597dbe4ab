"""What the interactive view of a report shows: map, paths, errors, loops and small pictures, thinned and quantised.

All of it comes from the run folder alone, and the same folder gives the same bytes.
"""

import base64
import json
import sqlite3
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.encoded_image import decoded
from vislam.core.errors import DataError
from vislam.core.messages import Array, Tracking
from vislam.factors import rig_from
from vislam.loop import caption
from vislam.mapping.file_names import CLASSES_NAME
from vislam.mapping.formats.ply import read_ply
from vislam.mapping.semantic.layer_files import read_layer
from vislam.runs.report.page_assets import floats, packed
from vislam.runs.report.run_files import RunFiles
from vislam.runs.report.scene import Scene, loop_ends
from vislam.runs.session import Session

_MAX_POINTS = 350_000  # of the map: 3.7 MB of page
_MAX_CLOUD_BYTES = 4 * 2**30
_MAX_PATH = 4000  # poses of a line
_MAX_LOOPS = 2000
_MAX_ELLIPSOIDS = 80
_MAX_TEXT = 400  # letters of one reason
_FAR_QUANTILE = 0.002  # points beyond it on either side do not decide how large the picture is
_STATES = tuple(Tracking)
MAX_VOXELS = 120_000  # 1 MB of page
_MAX_CLASSES = 16  # with a colour and a switch of their own
_REST = {"name": "all other labels", "color": [128, 128, 128]}
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
        with Session(path) as session:
            return _of_session(session)
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
    size = (_WIDTH_PX, min(max(round(image.shape[0] * scale), 1), 4 * _WIDTH_PX))  # no camera's is so high
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def view_data(run: RunFiles, scene: Scene) -> dict[str, Any]:
    """Return the data of the view, ready for JSON; empty where there is no path to stand on.

    Times are seconds since the start of the run, positions metres in the scene's frame. What cannot be read is left
    out and named in `run.unread`.
    """
    best = next((name for name in ("batch", "graph", "live", "ekf") if len(scene.paths.get(name, ())) > 1), None)
    if best is None:
        return {}
    paths = {name: path for name, path in scene.paths.items() if len(path) > 1}
    if scene.truth is not None and len(scene.truth) > 1:
        paths = {"truth": scene.truth, **paths}
    pictures = read_thumbnails(run)
    return {
        "end_s": scene.end_s,
        "best": best,
        "labels": {name: scene.labels[name] for name in paths},
        "paths": {name: _path(scene, path.t_ns, path.T_world_body, name == best) for name, path in paths.items()},
        "errors": {
            name: {
                "t": floats(_thin(curve.t_s)),
                "position": floats(_thin(curve.position_m)),
                "rotation": floats(_thin(curve.rotation_deg)),
            }
            for name, curve in scene.errors.items()
        },
        "has_camera": run.has_camera,
        "tracking": _tracking(run, scene),
        "sigmas": _sigmas(run, scene, best),
        "loops": _loops(run, scene),
        "cloud": _cloud(run, scene),
        "voxels": label_data(run, scene),
        **_pictures(pictures, scene),
    }


def as_script(data: dict[str, Any]) -> str:
    """Return the data as JSON that no parser of HTML can leave, whatever text is in it."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _thin(values: NDArray[Any]) -> NDArray[Any]:
    return values[:: len(values) // _MAX_PATH + 1]


def _path(scene: Scene, t_ns: NDArray[np.int64], T: Array, with_rotation: bool) -> dict[str, str]:
    t_ns, T = _thin(t_ns), _thin(T)
    out = {"t": floats(scene.seconds(t_ns)), "xyz": floats(T[:, :3, 3])}
    return {**out, "R": floats(T[:, :3, :3])} if with_rotation else out


def _sigmas(run: RunFiles, scene: Scene, best: str) -> dict[str, str]:
    """Return half axes of three sigmas of the position, evenly along the best path, if it has covariances."""
    states = run.states.get("ekf" if best == "ekf" else "graph", [])
    path = scene.paths[best]
    states = [state for state in states if path.t_ns[0] <= state.t_ns <= path.t_ns[-1]]
    states = [states[k] for k in np.linspace(0, len(states) - 1, min(len(states), _MAX_ELLIPSOIDS)).round().astype(int)]
    covariances = np.array([state.covariance[3:6, 3:6] for state in states]).reshape(-1, 3, 3)
    good = np.isfinite(covariances).all(axis=(1, 2))
    if not good.any():
        return {}
    variances, directions = np.linalg.eigh(covariances[good])
    axes = scene.S_scene_map[:3, :3] @ (3.0 * np.sqrt(np.maximum(variances, 0.0))[:, None] * directions)
    places = path.at(np.array([state.t_ns for state in states])[good])[:, :3, 3]
    return {"xyz": floats(places), "axes": floats(axes)}


def _tracking(run: RunFiles, scene: Scene) -> dict[str, Any]:
    """Return inliers and state of every frame, thinned so that no lost frame disappears between two that are not."""
    rows = run.tracking
    if rows is None or not len(rows.t_ns):
        return {}
    states = np.array([_STATES.index(state) for state in rows.tracking], np.uint8)
    step = len(states) // _MAX_PATH + 1
    starts = range(0, len(states), step)
    chosen = np.array([k + int(np.argmax(states[k : k + step])) for k in starts])
    reasons: dict[str, int] = {"": 0}
    index = [reasons.setdefault(rows.reason[k][:_MAX_TEXT], len(reasons)) for k in chosen.tolist()]
    return {
        "t": floats(scene.seconds(rows.t_ns[chosen])),
        "inliers": floats(rows.inliers[chosen]),
        "state": packed(states[chosen], "u1"),
        "reason": packed(np.array(index), "<u2"),
        "reasons": list(reasons),
    }


def _loops(run: RunFiles, scene: Scene) -> dict[str, Any]:
    """Return the loops with their ends on the best path; accepted ones first, so that they are never cut off."""
    rows, ends = loop_ends(run, scene)
    rank = {"accepted": 0, "pending": 1, "rejected": 2}
    order = sorted(range(len(rows)), key=lambda k: (rank.get(rows[k].decision, 3), k))[:_MAX_LOOPS]
    return {
        "ends": floats(ends[order]),
        "rows": [
            {
                "from": rows[k].from_id,
                "to": rows[k].to_id,
                "from_s": float(scene.seconds([rows[k].from_t_ns])[0]),
                "to_s": float(scene.seconds([rows[k].to_t_ns])[0]),
                "decision": rows[k].decision,
                "text": caption(rows[k])[:_MAX_TEXT],
            }
            for k in order
        ],
    }


def _cloud(run: RunFiles, scene: Scene) -> dict[str, Any]:
    """Return the map's points in an order of which every beginning is an even sample of the whole."""
    path = run.folder / "map" / "cloud.ply"
    if not run.has(f"map/{path.name}"):
        return {}
    try:
        if path.stat().st_size > _MAX_CLOUD_BYTES:
            raise DataError(f"{path} is larger than the {_MAX_CLOUD_BYTES // 2**30} GiB that a report reads")
        points, colors = read_ply(path)
    except (DataError, OSError) as error:
        run.unread[f"map/{path.name}"] = str(error)
        return {}
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not len(finite):
        return {}
    chosen = finite[np.random.default_rng(0).permutation(len(finite))[:_MAX_POINTS]]
    S = scene.S_scene_map
    placed = points[chosen].astype(np.float64) @ S[:3, :3].T + S[:3, 3]
    low, high = placed.min(axis=0), placed.max(axis=0)
    step = np.maximum(high - low, 1e-6) / 65535.0
    red, green, blue = colors[chosen].astype(np.uint16).T
    near = np.quantile(placed, [_FAR_QUANTILE, 1.0 - _FAR_QUANTILE], axis=0)
    return {
        "count": len(chosen),
        "of": len(points),
        "low": low.tolist(),
        "step": step.tolist(),
        "near": near.tolist(),
        "xyz": packed(np.rint((placed - low) / step), "<u2"),
        "rgb": packed((red >> 3 << 11) | (green >> 2 << 5) | (blue >> 3), "<u2"),
    }


def _pictures(pictures: Thumbnails, scene: Scene) -> dict[str, Any]:
    T = pictures.T_body_cam
    return {
        "pictures": [
            {"id": i, "t": float(scene.seconds([t_ns])[0]), "jpg": base64.b64encode(jpeg).decode("ascii")}
            for i, t_ns, jpeg in pictures.images
        ],
        "camera": None if T is None else T.tolist(),
        "keyframes": floats(scene.seconds(pictures.t_ns)),
    }


def label_data(run: RunFiles, scene: Scene, most: int = MAX_VOXELS) -> dict[str, Any]:
    """Return classes with their voxels in the scene's frame, the largest first; empty where a map has no labels.

    What cannot be read is left out and named in `run.unread`.
    """
    folder = run.folder / "map"
    if not run.has(f"map/{CLASSES_NAME}"):
        return {}
    try:
        layer = read_layer(folder)
    except DataError as error:
        run.unread[f"map/{CLASSES_NAME}"] = str(error)
        return {}
    if len(layer) == 0:
        return {}
    chosen = np.random.default_rng(0).permutation(len(layer))[:most]
    labels, S = layer.labels[chosen], scene.S_scene_map
    placed = layer.points_m[chosen].astype(np.float64) @ S[:3, :3].T + S[:3, 3]
    low, high = placed.min(axis=0), placed.max(axis=0)
    step = np.maximum(high - low, 1e-6) / 65535.0
    cells = np.rint((placed - low) / step)
    ids, counts = np.unique(labels, return_counts=True)
    order = ids[np.argsort(-counts, kind="stable")].tolist()
    classes = [(_named(layer.classes[i].name, layer.classes[i].color), labels == i) for i in order[:_MAX_CLASSES]]
    if rest := order[_MAX_CLASSES:]:
        classes.append((_REST, np.isin(labels, rest)))
    return {
        "count": len(chosen),
        "of": len(layer),
        "low": low.tolist(),
        "step": step.tolist(),
        "size": layer.resolution_m * float(np.cbrt(abs(np.linalg.det(S[:3, :3])))),
        "classes": [{**named, "xyz": packed(cells[there], "<u2")} for named, there in classes],
    }


def _named(name: str, color: tuple[int, int, int]) -> dict[str, Any]:
    return {"name": name, "color": list(color)}
