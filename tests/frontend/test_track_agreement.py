"""Whether tracks agree on a motion, and when a filter's expectation is followed instead."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.messages import Array
from vislam.frontend.attempt import confirmed, failure, weakness

CONFIG = FrontEndConfig()
PIXELS = np.column_stack([np.arange(100.0), np.zeros(100)])


@dataclass(frozen=True)
class Placed:
    """A placing with which chosen tracks agree."""

    pixels: Array
    agreeing: NDArray[np.bool_]
    failure: str = ""

    @property
    def followed(self) -> int:
        return int(np.isfinite(self.pixels[:, 0]).sum())


def by_those_left(pixels: Array) -> Placed:
    return Placed(pixels, np.isfinite(pixels[:, 0]))


def first(count: int) -> NDArray[np.bool_]:
    return np.arange(100) < count


def test_a_motion_that_most_of_its_tracks_confirm_stays() -> None:
    placed = Placed(PIXELS, first(80))
    assert confirmed(placed, first(40), by_those_left, CONFIG) is placed


def test_tracks_of_something_that_moves_are_left_out_where_they_are_the_most() -> None:
    found = confirmed(Placed(PIXELS, first(70)), first(60), by_those_left, CONFIG)
    assert found.followed == 40
    assert not found.agreeing[:60].any()


def test_an_expectation_that_hardly_a_track_meets_is_not_followed() -> None:
    placed = Placed(PIXELS, first(95))
    assert confirmed(placed, first(90), by_those_left, CONFIG) is placed


def test_a_filter_gains_nothing_by_tracks_that_agree_with_vision_too() -> None:
    placed = Placed(PIXELS, first(95))
    assert confirmed(placed, first(75), by_those_left, CONFIG) is placed


def test_a_failed_motion_is_replaced_by_one_that_the_filter_supports() -> None:
    lost = Placed(PIXELS, first(5), "only 5 of 100 tracks agree on a motion")
    assert confirmed(lost, first(30), by_those_left, CONFIG).failure == ""
    again = confirmed(lost, first(30), lambda pixels: Placed(pixels, ~first(30), "no"), CONFIG)
    assert again is lost


def test_the_first_reason_is_told() -> None:
    assert failure(100, 10, 10, True, 15) == "only 10 of 100 tracks found"
    assert failure(100, 90, 80, False, 15) == "the motion does not converge"
    assert failure(100, 90, 20, True, 15) == "only 20 of 90 tracks agree on a motion"
    assert failure(100, 90, 80, True, 15) == ""
    assert weakness(90, 30, 40) == "only 30 inliers"
    assert weakness(90, 44, 40) == "only 44 of 90 tracks agree"
    assert weakness(90, 80, 40) == ""
