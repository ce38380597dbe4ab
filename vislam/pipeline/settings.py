"""The configuration that runs: what sensors and modes say of a setting is put into it once, before anything begins."""

from dataclasses import replace

from vislam.config import Config, EkfConfig, GraphConfig
from vislam.core.camera import Rig
from vislam.core.errors import UsageError
from vislam.core.imu_noise import ImuNoise
from vislam.core.up import parse_up
from vislam.frontend import common_errors, knows_scale, mode_for
from vislam.frontend.result import CommonErrors


def derived(config: Config, rig: Rig, noise: ImuNoise | None) -> Config:
    """Return the configuration with all that follows from the sensors; deriving it again changes nothing.

    That is: the front end's mode and the filter's coupling where they are `auto`, the rolling shutter's readout where
    it is the front end's, the error that all metres have in common, the factor on motions over a floor, and how long
    a hole between samples is no outage of a slow IMU. `noise` is the IMU's, None without one. `Front` derives for
    itself; who writes settings down or sends them to other processes does so before there is one. Raises UsageError for
    settings that contradict each other.
    """
    if not isinstance(parse_up(config.up), str) or config.up != "auto":
        refuse_up(noise)
    mode = mode_for(config.frontend, rig)
    if rig.is_blind:
        config = _without_camera(config, noise)
    readout_s = config.frontend.readout_s if config.window.readout_s is None else config.window.readout_s
    errors = common_errors(config.frontend, rig, noise)
    by_imu = noise is not None and not rig.is_blind and not rig.is_stereo and not rig.has_depth
    scale_sigma = max(config.graph.scale_sigma, errors.scale_sigma)
    graph = replace(config.graph, scale_sigma=scale_sigma, edges_share_scale=by_imu)
    machine = config.machine
    if noise is not None:  # the time between any two samples of a slow IMU is no outage
        machine = replace(machine, max_gap_s=noise.gap_s(machine.max_gap_s))
    return replace(
        config,
        machine=machine,
        frontend=replace(config.frontend, mode=mode),
        ekf=config.ekf if noise is None else _filter(config, mode, errors, bool(rig.further)),
        window=replace(config.window, readout_s=readout_s),
        graph=graph if noise is not None else without_gravity(graph, rig),
    )


def refuse_up(noise: ImuNoise | None) -> None:
    """Raise UsageError where up is given though an IMU measures it."""
    if noise is not None:
        raise UsageError("--up is for runs without an IMU, which knows it better; leave it away, or --imu.no-enabled")


def refuse_without_scale(ekf: EkfConfig, has_scale: bool, has_imu: bool) -> None:
    """Raise UsageError for settings that need scale by vision where one camera has none."""
    if has_scale:
        return
    if not has_imu:
        raise UsageError(
            "one camera without an IMU cannot see scale; use --frontend.mode stereo or rgbd where the recording "
            "allows it, planar for a camera of known height above a floor, or record an IMU"
        )
    if ekf.vision == "accumulated":
        raise UsageError(
            "--ekf.vision accumulated sums up motion in metres, which one camera does not see; use --frontend.mode "
            "stereo, rgbd or planar, or --ekf.vision relative"
        )


def without_gravity(graph: GraphConfig, rig: Rig) -> GraphConfig:
    """Return the graph's settings without an IMU for gravity: no edges share the IMU's scale.

    And a window sees no scale in one camera; over a floor, the motions of odometry have it.
    """
    coupling = graph.coupling if rig.is_stereo or rig.has_depth else "loose"
    return replace(graph, coupling=coupling, edges_share_scale=False)


def _without_camera(config: Config, noise: ImuNoise | None) -> Config:
    """Return the settings of a run without a camera: no window, no places to recognise, no map of what is seen.

    Raises UsageError where no IMU is there either.
    """
    if noise is None:
        raise UsageError("a run without a camera needs its IMU, and there is none: leave --imu.no-enabled away")
    return replace(
        config, graph=replace(config.graph, coupling="loose"), loop=replace(config.loop, enabled=False),
        map=replace(config.map, enabled=False),
    )  # fmt: skip


def _filter(config: Config, mode: str, errors: CommonErrors, has_further: bool) -> EkfConfig:
    coupling = config.ekf.coupling
    if coupling == "auto":
        # motions of the front end know nothing of what further cameras see
        by_tracks = has_further and mode in ("stereo", "rgbd") and config.machine.slip_sigma_m_s is None
        coupling = "tight" if by_tracks or not knows_scale(mode) else "loose"
    if config.machine.slip_sigma_m_s is not None and coupling == "tight":
        raise UsageError("--machine.slip-sigma-m-s needs --ekf.coupling loose, which has no use for tracks")
    readout_s = config.ekf.tight_readout_s
    return replace(
        config.ekf,
        coupling=coupling,
        tight_readout_s=config.frontend.readout_s if readout_s is None else readout_s,
        scale_sigma=max(config.ekf.scale_sigma, errors.scale_sigma),
        vo_inflation=config.ekf.vo_inflation if errors.vo_inflation is None else errors.vo_inflation,
    )


def makes_depth(config: Config, rig: Rig) -> bool:
    """Whether the map takes depth from one moving camera."""
    return config.map.enabled and config.map.mono_depth.enabled and not knows_scale(mode_for(config.frontend, rig))
