"""Named sets of settings for kinds of machines; a settings file and options go before them."""

from collections.abc import Mapping
from typing import Any

from vislam.core.errors import UsageError

PROFILES: Mapping[str, Mapping[str, Any]] = {
    # four cores of a small computer, or one of a desktop; docs/config.md has its cost in accuracy
    "pi": {
        "frontend": {"max_tracks": 200, "described_features": 500},
        "ekf": {"tight_max_tracks": 30},
        "window": {"keyframes": 10},
        "map": {"resolution_m": 0.1, "pixel_step": 4},
        "view": {"enabled": False},
    },
}


def profile(name: str) -> dict[str, Any]:
    """Return the settings of a profile as nested data; raises UsageError for one that there is not."""
    if name not in PROFILES:
        raise UsageError(f"no profile '{name}'; there are: {', '.join(PROFILES)}")
    return merged({}, PROFILES[name])


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested settings of which those `above` go before those `below`."""
    out = {key: merged(value, {}) if isinstance(value, Mapping) else value for key, value in below.items()}
    for key, value in above.items():
        lower = out.get(key)
        nested = lower if isinstance(lower, Mapping) else {}
        out[key] = merged(nested, value) if isinstance(value, Mapping) else value
    return out
