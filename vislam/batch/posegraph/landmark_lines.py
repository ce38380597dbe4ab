"""Landmarks in the lines of iSAM and of gtsam: LANDMARK, a place in the pose's frame, and BR, bearing and range.

Both end as edges that measure a position (`PositionEdges`): LANDMARK with the error that iSAM has
(`Pose2d_Point2d_Factor`), BR with the covariance of its polar numbers carried to the measured place, so that its cost
agrees with that of bearing and range to second order.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from vislam.batch.posegraph.extras import Extras, places
from vislam.batch.posegraph.parts import EdgeLines, PoseLines, problem_from_lines, symmetric
from vislam.batch.posegraph.problem import Ids, Mask, PoseGraphProblem
from vislam.batch.posegraph.tagged_lines import Rows
from vislam.core.errors import DataError
from vislam.core.messages import Array

Noise = Literal["root", "covariance"]

LANDMARK_COLUMNS = {"LANDMARK": (2, 5)}
BEARING_RANGE_COLUMNS = {"BR": (2, 4)}

_SOUND = 1e-12  # least eigenvalue of a correlation matrix that can be inverted


def information_of(path: Path, upper: Array, lines: Ids, noise: Noise) -> Array:
    """Return information [M, k, k] of upper triangles in rows: of its square root, or of the covariance.

    Raises DataError with the line of a covariance that is not positive definite, and of a square that is not finite.
    """
    k = round((np.sqrt(8 * upper.shape[1] + 1) - 1) / 2)
    with np.errstate(all="ignore"):
        if noise == "root":
            R = np.zeros((len(upper), k, k))
            a, b = np.triu_indices(k)
            R[:, a, b] = upper
            information = R.transpose(0, 2, 1) @ R
        else:
            covariance = symmetric(upper, tuple(range(k)))
            scale = np.sqrt(np.abs(np.diagonal(covariance, axis1=1, axis2=2)))  # metres and radians
            scale[~(scale > 0.0)] = 1.0
            correlation = covariance / scale[:, :, None] / scale[:, None, :]
            sound: Mask = np.asarray(np.isfinite(correlation).all(axis=(1, 2)))
            sound[sound] = np.linalg.eigvalsh(correlation[sound])[:, 0] > _SOUND
            if not sound.all():
                line = lines[int(np.argmin(sound))]
                raise DataError(f"{path}:{line}: the covariance is not positive definite; repair or remove the line")
            information = np.linalg.inv(correlation) / scale[:, :, None] / scale[:, None, :]
    if not np.isfinite(information).all():
        line = lines[int(np.argmin(np.isfinite(information).all(axis=(1, 2))))]
        raise DataError(f"{path}:{line}: the square of the square root of the information is not finite")
    return 0.5 * (information + information.transpose(0, 2, 1))


def read_sightings(path: Path, rows: Mapping[str, Rows], noise: Noise) -> Extras:
    """Return what LANDMARK and BR lines say, in the order of the file, as far as `rows` have these tags.

    Raises DataError with the line of a range or a sigma that is not positive, and as `information_of` does.
    """
    ids, seen, information, lines = [], [], [], []
    if "LANDMARK" in rows:
        r = rows["LANDMARK"]
        ids.append(r.ids)
        seen.append(r.numbers[:, :2])
        information.append(information_of(path, r.numbers[:, 2:], r.lines, noise))
        lines.append(r.lines)
    if "BR" in rows:
        r = rows["BR"]
        place, W = _polar(path, r)
        ids.append(r.ids)
        seen.append(place)
        information.append(W)
        lines.append(r.lines)
    at = np.concatenate(lines)
    order = np.argsort(at, kind="stable")
    W = np.zeros((len(at), 3, 3))
    W[:, 1:, 1:] = np.concatenate(information)
    ends = np.concatenate(ids)[order]
    none = PoseLines(np.empty(0, dtype=np.int64), np.empty((0, 3, 3)), np.empty(0, dtype=np.int64))
    whole = np.full(len(at), True)
    return Extras(none, ends[:, 1], ends[:, 0], whole, places(np.concatenate(seen)[order]), W[order], whole, at[order])


def with_sightings(path: Path, poses: PoseLines, edges: EdgeLines, seen: Extras, repair: bool) -> PoseGraphProblem:
    """Return the checked problem of poses and edges with their landmarks; raises as `problem_from_lines` does."""
    return seen.marked(problem_from_lines(path, 2, *seen.joined(path, poses, edges), repair=repair))


def landmark_lines(problem: PoseGraphProblem) -> Iterator[str]:
    """Yield a LANDMARK line with the square root of its information for each edge to a landmark."""
    at = np.flatnonzero(problem.is_position)
    R = np.linalg.cholesky(problem.information[at][:, 1:, 1:]).transpose(0, 2, 1)
    numbers = np.column_stack([problem.measurements[at, :2, 2], R[:, 0, 0], R[:, 0, 1], R[:, 1, 1]])
    for (i, j), fields in zip(problem.ids[problem.edges[at]].tolist(), numbers.tolist(), strict=True):
        yield f"LANDMARK {i} {j} " + " ".join(f"{v:.17g}" for v in fields)


def _polar(path: Path, rows: Rows) -> tuple[Array, Array]:
    """Return places [M, 2] in the pose's frame and their information [M, 2, 2] of bearing, range and their sigmas."""
    bearing, distance, bearing_sigma, range_sigma = rows.numbers.T
    for name, values in (("range", distance), ("bearing's sigma", bearing_sigma), ("range's sigma", range_sigma)):
        if (values <= 0.0).any():
            i = int(np.argmax(values <= 0.0))
            raise DataError(f"{path}:{rows.lines[i]}: the {name} is {values[i]:g}, not positive; remove the line")
    along = np.column_stack([np.cos(bearing), np.sin(bearing)])
    across = np.column_stack([-along[:, 1], along[:, 0]])
    with np.errstate(over="ignore", under="ignore"):
        by_range, by_bearing = range_sigma**-2.0, (distance * bearing_sigma) ** -2.0
    if not np.isfinite(by_range + by_bearing).all():
        i = int(np.argmin(np.isfinite(by_range + by_bearing)))
        raise DataError(f"{path}:{rows.lines[i]}: the information is not finite; repair the sigmas")
    W = by_range[:, None, None] * along[:, :, None] * along[:, None, :]
    W += by_bearing[:, None, None] * across[:, :, None] * across[:, None, :]
    return distance[:, None] * along, W
