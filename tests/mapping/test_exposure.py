"""Gains of pictures, from what they see together."""

import numpy as np

from vislam.mapping.mesh.exposure import exposure_gains

PLACES = 400


def pictures(factors, rng, sees=0.5):
    """What views with these factors [V, 3] see of places whose colours are drawn."""
    truth = rng.uniform(40.0, 150.0, (PLACES, 3))
    out = []
    for factor in factors:
        places = np.flatnonzero(rng.random(PLACES) < sees)
        colors = truth[places] * factor * rng.normal(1.0, 0.03, (len(places), 3))
        out.append((places, np.clip(np.round(colors), 0, 255).astype(np.uint8)))
    return out


def off(gains, factors):
    """How far gains times factors are from being alike, at most."""
    product = gains * factors
    return np.abs(product / product.mean(axis=0) - 1.0).max()


def test_gains_undo_exposure_and_white_balance():
    rng = np.random.default_rng(3)
    factors = rng.uniform(0.7, 1.5, (12, 3))
    gains = exposure_gains(pictures(factors, rng), PLACES)
    assert off(gains, factors) < 0.03
    assert off(np.ones_like(factors), factors) > 0.3


def test_what_only_some_pictures_show_there_does_not_count():
    rng = np.random.default_rng(4)
    factors = rng.uniform(0.85, 1.15, (8, 3))
    seen = pictures(factors, rng, sees=0.8)
    for places, colors in seen[:2]:  # something stands there
        colors[: len(places) // 8] = (200, 20, 20)
    assert off(exposure_gains(seen, PLACES), factors) < 0.03


def test_what_is_cut_off_or_dark_tells_nothing():
    white = (np.arange(PLACES), np.full((PLACES, 3), 255, np.uint8))
    grey = (np.arange(PLACES), np.full((PLACES, 3), 90, np.uint8))
    black = (np.arange(PLACES), np.zeros((PLACES, 3), np.uint8))
    assert np.allclose(exposure_gains([white, grey, black], PLACES), 1.0)


def test_pictures_that_share_nothing_stay_as_they_are():
    first = (np.arange(10), np.full((10, 3), 50, np.uint8))
    second = (np.arange(10, 20), np.full((10, 3), 150, np.uint8))
    assert np.allclose(exposure_gains([first, second], 20), 1.0)
    nothing = (np.zeros(0, np.int64), np.zeros((0, 3), np.uint8))
    assert np.allclose(exposure_gains([first, nothing], 20), 1.0)
