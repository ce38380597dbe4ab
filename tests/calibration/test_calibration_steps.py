"""Calibration before a person: what each step says lacks, and that it ends with what the command line finds."""

import json
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.calibration.cameras.board_watch import BoardWatch
from vislam.calibration.inertial.sample_watches import PoseWatch, StillWatch, TurnWatch
from vislam.calibration.kinds import KINDS
from vislam.calibration.options import BoardOptions
from vislam.cli.wizard import calibration_steps, run_setup
from vislam.cli.wizard.calibration_steps import STEPS, CalibrationSteps, board_of
from vislam.cli.wizard.run_setup import RunSetup
from vislam.cli.wizard.step_sensors import opened
from vislam.config import Config, SensorsConfig
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.datasets.imu_files import read_imu_calibration
from worlds.board import BOARD, WEBCAM, pose, see
from worlds.calibration import ACCEL_MATRIX, T0_NS, hand_held, still_imu, ups

_BOARD = BoardOptions()


def samples(t_s, values):
    for t, row in zip(np.asarray(t_s).tolist(), values, strict=True):
        yield ImuSample(T0_NS + round(t * 1e9), row[:3], row[3:])


def fed(watch, values):
    for value in values:
        watch.take(value)
    return watch


def frames(rng, count: int, held: int = 2):
    """Images of a board that is held in `count` places, each for `held` images."""
    index = 0
    for _ in range(count):
        T = pose(rng, WEBCAM, BOARD)
        for _ in range(held):
            yield Frame(T0_NS + index * 10**8, index, (see(WEBCAM, BOARD, T, rng),))
            index += 1


def test_a_board_that_is_held_still_in_new_places_is_kept_and_calibrates(tmp_path: Path) -> None:
    watch = BoardWatch(tmp_path, _BOARD)
    before = watch.progress()
    assert (before.share, before.can_finish) == (0.0, False)
    fed(watch, frames(np.random.default_rng(2), 14))
    progress = watch.progress()
    assert progress.can_finish
    assert int(progress.facts["Views"].split()[0]) >= 10
    assert np.shape(progress.cells) == (4, 6)
    assert {"left", "right", "top", "bottom"} == {*progress.facts["Sides nearer once"].split(", ")}
    assert progress.jpeg[:2] == b"\xff\xd8"
    outcome = watch.calibrate()
    assert abs(outcome.report["parameters"]["fx"] - WEBCAM.fx) < 5.0 * outcome.report["sigmas"]["fx"]
    assert (tmp_path / "camchain.yaml").is_file()


def test_a_board_that_moves_or_is_not_there_or_stays_is_not_kept(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    watch = fed(BoardWatch(tmp_path, _BOARD), frames(rng, 5, held=1))
    assert watch.progress().facts["Views"].startswith("0 ")
    watch.take(Frame(T0_NS, 0, (np.full((480, 640), 90, np.uint8),)))
    assert "not seen" in watch.progress().advice
    fed(watch, frames(rng, 1, held=6))
    assert watch.progress().facts["Views"].startswith("1 ")
    with pytest.raises(DataError, match="views are the least"):
        watch.calibrate()


def test_poses_are_counted_while_the_sensor_is_held_and_the_file_is_that_of_the_command_line(tmp_path: Path) -> None:
    t_s, values = hand_held(1, ups(1), 3.0, 1.5)
    watch = PoseWatch(tmp_path, _BOARD)
    told = []
    for k, sample in enumerate(samples(t_s, values)):
        watch.take(sample)
        if k % 450 == 449:
            told.append(int(watch.progress().facts.get("Poses", "0 of").split()[0]))
    assert told == sorted(told)
    assert told[0] < 3
    assert watch.progress().facts["Poses"] == "12 of 12"
    assert watch.progress().can_finish
    watch.calibrate()
    found = read_imu_calibration(tmp_path / "imu.yaml")
    assert np.allclose(found.accel_matrix, ACCEL_MATRIX, atol=2e-3)


def test_poses_that_lack_are_named_and_too_few_are_refused(tmp_path: Path) -> None:
    t_s, values = hand_held(1, ups(1)[:4], 3.0, 1.5)
    watch = fed(PoseWatch(tmp_path, _BOARD), samples(t_s, values))
    progress = watch.progress()
    assert not progress.can_finish
    assert "never with" in progress.advice
    with pytest.raises(DataError, match="directions"):
        watch.calibrate()
    assert not (tmp_path / "imu.yaml").exists()


def turned(count: int, spread: float):
    """Samples of a magnetometer and an IMU that are turned at random, as far as `spread` (1: to all sides)."""
    rng = np.random.default_rng(0)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0.0, 0.15, (count, 3)) * [spread, spread, 1.0], axis=0))
    for k, R in enumerate(turns):
        t_ns = T0_NS + k * 20_000_000
        yield ImuSample(t_ns, np.zeros(3), R.inv().apply([0.0, 0.0, 9.81]))
        field_ut = R.inv().apply(np.array([20.0, 0.0, -42.0]))
        yield MagSample(t_ns, field_ut + np.array([12.0, -20.0, 30.0]) + rng.normal(0.0, 0.3, 3))


