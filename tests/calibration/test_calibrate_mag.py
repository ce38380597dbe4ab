"""Magnetometers: one turn of the cart, turns by hand, honest sigmas, and data that determine nothing."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.calibration.inertial.field import fit_iron
from vislam.calibration.inertial.mag import MagResult, solve_mag
from vislam.calibration.inertial.tables import Table
from vislam.calibration.options import MagOptions
from vislam.core.messages import Array
from vislam.datasets.imu_files import read_mag_calibration
from worlds.calibration import T0_NS, calibrate, refusal, write_table

HARD_UT = np.array([12.0, -20.0, 30.0])
SOFT = np.array([[1.1, 0.05, 0.02], [0.05, 0.9, -0.03], [0.02, -0.03, 1.0]])
EARTH_UT = np.array([20.0, 0.0, -42.0])
SIGMA_UT = 0.3
HZ = 50.0


def sensed(seed: int, R_world_body: Rotation) -> tuple[Array, Array, Array]:
    """Return times, inertial samples [N, 6] and raw fields [N, 3] along attitudes at 50 Hz."""
    rng = np.random.default_rng(seed)
    count = len(R_world_body)
    turns = (R_world_body[:-1].inv() * R_world_body[1:]).as_rotvec() * HZ
    gyro = np.vstack([turns, turns[-1:]]) + rng.normal(0.0, 0.003, (count, 3))
    accel = R_world_body.inv().apply([0.0, 0.0, 9.81]) + rng.normal(0.0, 0.03, (count, 3))
    field = R_world_body.inv().apply(EARTH_UT) @ SOFT.T + HARD_UT + rng.normal(0.0, SIGMA_UT, (count, 3))
    return np.arange(count) / HZ, np.hstack([gyro, accel]), field


def cart(
    seed: int, turn_rad: float = 2.2 * np.pi, tilt_deg: tuple[float, float] = (0.0, 0.0)
) -> tuple[Array, Array, Array]:
    """A cart that turns on the spot in 20 s; the sensor is mounted with a tilt and wobbles by 0.3 degrees."""
    count = round(20.0 * HZ)
    rng = np.random.default_rng(seed + 1000)
    share = np.linspace(0.0, 1.0, count)
    yaw = turn_rad * (share - np.sin(2.0 * np.pi * share) / (2.0 * np.pi))
    wobble = np.deg2rad(0.3) * np.sin(np.outer(share, [60.0, 83.0]) + rng.uniform(0.0, 6.0, 2))
    mounted = Rotation.from_euler("YX", tilt_deg, degrees=True)
    return sensed(seed, Rotation.from_euler("ZYX", np.column_stack([yaw, wobble])) * mounted)


def by_hand(seed: int, share: float = 1.0) -> tuple[Array, Array, Array]:
    """Turned by hand to all sides, or to a share of them."""
    t = np.arange(round(40.0 * HZ)) / HZ
    angles = share * np.column_stack([2.0 * np.pi * t / 7.0, np.pi * np.sin(t * 0.37), np.pi * np.sin(t * 0.53)])
    return sensed(seed, Rotation.from_euler("ZYX", angles))


def solved(t_s: Array, inertial: Array, field: Array) -> MagResult:
    stamps = T0_NS + np.round(t_s * 1e9).astype(np.int64)
    path = Path("recording")
    return solve_mag(Table(path, stamps, field, {}), Table(path, stamps, inertial, {}), MagOptions(path))


def heading_errors_deg(result: MagResult) -> Array:
    """Return errors of headings of a level cart, but for a common one."""
    yaw = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    raw = Rotation.from_euler("Z", yaw[:, None]).inv().apply(EARTH_UT) @ SOFT.T + HARD_UT
    found = (raw - result.calibration.bias_ut) @ result.calibration.matrix.T
    errors = np.rad2deg(np.angle(np.exp(1j * (-np.arctan2(found[:, 1], found[:, 0]) - yaw))))
    return np.asarray(errors - errors.mean())


def test_one_turn_gives_headings() -> None:
    ratios = []
    for seed in range(12):
        result = solved(*cart(seed))
        assert result.mode == "2d" and result.heading_rms_deg < 2.0
        rms = float(np.sqrt(np.mean(heading_errors_deg(result) ** 2)))
        assert rms < 0.5
        centre = np.linalg.solve(SOFT, np.zeros(3))[:2] + HARD_UT[:2]
        vertical = SOFT[:2, 2] * EARTH_UT[2]  # soft iron turns the vertical field into a level offset
        ratios.append((result.fit.centre - centre - vertical) / result.fit.centre_sigma)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_a_tilted_mount_is_levelled() -> None:
    result = solved(*cart(3, tilt_deg=(6.0, -5.0)))
    assert result.heading_rms_deg < 2.0
    identity_part = result.R_level @ result.calibration.matrix @ result.R_level.T
    assert identity_part[2] == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)


def test_turns_by_hand_give_all_three() -> None:
    ratios = []
    for seed in range(8):
        result = solved(*by_hand(seed))
        assert result.mode == "3d"
        ratios.append((result.fit.centre - HARD_UT) / result.fit.centre_sigma)
        shape = np.linalg.inv(SOFT)
        assert result.fit.shape == pytest.approx(shape / np.cbrt(np.linalg.det(shape)), abs=0.02)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_points_that_are_no_ellipse() -> None:
    x = np.linspace(-1.0, 1.0, 50)
    assert fit_iron(np.column_stack([x, x**2 - 0.1 * x])) is None
    assert fit_iron(np.ones((20, 2))) is None


def written(folder: Path, recording: tuple[Array, Array, Array]) -> Path:
    t_s, inertial, field = recording
    write_table(folder, "mag0", t_s, field)
    return write_table(folder, "imu0", t_s, inertial)


def test_the_verb_writes_a_file_that_the_config_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    answer = calibrate(capsys, "mag", written(tmp_path / "cart", cart(5)), "--out", out)
    assert answer["mode"] == "2d" and answer["direction_sigma_deg"] < 1.0
    found = read_mag_calibration(out / "mag.yaml")
    assert found.bias_ut.tolist() == answer["bias_ut"] and found.matrix.tolist() == answer["matrix"]
    assert (out / "mag.png").stat().st_size > 10_000
    answer = calibrate(capsys, "mag", written(tmp_path / "hand", by_hand(5)), "--out", out, "--overwrite")
    assert answer["mode"] == "3d" and answer["covered"] > 0.9


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def said(name: str, recording: tuple[Array, Array, Array], *more: object) -> str:
        return refusal(capsys, "mag", written(tmp_path / name, recording), "--out", tmp_path / "out", *more)

    assert "never faced" in said("half", cart(1, np.pi))
    t_s, inertial, field = cart(4, np.pi)
    inertial[:, 2] += 0.3  # a gyroscope that was never calibrated seems to turn by itself
    assert "never faced" in said("biased", (t_s, inertial, field))
    assert "all directions" in said("tilted", by_hand(1, 0.2), "--mode", "3d")
    assert "turn the cart on the floor" in said("hand", by_hand(1), "--mode", "2d")
    assert "all directions" in said("flat", cart(1), "--mode", "3d")
    t_s, inertial, field = cart(2)
    stuck = field.copy()
    stuck[:, 1] = 5.0
    assert "y never changes" in said("stuck", (t_s, inertial, stuck))
    iron = field + np.outer(np.exp(-((t_s - 10.0) ** 2)), [40.0, 20.0, 0.0])
    disturbed = said("iron", (t_s, inertial, iron))
    assert "not the same everywhere" in disturbed or "gyroscope's differ" in disturbed
    swapped = field[:, [1, 0, 2]]
    assert "axis is swapped" in said("swapped", (t_s, inertial, swapped))
    only_imu = write_table(tmp_path / "none", "imu0", t_s, inertial)
    assert "mag0/data.csv" in refusal(capsys, "mag", only_imu, "--out", tmp_path / "out")
    assert not list((tmp_path / "out").glob("*"))
