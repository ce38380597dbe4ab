"""Zero at power-up: right when the cart stands, refused with a reason when it does not; biases by temperature."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.config import PowerUpConfig
from vislam.core.errors import DataError, StorageError
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array, ImuSpan
from vislam.imu.power_up import BiasMemory, PowerUp, Refusal, power_up

GRAVITY_M_S2 = 9.81
CONFIG = PowerUpConfig()


def rest(
    seed: int = 0, bias: Array | None = None, up: Array | None = None, rate_hz: float = 400.0, duration_s: float = 2.5
) -> ImuSpan:
    """Samples of a GY-85 that stands."""
    rng = np.random.default_rng(seed)
    count = round(duration_s * rate_hz) + 1
    bias = np.array([0.05, -0.1, 0.02]) if bias is None else bias
    up = np.array([0.0, 0.0, 1.0]) if up is None else up
    return ImuSpan(
        np.round(np.arange(count) / rate_hz * 1e9).astype(np.int64),
        bias + 0.0065 * rng.standard_normal((count, 3)),
        GRAVITY_M_S2 * up + 0.08 * rng.standard_normal((count, 3)),
    )


def refusal(span: ImuSpan, **options: object) -> str:
    answer = power_up(span, CONFIG, GRAVITY_M_S2, **options)  # type: ignore[arg-type]
    assert isinstance(answer, Refusal), answer
    return answer.reason


@given(st.integers(0, 1000), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_bias_and_level_of_a_cart_that_stands(seed: int, roll: float, pitch: float) -> None:
    up = so3_exp(np.array([roll, pitch, 0.0]))[2]
    bias = np.random.default_rng(seed).normal(0.0, 0.2, 3)
    answer = power_up(rest(seed, bias, up), CONFIG, GRAVITY_M_S2, 31.0)
    tilt = np.rad2deg(np.arccos(up[2]))
    if np.linalg.norm(bias) > CONFIG.max_rate_rad_s or tilt > CONFIG.max_tilt_deg:
        assert isinstance(answer, Refusal) or abs(tilt - CONFIG.max_tilt_deg) < 0.1
        return
    assert isinstance(answer, PowerUp)
    assert (abs(answer.gyro_bias_rad_s - bias) < 5.0 * answer.gyro_bias_sigma_rad_s).all()
    assert answer.gyro_bias_sigma_rad_s.max() < 4e-4
    level = answer.R_level_body @ up
    np.testing.assert_allclose(level, [0.0, 0.0, 1.0], atol=2e-3)
    assert answer.R_level_body[1, 0] == pytest.approx(0.0, abs=1e-12), "no yaw"
    assert answer.tilt_deg == pytest.approx(tilt, abs=0.1)
    assert answer.force_m_s2 == pytest.approx(GRAVITY_M_S2, abs=0.02)
    assert answer.temperature_c == 31.0


def test_it_is_refused_while_moving_with_asked_and_got() -> None:
    span = rest()
    s = span.t_ns * 1e-9
    shaken = ImuSpan(span.t_ns, span.gyro_rad_s + 0.1 * np.sin(20 * s)[:, None], span.accel_m_s2)
    assert "the rate varies by" in refusal(shaken)
    assert "0.02 allowed; stand still" in refusal(shaken)
    driven = ImuSpan(span.t_ns, span.gyro_rad_s, span.accel_m_s2 + np.outer(np.sin(3 * s), [1.0, 0, 0]))
    assert "the force varies by" in refusal(driven)
    spun = ImuSpan(span.t_ns, span.gyro_rad_s + np.array([0.0, 0.0, 1.5]), span.accel_m_s2)
    assert "the mean rate is 1.5" in refusal(spun)
    begun = ImuSpan(span.t_ns, span.gyro_rad_s + np.outer(0.012 * s, [0.0, 0.0, 1.0]), span.accel_m_s2)
    assert "changed within the window" in refusal(begun)


def test_it_is_refused_without_good_data() -> None:
    span = rest()
    short = ImuSpan(span.t_ns[:400], span.gyro_rad_s[:400], span.accel_m_s2[:400])
    assert "2 s of samples asked, got 1.00 s" in refusal(short)
    holed = np.r_[0:300, 400 : len(span.t_ns)]
    assert "a hole of 0.25 s" in refusal(ImuSpan(span.t_ns[holed], span.gyro_rad_s[holed], span.accel_m_s2[holed]))
    assert "off gravity" in refusal(ImuSpan(span.t_ns, span.gyro_rad_s, span.accel_m_s2 * 1.1))
    assert "tilted by 180" in refusal(ImuSpan(span.t_ns, span.gyro_rad_s, -span.accel_m_s2))
    gone = ImuSpan(span.t_ns, span.gyro_rad_s * np.nan, span.accel_m_s2)
    assert "nan rad/s" in refusal(gone)
    assert "off gravity" in refusal(ImuSpan(span.t_ns, span.gyro_rad_s, span.accel_m_s2 * 0.0))


def test_an_even_turn_is_told_from_a_bias_by_what_is_remembered() -> None:
    memory = BiasMemory(64)
    known = np.array([0.05, -0.1, 0.02])
    turning = rest(bias=known + np.array([0.0, 0.0, 0.3]))
    assert isinstance(power_up(turning, CONFIG, GRAVITY_M_S2, 30.0, memory), PowerUp), "nobody can know yet"
    memory.add(30.4, known)
    assert "remembered" in refusal(turning, temperature_c=30.0, memory=memory)
    assert isinstance(power_up(rest(), CONFIG, GRAVITY_M_S2, 30.0, memory), PowerUp)
    assert isinstance(power_up(turning, CONFIG, GRAVITY_M_S2, 45.0, memory), PowerUp), "another temperature"


def test_biases_become_a_line_over_temperature() -> None:
    memory = BiasMemory(64)
    slope = np.array([1e-3, -5e-4, 2e-4])
    rng = np.random.default_rng(4)
    assert memory.at(25.0) is None
    for t in rng.uniform(15.0, 40.0, 30):
        memory.add(t, slope * (t - 25.0) + 0.01 + rng.normal(0.0, 2e-4, 3))
    np.testing.assert_allclose(memory.per_c(), slope, atol=3e-5)
    at_20 = memory.at(20.0)
    assert at_20 is not None
    np.testing.assert_allclose(at_20, slope * -5.0 + 0.01, atol=3e-4)
    assert memory.at(80.0) is None, "far from anything known"


def test_memory_is_bounded_and_keeps_what_is_near() -> None:
    memory = BiasMemory(8)
    for t in range(-20, 60):
        memory.add(float(t), np.full(3, t * 1e-3))
    assert len(memory) == 8
    assert memory.at(59.0) is not None
    assert memory.at(0.0) is None
    few = BiasMemory(8)
    few.add(20.0, np.ones(3))
    np.testing.assert_array_equal(few.per_c(), np.zeros(3))


def test_memory_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "gyro_bias.json"
    memory = BiasMemory.read(path, 64)
    assert len(memory) == 0
    for t in (20.0, 25.5, 31.0):
        memory.add(t, np.array([t, -t, 0.5]) * 1e-3)
    memory.write(path)
    again = BiasMemory.read(path, 64)
    for t in (20.0, 23.0, 31.0):
        np.testing.assert_array_equal(again.at(t), memory.at(t))
    assert [p.name for p in tmp_path.iterdir()] == ["gyro_bias.json"]
    with pytest.raises(StorageError, match="cannot be written"):
        memory.write(tmp_path / "absent" / "file.json")


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", "null", '{"gyro_biases": 3}', '{"gyro_biases": [[1, 2]]}',
        '{"gyro_biases": [{"temperature_c": 20}]}',
        '{"gyro_biases": [{"temperature_c": 20, "gyro_bias_rad_s": [1, 2]}]}',
        '{"gyro_biases": [{"temperature_c": 20, "gyro_bias_rad_s": [1, 2, NaN]}]}',
        '{"gyro_biases": [{"temperature_c": 1e400, "gyro_bias_rad_s": [0, 0, 0]}]}',
        '{"gyro_biases": [{"temperature_c": "x", "gyro_bias_rad_s": [0, 0, 0]}]}',
        json.dumps({"gyro_biases": [], "more": "x" * 200_000}),
    ],
)  # fmt: skip
def test_a_damaged_file_is_an_error_that_names_it(tmp_path: Path, text: str) -> None:
    path = tmp_path / "gyro_bias.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"gyro_bias.json holds no gyro biases"):
        BiasMemory.read(path, 64)