def test_directions_of_the_field_fill_up_as_the_sensor_is_turned(tmp_path: Path) -> None:
    watch = TurnWatch(tmp_path, _BOARD)
    assert "waiting" in watch.progress().advice
    values = [*turned(3000, 1.0)]
    few = fed(watch, values[:300]).progress()
    many = fed(watch, values[300:]).progress()
    assert not few.can_finish
    assert many.can_finish
    assert sum(seen for *_, seen in few.ways) < sum(seen for *_, seen in many.ways)
    assert many.facts["Way"] == "by hand"
    outcome = watch.calibrate()
    assert outcome.report["kind"] == "mag"


def test_a_cart_that_turns_on_the_floor_is_told_the_sector_that_lacks(tmp_path: Path) -> None:
    def on_floor(turn_rad: float):
        for k, angle in enumerate(np.linspace(0.0, turn_rad, 500)):
            t_ns, c, s = T0_NS + k * 20_000_000, np.cos(angle), np.sin(angle)
            yield ImuSample(t_ns, np.zeros(3), np.array([0.0, 0.0, 9.81]))
            yield MagSample(t_ns, np.array([20.0 * c + 12.0, -20.0 * s - 20.0, -12.0]))

    half = fed(TurnWatch(tmp_path, _BOARD), on_floor(np.pi)).progress()
    assert half.facts["Way"] == "on the floor"
    assert not half.can_finish
    assert "a sector of" in half.advice
    assert fed(TurnWatch(tmp_path, _BOARD), on_floor(2.0 * np.pi)).progress().can_finish


def test_time_still_is_counted_and_five_minutes_are_the_least(tmp_path: Path) -> None:
    values = still_imu(0, 400.0, 20.0, np.full(6, 1e-3), np.zeros(6))
    table = [*samples(np.arange(len(values)) / 20.0, values)]
    watch = fed(StillWatch(tmp_path, _BOARD), table[:2000])
    assert not watch.progress().can_finish
    assert fed(watch, table[2000:]).progress().can_finish
    assert watch.calibrate().report["kind"] == "noise"


def test_samples_that_are_no_numbers_or_out_of_order_are_left(tmp_path: Path) -> None:
    watch = StillWatch(tmp_path, _BOARD)
    good = ImuSample(T0_NS, np.zeros(3), np.ones(3))
    early, broken = replace(good, t_ns=T0_NS - 5), replace(good, t_ns=T0_NS + 9, gyro_rad_s=np.full(3, np.nan))
    fed(watch, [good, good, early, broken])
    assert len(watch._log.inertial().t_ns) == 1


@pytest.mark.parametrize(
    "text",
    [
        {"size": "9"}, {"size": "9x0"}, {"size": "-3x4"}, {"size": "1000000x1000000"}, {"size": "axb"}, {"size": "2x2"},
        {"square_mm": "nan"}, {"square_mm": "0"}, {"pattern": "../x"},
    ],
)  # fmt: skip
def test_what_is_no_board_is_refused(text: dict[str, str]) -> None:
    with pytest.raises(UsageError):
        board_of(text)


def test_a_board_is_what_the_page_says() -> None:
    board = board_of({"kind": "camera", "pattern": "chessboard", "size": "8x6", "square_mm": "25.5"})
    assert (board.kind, board.columns, board.rows, board.square_mm) == ("chessboard", 8, 6, 25.5)


@pytest.mark.parametrize("source", ["virtual-cart", "gy85+none"])
def test_a_source_without_what_a_step_needs_is_told(source: str) -> None:
    with pytest.raises(UsageError, match=r"nothing that a hand could move|no camera"):
        opened(RunSetup(source, Config(), SensorsConfig()), has_images=True)


