"""Which view each triangle of a mesh shows: a sharp and near one that its neighbours show, too.

As in Waechter, Moehrle and Goesele, "Let there be color! Large-scale texturing of 3D reconstructions", ECCV 2014, a
view is worth the gradients of the picture within the triangle, and neighbours with other views cost; iterated
conditional modes, first over triangles of one small cube that face the same way, then over triangles, take the place of
their graph cut. What hides a triangle is the view's own depth and, where it has none, the mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix

from vislam.core.geometry import invert
from vislam.core.jit import njit
from vislam.core.messages import Array, ImageU8
from vislam.mapping.cloud.cloud import cells_of
from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.mesh.drawing import NEAR_M, completed_depth
from vislam.mapping.mesh.posed import PosedView

I64 = NDArray[np.int64]
F32 = NDArray[np.float32]
I32 = NDArray[np.int32]

MARGIN_PX = 2  # around a chart, so that filters of viewers find colours of its own
_PATCH_M = 0.15  # edge of the cubes whose triangles vote together
_MIN_FACING = 0.03  # cosine to the ray; noise turns triangles, and one that is turned away is taken for this
_HIDDEN_M = 0.03  # behind the view's depth by more than this, and twice the noise of depth: something stands before it
_NOISE_1M = 0.005
_BRIGHT, WHITE = 225.0, 250.0  # of 255, the darkest channel: from here on details are lost, and here all are ...
_OVEREXPOSED = 0.1  # ... and worth so much of another picture of it
_AT_BORDER = 0.05  # where the view has no depth itself, or something hides a corner: colours of two things are mixed
_WINDOW_PX = 9  # in which gradients and colours are averaged
_ASTRAY = 30.0  # grey levels off what the mesh has there of all views: worth half, as something else is seen there
_FLAT = 4.0  # grey levels per pixel of gradient that noise makes: where all views are flat, the nearest is best
_CANDIDATES = 8  # best views that are kept of a cube, and half of them of a triangle
_SMOOTH = 0.7  # what it is worth to share a view with all neighbours; the best view of one's own is worth 1
_PASSES = 10


class _Seen(NamedTuple):
    """What a view sees, for kernels."""

    depth_m: F32  # [h, w]
    complete_m: F32  # [h, w] with depth of the mesh where the view has none
    colors: ImageU8  # [h, w, 3]
    detail: F32  # [h, w] gradients around a pixel
    soft: F32  # [h, w, 3] mean colours around a pixel, exposure undone
    K: Array  # [3, 3]
    T_view_map: Array  # [4, 4]


class _Links(NamedTuple):
    """Neighbours, as rows of a sparse matrix."""

    first: I32  # [N + 1]
    other: I32  # [E]
    weight: NDArray[np.float64]  # [E]


class Faces(NamedTuple):
    """Triangles by themselves."""

    mesh: Mesh
    corners: Array  # [M, 3, 3]
    normals: Array  # [M, 3]
    colors: F32  # [M, 3] of all views together

    @classmethod
    def of(cls, mesh: Mesh) -> Faces:
        """Return the triangles of a mesh."""
        corners = mesh.points_m.astype(np.float64)[mesh.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return cls(mesh, corners, normals, mesh.colors.astype(np.float32)[mesh.triangles].mean(axis=1))

    def every(self, step: int) -> Faces:
        """Return every n-th one."""
        return Faces(self.mesh, self.corners[::step], self.normals[::step], self.colors[::step])


@njit(cache=True, nogil=True, inline="always")
def _seen_from(T: Array, p: Array) -> tuple[float, float, float]:
    """Return a point [3] in the view's frame."""
    x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    return x, y, z


@njit(cache=True, nogil=True, inline="always")
def _is_clear(depth_m: F32, K: Array, point: tuple[float, float, float]) -> bool:
    """Whether a point of the view's frame lies where the view sees something, nothing before it in four pixels."""
    x, y, z = point
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    slack = max(_HIDDEN_M, 2.0 * _NOISE_1M * z * z)
    i, j = int(v), int(u)
    for row in range(i, i + 2):
        for column in range(j, j + 2):
            if 0.0 < depth_m[row, column] < z - slack:
                return False
    return depth_m[int(v + 0.5), int(u + 0.5)] < z + slack


