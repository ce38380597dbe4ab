"""Latitude, longitude and height, and the local frame they are put into."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.core.errors import UsageError
from vislam.sensors.geodetic import Geodetic, LocalFrame, ecef, geodetic

PLACES = st.builds(Geodetic, st.floats(-90.0, 90.0), st.floats(-180.0, 180.0), st.floats(-10_000.0, 100_000.0))


@pytest.mark.parametrize(
    ("place", "wanted"),
    [
        (Geodetic(0.0, 0.0, 0.0), (6378137.0, 0.0, 0.0)),
        (Geodetic(90.0, 0.0, 0.0), (0.0, 0.0, 6356752.314245)),
        (Geodetic(0.0, -90.0, 100.0), (0.0, -6378237.0, 0.0)),
        (Geodetic(42.0, -82.0, 200.0), (660675.2518247, -4700948.68316, 4245737.66222)),  # pymap3d's own example
    ],
)
def test_known_places_are_where_they_are(place: Geodetic, wanted: tuple[float, ...]) -> None:
    np.testing.assert_allclose(ecef(place), wanted, atol=1e-5)


def test_a_known_place_has_its_east_north_and_up() -> None:
    enu = LocalFrame(Geodetic(42.0, -82.0, 200.0)).enu(Geodetic(42.002581974253744, -81.997751960067460, 1139.7018))
    np.testing.assert_allclose(enu, [186.277521, 286.842228, 939.692621], atol=1e-3)  # pymap3d's own example


@given(PLACES)
def test_a_place_comes_back_to_a_micrometre(place: Geodetic) -> None:
    np.testing.assert_allclose(ecef(geodetic(ecef(place))), ecef(place), rtol=0.0, atol=1e-6)
    assert abs(geodetic(ecef(place)).height_m - place.height_m) < 1e-6


@given(PLACES, st.tuples(*[st.floats(-1e5, 1e5)] * 3))
def test_a_local_place_comes_back_to_a_micrometre(datum: Geodetic, enu: tuple[float, float, float]) -> None:
    frame = LocalFrame(datum)
    np.testing.assert_allclose(frame.enu(frame.geodetic(np.array(enu))), enu, rtol=0.0, atol=1e-6)


@given(PLACES)
def test_up_is_up(datum: Geodetic) -> None:
    above = Geodetic(datum.latitude_deg, datum.longitude_deg, datum.height_m + 10.0)
    np.testing.assert_allclose(LocalFrame(datum).enu(above), [0.0, 0.0, 10.0], atol=1e-6)


@pytest.mark.parametrize("wrong", [(91.0, 0.0, 0.0), (0.0, 181.0, 0.0), (0.0, 0.0, 1e6), (float("nan"), 0.0, 0.0)])
def test_a_datum_off_the_earth_is_refused(wrong: tuple[float, float, float]) -> None:
    with pytest.raises(UsageError, match="datum: "):
        LocalFrame(Geodetic(*wrong))


def test_the_middle_of_the_earth_has_no_latitude() -> None:
    with pytest.raises(UsageError, match="centre"):
        geodetic(np.zeros(3))
