"""What the filter that is published has to be given of what the front half did, so that both stay twins."""

from collections.abc import Iterator
from dataclasses import replace

from vislam.core.messages import no_observations
from vislam.frontend.start import Initialisation
from vislam.live.notices import GaveUp, Rebase, Start, ToFast
from vislam.pipeline.front import Front
from vislam.pipeline.steps import FrontStep


class Corrections:
    """Follows a front half."""

    def __init__(self, front: Front) -> None:
        self._front = front
        self._is_tight = front.config.ekf.coupling == "tight"
        self._start: Initialisation | None = None

    def of_step(self, step: FrontStep) -> Iterator[ToFast]:
        """Yield what was applied to the front half's filter with a frame."""
        found = self._front.begun.newest
        if found is not self._start and found is not None and found.last is not None:
            self._start = found
            yield Start(found.last, step.track.vo)
        if found is None and self._start is not None:
            self._start = None
            yield GaveUp()
        inertial = self._front.inertial
        torn_to = None if inertial is None else inertial.filtering.take_torn()
        if not self._is_tight:
            if torn_to is not None:
                yield Rebase(torn_to, False, False, self._front.noise_scale)
            yield from (replace(correction, observations=no_observations()) for correction in step.corrections)
        elif step.state is not None:
            at_rest = any(correction.at_rest for correction in step.corrections)
            yield Rebase(step.state, step.track.vo.tracking.sees, at_rest, self._front.noise_scale)

    def of_readings(self) -> Iterator[ToFast]:
        """Yield the readings of further sensors applied to it since the last call; `Rebase` has them in its state."""
        for applied in self._front.take_applied_readings():
            if not self._is_tight:
                yield applied
