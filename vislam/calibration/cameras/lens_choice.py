"""Which lens model views of a board speak for: the fewest parameters that explain all corners as well as any do.

Each model is judged by Schwarz's criterion (Annals of Statistics 1978) on one noise, that of the model which fits best.
A corner that a model cannot explain, or cannot image at all, costs a fixed amount, so that models which see less of the
field of view are not better for it.
"""

from __future__ import annotations

import numpy as np

from vislam.calibration.cameras.board import View
from vislam.calibration.cameras.lens import LensFit, Model, fit_lens
from vislam.core.errors import DataError
from vislam.core.messages import Array

_CANDIDATES: tuple[Model, ...] = ("radtan", "equidistant", "radtan5", "ucm", "eucm", "ds", "omni")  # the usual first
_DECISIVE = 10.0  # of the criterion: very strong evidence (Kass and Raftery 1995)
_LOST = 25.0  # squared sigmas at most that a corner costs


def choose_lens(
    views: list[View], size: tuple[int, int], with_skew: bool = False
) -> tuple[Model, LensFit, dict[Model, float]]:
    """Return the model to use, its fit, and the criterion of each that can be fitted, beyond the best's.

    The first of the candidates is taken to which no other is decisively better. Raises DataError when none fits.
    """
    fits: dict[Model, LensFit] = {}
    refusals: list[str] = []
    for model in _CANDIDATES:
        try:
            fits[model] = fit_lens(views, size, model, with_skew)
        except (DataError, np.linalg.LinAlgError) as error:
            refusals.append(str(error))
    if not fits:
        raise DataError(refusals[0])
    variance = min(_variance(fit) for fit in fits.values())
    count = sum(2 * len(view.points_m) for view in views)
    criterion = {
        model: sum(_cost(r, variance) for r in fit.residuals_px) + len(fit.values) * float(np.log(count))
        for model, fit in fits.items()
    }
    least = min(criterion.values())
    beyond = {model: value - least for model, value in criterion.items()}
    model = next(model for model in fits if beyond[model] < _DECISIVE)
    return model, fits[model], beyond


def _variance(fit: LensFit) -> float:
    """Return the variance of a coordinate [px^2], where at most as many corners are left out as count in it."""
    every = np.concatenate(fit.residuals_px)
    lost = np.isnan(every).mean()
    return float("inf") if lost > 0.5 else float(np.nanmean(every**2)) / (1.0 - lost) ** 2


def _cost(residuals_px: Array, variance: float) -> float:
    squares = np.nan_to_num(np.sum(residuals_px**2, axis=1) / variance, nan=_LOST)
    return float(np.minimum(squares, _LOST).sum())