@pytest.mark.parametrize(
    ("source", "offered"),
    [
        ("virtual-cart,bridge", set()),
        ("gy85+none", {*STEPS} - {"camera"}),
        ("gy85+webcam", {*STEPS}),
        ("oak", {*STEPS}),
    ],
)
def test_no_step_is_offered_that_would_be_refused(tmp_path: Path, source: str, offered: set[str]) -> None:
    assert {*CalibrationSteps(Page(), RunSetup(source, Config(), SensorsConfig()), tmp_path).offered} == offered


class Page:
    """Stands for the page."""

    def __init__(self) -> None:
        self.told: list[dict] = []
        self.pictures: list[bytes] = []

    def update(self, phase: str, **values) -> None:
        self.told.append(values)

    def show(self, jpeg: bytes) -> None:
        self.pictures.append(jpeg)


class Hand:
    """Stands for sensors: gives what it was made with, a part at a time."""

    def __init__(self, values, part: int = 400) -> None:
        self._values, self._part, self.closed = deque(values), part, 0

    @property
    def is_over(self) -> bool:
        return not self._values

    def read(self, timeout_s: float):
        return [self._values.popleft() for _ in range(min(self._part, len(self._values)))]

    def close(self) -> None:
        self.closed += 1


def steps_with(monkeypatch, tmp_path: Path, hand: Hand) -> tuple[CalibrationSteps, Page]:
    monkeypatch.setattr(calibration_steps, "opened", lambda *_: hand)
    page = Page()
    return CalibrationSteps(page, RunSetup("gy85+webcam", Config(), SensorsConfig()), tmp_path / "run"), page


def test_a_step_is_begun_watched_and_finished_and_writes_below_the_run_folder_only(monkeypatch, tmp_path: Path) -> None:
    t_s, values = hand_held(1, ups(1), 3.0, 1.5)
    hand = Hand(samples(t_s, values))
    steps, page = steps_with(monkeypatch, tmp_path, hand)
    steps.obey("calibrate", {"kind": "imu"})
    assert steps.is_going
    while not hand.is_over:
        steps.turn()
    assert steps.shown["stage"] == "going"
    json.dumps(steps.shown, allow_nan=False)
    steps.obey("next", {})
    assert steps.shown["stage"] == "done"
    assert "calibration/imu.yaml" in steps.shown["files"]
    assert page.told[-1]["wizard"]["stage"] == "computing"
    assert not steps.is_going
    assert hand.closed
    written = [path.relative_to(tmp_path).parts[:2] for path in tmp_path.rglob("*") if path.is_file()]
    assert {*written} == {("run", "calibration")}


def test_a_step_that_fails_is_told_and_gives_its_sensors_back(monkeypatch, tmp_path: Path) -> None:
    hand = Hand(samples(np.arange(300) / 100.0, np.tile([0.0, 0, 0, 0, 0, 9.8], (300, 1))))
    steps, _ = steps_with(monkeypatch, tmp_path, hand)
    steps.obey("calibrate", {"kind": "imu"})
    steps.turn()
    steps.obey("next", {})
    assert steps.shown["stage"] == "failed"
    assert steps.shown["lines"]
    assert hand.closed
    assert not steps.is_going


@pytest.mark.parametrize("kind", ["", "board", "floor", "../imu", "nothing"])
def test_what_has_no_steps_is_refused(monkeypatch, tmp_path: Path, kind: str) -> None:
    steps, _ = steps_with(monkeypatch, tmp_path, Hand([]))
    steps.obey("calibrate", {"kind": kind})
    assert steps.shown["stage"] == "failed"
    assert not steps.is_going


def test_a_step_that_is_left_leaves_nothing(monkeypatch, tmp_path: Path) -> None:
    hand = Hand(samples(np.arange(300) / 100.0, np.ones((300, 6))))
    steps, _ = steps_with(monkeypatch, tmp_path, hand)
    steps.obey("calibrate", {"kind": "noise"})
    steps.obey("cancel", {})
    assert (steps.shown, steps.is_going, bool(hand.closed)) == ({}, False, True)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_every_step_has_its_words() -> None:
    assert {*STEPS} == {name for name, kind in KINDS.items() if kind.watch is not None} == {*run_setup._FILES}
    script = (Path(calibration_steps.__file__).parents[2] / "live/web/assets/wizard.js").read_text(encoding="utf-8")
    assert all(f"{name}: " in script for name in STEPS)
