"""Names that settings had in earlier versions: users' files and the settings recorded with runs are read with them."""

import logging
from collections.abc import Mapping
from typing import Any

from vislam.config.machine import USUAL_SLIP_M_S, MachineConfig
from vislam.config.profiles import merged
from vislam.core.errors import UsageError

_LOG = logging.getLogger(__name__)
_MOTION = (
    "outage_accel_sigma_m_s2", "outage_gyro_sigma_rad_s", "lost_speed_sigma_m_s", "lost_rate_sigma_deg_s",
    "rest_speed_sigma_m_s", "rest_sigma_m", "rest_sigma_deg",
)  # fmt: skip
MOVED: Mapping[str, str] = {
    "imu.gravity_m_s2": "machine.gravity_m_s2",
    "imu.max_gap_s": "machine.max_gap_s",
    "ekf.max_gap_s": "machine.max_gap_s",
    "ekf.axle_m": "machine.axle_m",
    "ekf.floor_sigma_m": "machine.floor_sigma_m",
    "ekf.nonholonomic": "machine.slip_sigma_m_s",
    "ekf.nonholonomic_sigma_m_s": "machine.slip_sigma_m_s",
    "graph.axle_m": "machine.axle_m",
    "graph.floor_sigma_m": "machine.floor_sigma_m",
    "graph.nonholonomic_sigma_m_s": "machine.slip_sigma_m_s",
    **{f"{section}.imu_max_gap_s": "machine.max_gap_s" for section in ("window", "graph")},
    **{f"{section}.imu_max_outage_s": "machine.max_outage_s" for section in ("window", "graph")},
    **{f"{section}.{name}": f"machine.{name}" for section in ("window", "graph") for name in _MOTION},
}


def refuse_moved(arguments: list[str]) -> None:
    """Raise UsageError for an option of the command line that has another name now."""
    for argument in arguments:
        name = argument.partition("=")[0]
        moved = MOVED.get(name.removeprefix("--").replace(".no-", ".").replace("-", "_"))
        if name.startswith("--") and moved is not None:
            raise UsageError(f"{name} is now --{moved.replace('_', '-')}; docs/config.md describes the section machine")


def renamed(data: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return nested settings with the names of this version, and log a warning for each name that was another.

    Where several old names stand for one setting, those at its default give way; a new name goes before them. Raises
    UsageError where two of them contradict each other.
    """
    out, found = merged({}, data), dict[str, tuple[str, Any]]()
    for old, new in MOVED.items():
        section, _, name = old.partition(".")
        if not isinstance(out.get(section), dict) or name not in out[section]:
            continue
        value = out[section].pop(name)
        if old == "ekf.nonholonomic":
            value = out["ekf"].get("nonholonomic_sigma_m_s", USUAL_SLIP_M_S) if value else None
            out["ekf"].pop("nonholonomic_sigma_m_s", None)
        elif old == "ekf.nonholonomic_sigma_m_s":
            continue  # without wheels it means nothing
        _LOG.warning("%s: %s is now %s", source, old, new)
        default = getattr(MachineConfig(), new.partition(".")[2])
        if value == default or (isinstance(default, tuple) and tuple(value) == default):
            continue
        before = found.setdefault(new, (old, value))
        if before[1] != value:
            raise UsageError(
                f"{source}: {before[0]} is {before[1]} and {old} is {value}; both are now {new}: write it once"
            )
    return merged(
        {"machine": {new.partition(".")[2]: value for new, (_, value) in found.items()}} if found else {}, out
    )


def known(data: Mapping[str, Any], version: Mapping[str, Any]) -> dict[str, Any]:
    """Return of nested settings those that this version has; `version` are its defaults."""
    return {
        name: known(value, version[name]) if isinstance(value, dict) and isinstance(version[name], dict) else value
        for name, value in data.items()
        if name in version
    }
