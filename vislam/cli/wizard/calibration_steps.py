"""Calibration steps as the page asks for them: begun, shown while they go, finished or left."""

import logging
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vislam.calibration.kinds import KINDS
from vislam.calibration.options import BoardOptions
from vislam.calibration.watching import Progress, Watch
from vislam.cli.wizard.run_setup import RunSetup
from vislam.cli.wizard.step_sensors import CartSensors, PlayedSensors, opened, why_not
from vislam.config import validated
from vislam.core.errors import UsageError, VislamError
from vislam.core.files import plain
from vislam.live.web.station import Station

_LOG = logging.getLogger(__name__)
_READ_S = 0.1
_SHOW_EVERY_S = 0.5  # between two looks at the progress
_FEWEST_SQUARES, _MOST_SQUARES = 3, 64
FOLDER = "calibration"  # in the run folder
STEPS = {name: kind.summary for name, kind in KINDS.items() if kind.watched_by is not None}


class CalibrationSteps:
    """Owns the step that is going on, if any; everything it writes is below one folder."""

    def __init__(self, station: Station, setup: RunSetup, out: Path) -> None:
        """Begin with none.

        Args:
            station: the page.
            setup: of the run that waits.
            out: the run folder.

        Attributes:
            setup: the same with what was calibrated since.
            offered: what each step that these sensors allow does, by kind.
        """
        self._station, self.setup = station, setup
        self._folder = out / FOLDER
        watches = {name: KINDS[name].watch for name in STEPS}
        self.offered = {
            name: STEPS[name]
            for name, watch in watches.items()
            if watch and not why_not(setup.source, watch.has_images)
        }
        self._kind = ""
        self._watch: Watch | None = None
        self._opened: CartSensors | PlayedSensors | None = None
        self._shown_s = 0.0
        self.shown: dict[str, Any] = {}  # of the step, for the page

    @property
    def is_going(self) -> bool:
        """Whether a step reads sensors."""
        return self._watch is not None

    def obey(self, do: str, values: Mapping[str, str]) -> None:
        """Begin, finish or leave a step; what goes wrong is shown in the page."""
        try:
            if do == "calibrate":
                self._begin(values)
            elif do == "next":
                self._finish()
            elif do == "cancel":
                self.close()
                self.shown = {}
        except VislamError as error:
            self._fail(error)

    def turn(self) -> None:
        """Read sensors for a moment, and show how far the step is."""
        if self._watch is None or self._opened is None:
            time.sleep(_READ_S)
            return
        try:
            for value in self._opened.read(_READ_S):
                self._watch.take(value)
            if time.monotonic() - self._shown_s >= _SHOW_EVERY_S or self._opened.is_over:
                self._shown_s = time.monotonic()
                self._show(self._watch.progress())
        except VislamError as error:
            self._fail(error)
            return
        if self._opened.is_over:
            time.sleep(_READ_S)

    def close(self) -> None:
        """Give the sensors back; may be called twice."""
        if self._opened is not None:
            self._opened.close()
        self._watch = self._opened = None

    def _begin(self, values: Mapping[str, str]) -> None:
        self.close()
        name = values.get("kind", "")
        watch = KINDS[name].watch if name in STEPS else None
        if watch is None:
            raise UsageError(f"there are steps for {', '.join(STEPS)}")
        self._kind = name
        self._watch = watch(self._folder, board_of(values))
        try:
            self._opened = opened(self.setup, watch.has_images)
        except BaseException:
            self._watch = None
            raise
        _LOG.info("the web page began to calibrate: %s", self._kind)

    def _finish(self) -> None:
        """Calibrate as the command line does; the sensors are given back before."""
        watch = self._watch
        if watch is None:
            return
        if self._opened is not None:
            self._opened.close()
        self.shown = {"kind": self._kind, "stage": "computing", "advice": "computing; this may take a minute"}
        self._station.update("waiting", wizard=self.shown)
        self._watch = self._opened = None
        outcome = watch.calibrate()
        files = [f"{FOLDER}/{path.name}" for path in outcome.files]
        self.setup, use = self.setup.calibrated(self._kind, self._folder)
        lines = [line for line in outcome.lines if not line.startswith("next: ")]
        self.shown = {
            "kind": self._kind,
            "stage": "done",
            "lines": [*lines, use],
            "files": files,
        }
        _LOG.info("calibrated: %s; %s", self._kind, ", ".join(files))

    def _show(self, progress: Progress) -> None:
        fields = plain(asdict(progress))
        jpeg = progress.jpeg
        del fields["jpeg"]
        is_over = self._opened is not None and self._opened.is_over
        advice = "the recording has ended: finish" if is_over else progress.advice
        self.shown = {"kind": self._kind, "stage": "going", **fields, "advice": advice, "has_picture": bool(jpeg)}
        if jpeg:
            self._station.show(jpeg)

    def _fail(self, error: VislamError) -> None:
        self.close()
        _LOG.warning("not calibrated: %s", error)
        self.shown = {"kind": self._kind, "stage": "failed", "lines": [str(error)]}


def board_of(values: Mapping[str, str]) -> BoardOptions:
    """Return the board that the page describes: pattern, size as "9x6" and the side of a square in millimetres.

    Raises UsageError for what is no board.
    """
    described: dict[str, object] = {}
    if "pattern" in values:
        described["kind"] = values["pattern"]
    if "size" in values:
        columns, _, rows = values["size"].partition("x")
        described |= {"columns": columns, "rows": rows}
    if "square_mm" in values:
        described["square_mm"] = values["square_mm"]
    board = validated(BoardOptions, described, "the board")
    if max(board.columns, board.rows) > _MOST_SQUARES or min(board.columns, board.rows) < _FEWEST_SQUARES:
        raise UsageError(f"a board has {_FEWEST_SQUARES} to {_MOST_SQUARES} squares along a side")
    return board
