"""What of the facts is a fault, said so that it can be mended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from vislam.core.errors import DataError
from vislam.core.findings import Finding
from vislam.core.progress import Progress
from vislam.datasets.loaders import FrameTable
from vislam.datasets.rgbd.depth_place import PlaceFit, misplaced
from vislam.datasets.rgbd.facts import RgbdFacts, rgbd_facts
from vislam.datasets.stream import Survey

# What a Kinect has (fr1_desk: 2 px, 13 ms) is no fault; what moves the trajectory is.
_MOST_OFFSET = 0.006  # of the image's width: 4 px of 640
_MOST_LAG_S = 0.020  # as far as depth and colour are paired
_MOST_FOCAL = 0.012
_SURE = 2.5  # sigmas beyond nothing
_MOST_OFFSET_SIGMA_PX, _MOST_LAG_SIGMA_S, _MOST_FOCAL_SIGMA = 2.0, 0.010, 0.010  # beyond these no judgement is possible
_DEPTHS_M = (0.15, 40.0)  # of the median, of any sensor in any room
_LEAST_CONTRAST = 1.04  # of the edges' peak
MEND = "`vislam calibrate rgbd` writes a sensor.yaml that mends it"

What = Literal["invalid value", "unit", "offset", "lag", "focal length"]


@dataclass(frozen=True, slots=True)
class RgbdFault:
    """One thing that is wrong between colour and depth, how much and how surely."""

    what: What
    size: float  # raw value, metres, pixels, seconds, or true over given minus one
    sigma: float
    text: str
    next_step: str = MEND


@dataclass(frozen=True, slots=True)
class Known:
    """Which of the facts are sure enough to be judged."""

    offset: bool
    lag: bool
    focal: bool


def known(facts: RgbdFacts) -> Known:
    """Return what the recording determines."""
    edges, focal = facts.edges, facts.focal
    clear = edges is not None and edges.contrast >= _LEAST_CONTRAST
    return Known(
        offset=clear and edges is not None and bool(edges.offset_sigma_px.max() <= _MOST_OFFSET_SIGMA_PX),
        lag=clear and edges is not None and edges.lag_sigma_s <= _MOST_LAG_SIGMA_S,
        focal=focal is not None and focal.sigma <= _MOST_FOCAL_SIGMA,
    )


def rgbd_faults(facts: RgbdFacts, width_px: int) -> tuple[RgbdFault, ...]:
    """Return everything that is wrong and certain."""
    return (*_number_faults(facts), *_place_faults(facts, width_px), *_focal_faults(facts))


def _number_faults(facts: RgbdFacts) -> list[RgbdFault]:
    out = []
    for odd in facts.odd_values:
        text = f"depth {odd.value} in {odd.share:.1%} of the pixels means that nothing was measured"
        step = "it is read so; 0 would be usual" if odd.is_known else MEND
        out.append(RgbdFault("invalid value", odd.value, 0.0, text, step))
    if not np.isnan(facts.median_depth_m) and not _DEPTHS_M[0] <= facts.median_depth_m <= _DEPTHS_M[1]:
        text = f"half of the depths are below {facts.median_depth_m:.3g} m: the unit is wrong"
        out.append(RgbdFault("unit", facts.median_depth_m, 0.0, text, "correct depth_units_per_m"))
    return out


def _place_faults(facts: RgbdFacts, width_px: int) -> list[RgbdFault]:
    sure, edges, out = known(facts), facts.edges, []
    if edges is None:
        return []
    size_px = float(np.linalg.norm(facts.offset_px))
    sigma_px = float(np.linalg.norm(edges.offset_sigma_px))
    if sure.offset and size_px > max(_MOST_OFFSET * width_px, _SURE * sigma_px):
        text = f"depth is not registered to colour: it lies {offset_words(facts.offset_px)} off, ± {sigma_px:.1f} px"
        out.append(RgbdFault("offset", size_px, sigma_px, text))
    if sure.lag and abs(facts.lag_s) > max(_MOST_LAG_S, _SURE * edges.lag_sigma_s):
        word = "late" if facts.lag_s > 0.0 else "early"
        size_ms, sigma_ms = 1e3 * abs(facts.lag_s), 1e3 * edges.lag_sigma_s
        text = f"depth is {size_ms:.0f} ± {sigma_ms:.0f} ms {word} against colour"
        out.append(RgbdFault("lag", facts.lag_s, edges.lag_sigma_s, text))
    return out


def _focal_faults(facts: RgbdFacts) -> list[RgbdFault]:
    focal = facts.focal
    if focal is None or not known(facts).focal:
        return []
    off = 1.0 / focal.factor - 1.0
    sigma = focal.sigma / focal.factor**2
    if abs(off) <= max(_MOST_FOCAL, _SURE * sigma):
        return []
    word = "long" if off > 0.0 else "short"
    text = f"the focal length is {abs(off):.1%} ± {sigma:.1%} too {word} for how points with depth move"
    return [RgbdFault("focal length", off, sigma, text)]


def misplaced_words(place: PlaceFit) -> str:
    """Return what is wrong with depth that is somewhere else."""
    return f"depth does not lie where it is stated to be: {', '.join(place.words)}"


def offset_words(offset_px: np.typing.NDArray[np.float64]) -> str:
    """Return an offset in words: 6.0 px right and 3.0 px up."""
    dx, dy = (float(x) for x in offset_px)
    return f"{abs(dx):.1f} px {'right' if dx > 0.0 else 'left'} and {abs(dy):.1f} px {'down' if dy > 0.0 else 'up'}"


def rgbd_findings(found: Survey, frames: FrameTable | None, progress: Progress) -> tuple[list[Finding], frozenset[int]]:
    """Return what doctor reports of depth and the rows of images that it read; nothing without depth or calibration."""
    rig = found.rig
    if rig is None or found.depth is None or frames is None or not np.any(frames.depth_rows >= 0):
        return [], frozenset()
    try:
        facts = rgbd_facts(found, rig, frames, progress)
        is_at_home = known(facts).offset and not _place_faults(facts, rig.cameras[0].width)
        place = None if is_at_home else misplaced(found, rig, progress)
    except DataError as error:
        return [Finding("error", str(error), "depth0", "see docs/formats.md")], frozenset()
    if place is not None:
        out = [Finding("warning", fault.text, "depth0", fault.next_step) for fault in _number_faults(facts)]
        return [Finding("warning", misplaced_words(place), "depth0", MEND), *out], facts.depth_rows
    faults = rgbd_faults(facts, rig.cameras[0].width)
    out = [Finding("warning", fault.text, "depth0", fault.next_step) for fault in faults]
    wrong = {fault.what for fault in faults}
    sure, edges, focal = known(facts), facts.edges, facts.focal
    good, unknown = [], []
    for what, is_known in (("offset", sure.offset), ("lag", sure.lag), ("focal length", sure.focal)):
        if not is_known:
            unknown.append(what)
        elif what == "offset" and what not in wrong and edges is not None:
            good.append(f"depth lies {offset_words(facts.offset_px)} of colour")
        elif what == "lag" and what not in wrong and edges is not None:
            good.append(f"lags it by {1e3 * facts.lag_s:.0f} ± {1e3 * edges.lag_sigma_s:.0f} ms")
        elif what == "focal length" and what not in wrong and focal is not None:
            good.append(f"fits a focal length of {focal.factor:.3f} ± {focal.sigma:.3f} times the given one")
    out += [Finding("ok", ", ".join(good), "depth0")] if good else []
    if unknown:
        text = f"colour and depth do not show {' or '.join(unknown)}: too little motion, texture or foreground"
        out.append(Finding("ok", text, "depth0"))
    return out, facts.depth_rows