@njit(cache=True, nogil=True, inline="always")
def _is_inside(depth_m: F32, K: Array, point: tuple[float, float, float]) -> bool:
    """Whether a point of the view's frame is in the image, with a margin."""
    x, y, z = point
    if z <= NEAR_M:
        return False
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    rows, columns = depth_m.shape
    return MARGIN_PX <= u < columns - 1 - MARGIN_PX and MARGIN_PX <= v < rows - 1 - MARGIN_PX


@njit(cache=True, nogil=True)
def _scores(corners: Array, normals: Array, colors: F32, seen: _Seen, out: Array) -> None:
    """Give each triangle what a view's picture of it is worth per square metre, 0 where it does not see it."""
    K, T = seen.K, seen.T_view_map
    for i in range(len(corners)):
        out[i] = 0.0
        x, y, z = _seen_from(T, (corners[i, 0] + corners[i, 1] + corners[i, 2]) / 3.0)
        inside = _is_inside(seen.complete_m, K, (x, y, z))
        for k in range(3):
            inside = inside and _is_inside(seen.complete_m, K, _seen_from(T, corners[i, k]))
        if not inside or not _is_clear(seen.complete_m, K, (x, y, z)):
            continue
        row, column = int(K[1, 1] * y / z + K[1, 2] + 0.5), int(K[0, 0] * x / z + K[0, 2] + 0.5)
        pixel, is_measured = seen.colors[row, column], seen.depth_m[row, column] > 0.0
        dark, bright = min(pixel[0], pixel[1], pixel[2]), max(pixel[0], pixel[1], pixel[2])
        if seen.complete_m[row, column] <= 0.0 or not (is_measured or bright > 0):  # black is outside of the lens
            continue
        clear = is_measured
        for k in range(3):
            clear = clear and _is_clear(seen.complete_m, K, _seen_from(T, corners[i, k]))
        counts = min(max((WHITE - dark) / (WHITE - _BRIGHT), _OVEREXPOSED), 1.0) * (1.0 if clear else _AT_BORDER)
        off, soft = 0.0, seen.soft[row, column]
        for k in range(3):
            off += (soft[k] - colors[i, k]) ** 2 / (3.0 * _ASTRAY * _ASTRAY)
        counts /= 1.0 + off
        nx = T[0, 0] * normals[i, 0] + T[0, 1] * normals[i, 1] + T[0, 2] * normals[i, 2]
        ny = T[1, 0] * normals[i, 0] + T[1, 1] * normals[i, 1] + T[1, 2] * normals[i, 2]
        nz = T[2, 0] * normals[i, 0] + T[2, 1] * normals[i, 1] + T[2, 2] * normals[i, 2]
        cosine = max(-(nx * x + ny * y + nz * z) / np.sqrt(x * x + y * y + z * z), _MIN_FACING)
        out[i] = counts * (_FLAT + seen.detail[row, column]) * cosine * K[0, 0] * K[1, 1] / (z * z)


def scores(faces: Faces, view: PosedView, gain: Array, complete_m: F32 | None = None) -> Array:
    """Return what a view's picture of each triangle is worth [M], 0 where it does not see it whole.

    `gain` [3] undoes its exposure, `complete_m` [h, w] is its depth with what the mesh adds; None: its own depth alone.
    """
    grey = cv2.cvtColor(view.colors, cv2.COLOR_RGB2GRAY).astype(np.float32)
    steep = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.125))
    detail = cv2.blur(steep, (_WINDOW_PX, _WINDOW_PX))
    soft = cv2.blur(view.colors, (_WINDOW_PX, _WINDOW_PX)).astype(np.float32) * gain.astype(np.float32)
    T, K = np.ascontiguousarray(invert(view.T_map_view)), np.ascontiguousarray(view.K)
    complete_m = view.depth_m if complete_m is None else complete_m
    out = np.zeros(len(faces.corners))
    seen = _Seen(view.depth_m, complete_m, view.colors, detail, soft, K, T)
    _scores(faces.corners, faces.normals, faces.colors, seen, out)
    return out


