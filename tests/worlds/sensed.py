"""Sensors beside camera and IMU in the world of `lap`: their readings, placed between keyframes, with exact truth."""

from dataclasses import replace

import numpy as np

from vislam.core.geometry import invert, so3_exp, so3_log
from vislam.core.messages import Array, KeyframePacket
from vislam.core.readings import OwnStart, PlacedReading, Reading, Station
from vislam.sensors import BodyState, Sensor, Variable
from worlds.lap import World, position, rotation
from worlds.parts import GRAVITY_M_S2, derivative

_IMU_SIGMA_M_S2, _STEADY_SIGMA_M_S2 = 0.05, 0.5  # of the force over a keyframe: with an IMU, and without


class Fixes(Sensor):
    """Places of an antenna in a frame of their own, whose heading and origin nobody knows."""

    columns = ("x_m", "y_m", "z_m")
    touches = ("rotation", "position")

    def __init__(self, sigma_m: float = 0.1) -> None:
        self.sigma_m = sigma_m
        lever = [Variable(f"lever_{axis}_m", 0.1) for axis in "xyz"]
        origin = [Variable(f"origin_{axis}_m", 1000.0) for axis in "xyz"]
        self.variables = (*lever, Variable("heading_rad", np.pi), *origin)

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        antenna = body.position_m + body.R_world_body @ own[:3]
        return values - so3_exp(np.array([0.0, 0.0, own[3]])) @ antenna - own[4:]

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
        Rz, R = so3_exp(np.array([0.0, 0.0, own[3]])), body.R_world_body
        x, y, _ = Rz @ (body.position_m + R @ own[:3])
        H, heading = np.zeros((3, 15)), np.array([[-y], [x], [0.0]])
        H[:, :3], H[:, 3:6] = Rz @ R @ np.cross(own[:3], np.eye(3)), Rz
        return H, np.hstack([Rz @ R, heading, np.eye(3)])

    def noise(self, values: Array) -> Array:
        return np.eye(3) * self.sigma_m**2


class Range(Sensor):
    """The distance of the body to a place that is known to a metre."""

    columns = ("range_m",)
    touches = ("position",)

    def __init__(self, place_m: Array, sigma_m: float = 0.05) -> None:
        self.sigma_m = sigma_m
        self.variables = tuple(Variable(f"{axis}_m", 1.0, float(p)) for axis, p in zip("xyz", place_m, strict=True))

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        return values - np.linalg.norm(body.position_m - own)

    def noise(self, values: Array) -> Array:
        return np.eye(1) * self.sigma_m**2


class Speed(Sensor):
    """Velocity in body axes at a lever arm, with an unknown scale and an offset of the forward axis that wanders."""

    columns = ("forward_m_s", "left_m_s", "up_m_s")
    touches = ("rotation", "velocity", "gyro_bias")
    variables = (Variable("scale", 0.1, 1.0), Variable("offset_m_s", 0.1, 0.0, 0.02))
    lever_m = np.array([0.4, -0.2, 0.1])

    def __init__(self, sigma_m_s: float = 0.02) -> None:
        self.sigma_m_s = sigma_m_s

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        at_lever = body.R_world_body.T @ body.velocity_m_s + np.cross(body.rate_rad_s, self.lever_m)
        return values - own[0] * at_lever - np.array([own[1], 0.0, 0.0])

    def noise(self, values: Array) -> Array:
        return np.eye(3) * self.sigma_m_s**2


def body_at(world: World, t_s: float) -> BodyState:
    """Return the true body at a time."""
    h, nothing = 1e-4, np.zeros(3)
    t = np.array([t_s])
    R, before, after = (rotation(t + s).as_matrix()[0] for s in (0.0, -h, h))
    return BodyState(
        round(t_s * 1e9),
        R,
        position(t, world.scale_m)[0],
        derivative(lambda s: position(s, world.scale_m), t, 1e-3)[0],
        nothing,
        nothing,
        so3_log(np.ascontiguousarray(before.T @ after)) / (2 * h),
    )


def station_at(world: World, k: int, share: float, imu: bool = True) -> Station:
    """Return where between keyframes k - 1 and k a share of the way is, by noisy samples with the bias taken off."""
    length_s = 1.0 / world.keyframe_hz
    still = np.eye(3), np.zeros(3), np.zeros(3)
    if not imu:
        rest = (np.zeros(3),) * 3
        return Station(share * length_s, length_s, *still, still[0], still[2], 0.0, *rest, _STEADY_SIGMA_M_S2)
    n = round((k - 1) * world.imu_hz / world.keyframe_hz)
    count = round(world.imu_hz / world.keyframe_hz)
    here = round(share * count)
    bias = world.true_gyro_bias[n], world.true_accel_bias[n]
    gyro, accel = world.gyro[n : n + count + 1] - bias[0], world.accel[n : n + count + 1] - bias[1]
    dt = 1.0 / world.imu_hz
    R, v, p = still
    path = [still]
    for i in range(count):
        half = R @ so3_exp(0.25 * dt * (gyro[i] + gyro[i + 1]))
        force = half @ (0.5 * (accel[i] + accel[i + 1]))
        R, p, v = R @ so3_exp(0.5 * dt * (gyro[i] + gyro[i + 1])), p + dt * v + 0.5 * dt * dt * force, v + dt * force
        path.append((R, v, p))
    (R_all, _, p_all), (R_s, v_s, p_s) = path[-1], path[here]
    return Station(here * dt, length_s, R_s, v_s, p_s, R_all, p_all, GRAVITY_M_S2, gyro[here], *bias, _IMU_SIGMA_M_S2)


def reading_at(
    world: World, name: str, sensor: Sensor, own: Array, k: int, share: float, rng: np.random.Generator,
    imu: bool = True,
) -> PlacedReading:  # fmt: skip
    """Return what a sensor with these own variables says, a share of the way from keyframe k - 1 to k."""
    station = station_at(world, k, share, imu)
    body = body_at(world, float(world.times_s[k - 1]) + station.since_s)
    none = np.zeros(len(sensor.columns))
    predicted = -sensor.residual(none, body, own)
    values = predicted + np.linalg.cholesky(sensor.noise(predicted)) @ rng.normal(size=len(predicted))
    return PlacedReading(Reading(name, body.t_ns, values), station)


def with_readings(packet: KeyframePacket, *readings: PlacedReading, starts: tuple[OwnStart, ...] = ()):
    """Return a packet with readings, and the first values of own variables."""
    return replace(packet, readings=(*packet.readings, *readings), own_starts=(*packet.own_starts, *starts))


def pose_error(T_true: Array, T: Array) -> Array:
    """Return the error [6] of a pose as `NavState` has it: rotation on the body side, position in world axes."""
    turned = so3_log(np.ascontiguousarray((invert(T) @ T_true)[:3, :3]))
    return np.concatenate([turned, T_true[:3, 3] - T[:3, 3]])