@njit(cache=True, nogil=True)
def _keep(score: Array, k: int, best: F32, view: I32) -> None:
    """Put view `k` among the best [N, C] of each, in the place of the worst, where it is better."""
    for i in range(len(score)):
        worst = 0
        for c in range(1, best.shape[1]):
            if best[i, c] < best[i, worst]:
                worst = c
        if score[i] > best[i, worst]:
            best[i, worst], view[i, worst] = score[i], k


@njit(cache=True, nogil=True)
def _settle(best: F32, view: I32, links: _Links, out: I32) -> None:
    """Change what each shows until none would rather show another candidate, given its neighbours."""
    for _ in range(_PASSES):
        changes = 0
        for i in range(len(out)):
            own, most, total = best[i].max(), 0.0, 0.0
            if own <= 0.0:
                continue
            for e in range(links.first[i], links.first[i + 1]):
                total += links.weight[e]
            chosen = out[i]
            for c in range(best.shape[1]):
                if best[i, c] <= 0.0:
                    continue
                shared = 0.0
                for e in range(links.first[i], links.first[i + 1]):
                    if out[links.other[e]] == view[i, c]:
                        shared += links.weight[e]
                value = np.sqrt(best[i, c] / own) + _SMOOTH * shared / max(total, 1.0)
                if value > most:
                    most, chosen = value, view[i, c]
            changes += chosen != out[i]
            out[i] = chosen
        if changes == 0:
            return


def _settled(best: F32, view: I32, pairs: I64, start: I32 | None = None) -> I32:
    """Return the view of each of N by its candidates [N, C], and by neighbours [E, 2]; -1 where none sees it."""
    a, b = np.concatenate([pairs, pairs[:, ::-1]]).T
    matrix = coo_matrix((np.ones(len(a)), (a, b)), shape=(len(best), len(best))).tocsr()
    links = _Links(matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data)
    out = np.take_along_axis(view, best.argmax(axis=1)[:, None], axis=1)[:, 0]
    out = np.where(best.max(axis=1) > 0.0, out, -1)
    out = np.ascontiguousarray(out if start is None else np.where(start >= 0, start, out), np.int32)
    _settle(best, view, links, out)
    return out


def chosen_views(faces: Faces, pairs: I64, views: Callable[[], Iterable[PosedView]], gains: Array) -> I32:
    """Return the view of each triangle [M], -1 where none sees it, by neighbours [E, 2] and gains of views [V, 3].

    Views are asked for twice.
    """
    axis = np.argmax(np.abs(faces.normals), axis=1)
    side = 2 * axis + (faces.normals[np.arange(len(axis)), axis] > 0.0)
    _, patch = np.unique(cells_of(faces.corners.mean(axis=1), _PATCH_M) * 6 + side, return_inverse=True)
    count = int(patch.max(initial=-1)) + 1
    best, view = np.zeros((count, _CANDIDATES), np.float32), np.full((count, _CANDIDATES), -1, np.int32)
    for k, posed in enumerate(views()):
        _keep(np.bincount(patch, scores(faces, posed, gains[k]), count), k, best, view)
    apart = patch[pairs]
    of_patch = _settled(best, view, apart[apart[:, 0] != apart[:, 1]])[patch]
    best, view = (
        np.zeros((len(patch), _CANDIDATES // 2), np.float32),
        np.full((len(patch), _CANDIDATES // 2), -1, np.int32),
    )
    of_its_patch = np.zeros(len(patch), np.float32)
    for k, posed in enumerate(views()):
        score = scores(faces, posed, gains[k], completed_depth(faces.mesh.points_m, faces.mesh.triangles, posed))
        _keep(score, k, best, view)
        here = of_patch == k
        of_its_patch[here] = score[here]
    best, view = np.column_stack([of_its_patch, best]), np.column_stack([of_patch, view])
    return _settled(best, view, pairs, np.where(of_its_patch > 0.0, of_patch, -1))
