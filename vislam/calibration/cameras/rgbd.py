"""`vislam calibrate rgbd`: where and when depth is against colour, and the focal length that both agree on.

What is wrong is measured and mended, then measured once more on the mended recording, and what is left is added. The
unit of depth is no part of it: images and depth alone look the same in a world of another size. Depth with a lens of
its own has its place, focal length and lag found first, then the focal length of colour.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vislam.calibration.options import RgbdOptions
from vislam.calibration.outcome import Folder, Outcome, refuse
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.recording import Problems
from vislam.datasets import survey
from vislam.datasets.calibration_text import camera_text, depth_keys_text
from vislam.datasets.images import DepthFormat
from vislam.datasets.rgbd import Known, PlaceFit, RgbdFacts, fit_place, known, misplaced, rgbd_facts
from vislam.datasets.stream import Survey, frame_table, with_depth_format
from vislam.vision.depth_registration import DepthCamera

_FILES = ("sensor.yaml", "rgbd.png", "rgbd.json")
_MOST_TURN_SIGMA_RAD, _MOST_PLACE_SIGMA_M = 0.005, 0.005  # a pixel or two; more was not found
_MOST_FOCAL_SIGMA, _MOST_LAG_SIGMA_S = 0.01, 0.01
_CENTRE = "the principal point of depth stays as it was: moving it looks as turning depth does"
_WORTH = 2.0  # sigmas: what is nearer to nothing stays as it was given
_SCALE = "the unit of depth cannot be found from images and depth: measure something of known length in the map"


@dataclass(frozen=True, slots=True, eq=False)
class RgbdCalibration:
    """How depth is read and what colour is seen through, with what was measured before and after mending."""

    rig: Rig
    how: DepthFormat
    sure: Known  # of which something could be said
    before: RgbdFacts
    after: RgbdFacts
    place: PlaceFit | None = None  # of depth with a lens of its own


def calibrate_rgbd(options: RgbdOptions) -> Outcome:
    """Find place and lag of depth and the focal length and write them; raises DataError where nothing is determined."""
    folder = Folder(options.out, _FILES, options.overwrite)
    found = fit_rgbd(options.source)
    camera, T_body_cam = found.rig.cameras[0], found.rig.T_body_cams[0]
    pose = None if np.allclose(T_body_cam, np.eye(4)) else T_body_cam
    text = camera_text(camera, pose, f"vislam calibrate rgbd {Path(options.source).name}")
    path = folder.write_text("sensor.yaml", text + depth_keys_text(found.how))
    folder.write_picture("rgbd.png", (10.0, 4.2), lambda figure, colors: draw(figure, colors, found))
    statements = _statements(found)
    report = _report(found, statements)
    folder.write_report("rgbd.json", report)
    following = f"next: vislam run {options.source} ... --calibration.camera {path}"
    return Outcome(report, (*_lines(found), *statements, following), tuple(folder.files))


def fit_rgbd(source: str) -> RgbdCalibration:
    """Return the calibration of a recording with depth; raises DataError when it has none or does not determine it."""
    found = survey(source)
    for error in (*found.errors, *found.lacking.values()):
        raise error
    if found.rig is None or found.depth is None:
        raise DataError(f"{source} has no depth images beside those of a calibrated camera")
    place = (misplaced if found.depth_format.own is None else fit_place)(found, found.rig)
    if place is not None:
        found = with_depth_format(found, place.how)
    before = _measured(found)
    sure = known(before)
    if place is None:
        _refuse_blind(source, before, sure)
    mended = _mended(found, before, sure)
    after = _measured(mended)
    again = known(after)
    both = Known(sure.offset and again.offset, sure.lag and again.lag, sure.focal and again.focal)
    mended = _mended(mended, after, both)
    assert mended.rig is not None
    return RgbdCalibration(mended.rig, mended.depth_format, sure, before, after, place)


def _measured(found: Survey) -> RgbdFacts:
    frames = frame_table(found, Problems())
    if found.rig is None or not np.any(frames.depth_rows >= 0):
        raise DataError(f"{found.root}: no frame has depth; are the stamps of both by one clock?")
    return rgbd_facts(found, found.rig, frames)


def _refuse_blind(source: str, facts: RgbdFacts, sure: Known) -> None:
    if sure.offset or sure.lag or sure.focal or facts.odd_values:
        return
    reasons = []
    if facts.edges is None:
        reasons.append("too few frames, or too few things that stand before others")
    else:
        reasons.append(
            f"place and lag are only known to {np.linalg.norm(facts.edges.offset_sigma_px):.1f} px and "
            f"{1e3 * facts.edges.lag_sigma_s:.0f} ms"
        )
    if facts.focal is None:
        reasons.append("too few corners with depth can be followed from view to view and move as one body")
    else:
        reasons.append(f"the focal length is only known to {facts.focal.sigma:.1%}")
    refuse(f"depth against colour in {source}", [*reasons, "move and turn more, before things near and far"])


def _mended(found: Survey, facts: RgbdFacts, sure: Known) -> Survey:
    """Return a recording with what was measured in the place of what was given, where it is known and worth it."""
    how, rig = found.depth_format, found.rig
    invalid = tuple(odd.value for odd in facts.odd_values if not odd.is_known)
    offset_px, time_offset_s = how.offset_px, how.time_offset_s
    if facts.edges is not None and how.own is None:
        # depth was read shifted by whole pixels, so what is left is beyond those
        measured = facts.offset_px
        worth = np.abs(measured) > _WORTH * facts.edges.offset_sigma_px
        if sure.offset and worth.any():
            left = np.round(offset_px) + np.where(worth, measured, 0.0)
            offset_px = (float(left[0]), float(left[1]))
        if sure.lag and abs(facts.lag_s) > _WORTH * facts.edges.lag_sigma_s:
            time_offset_s -= facts.lag_s
    focal = facts.focal
    if rig is not None and focal is not None and sure.focal and abs(focal.factor - 1.0) > _WORTH * focal.sigma:
        camera = rig.cameras[0]
        camera = replace(camera, fx=camera.fx * focal.factor, fy=camera.fy * focal.factor)
        rig = Rig((camera, *rig.cameras[1:]), rig.T_body_cams, rig.has_depth)
    said = replace(how, invalid=(*how.invalid, *invalid), offset_px=offset_px, time_offset_s=time_offset_s)
    return with_depth_format(replace(found, rig=rig), said)


def _statements(found: RgbdCalibration) -> list[str]:
    """Return what a user must know of how far the numbers can be trusted."""
    sure = {"the place of depth": found.sure.offset, "its lag": found.sure.lag, "the focal length": found.sure.focal}
    lack = "could not be found and stays as it was" if found.how.own is None else "is only roughly known"
    if found.how.own is not None:
        sure = {"the focal length of colour": found.sure.focal} | _sure_of(found.place)
    unknown = [what for what, is_sure in sure.items() if not is_sure]
    said = [f"{' and '.join(unknown)} {lack}"] if unknown else []
    return [*said, *([] if found.how.own is None else [_CENTRE]), _SCALE]


def _sure_of(place: PlaceFit | None) -> dict[str, bool]:
    """Return what of the place of depth the recording shows."""
    if place is None:
        return dict.fromkeys(("the place of depth", "its focal length", "its lag"), False)
    axes = zip(("to the right", "down", "ahead"), place.place_sigma_m, strict=True)
    return {
        "the turn of depth": bool(place.turn_sigma_rad.max() < _MOST_TURN_SIGMA_RAD),
        **{f"the place of depth {name}": bool(sigma < _MOST_PLACE_SIGMA_M) for name, sigma in axes},
        "the focal length of depth": place.focal_sigma < _MOST_FOCAL_SIGMA,
        "the lag of depth": place.lag_sigma_s < _MOST_LAG_SIGMA_S,
    }


def _lines(found: RgbdCalibration) -> list[str]:
    facts, camera, out = found.before, found.rig.cameras[0], []
    for odd in facts.odd_values:
        out.append(f"depth {odd.value} means that nothing was measured: {odd.share:.1%} of the pixels")
    out += [] if found.place is None else found.place.words
    if facts.edges is not None and found.sure.offset and found.how.own is None:
        sigma_px = facts.edges.offset_sigma_px
        dx, dy = found.how.offset_px
        out.append(f"depth lies {dx:.2f} ± {sigma_px[0]:.2f} px right and {dy:.2f} ± {sigma_px[1]:.2f} px down")
    if facts.edges is not None and found.sure.lag and found.how.own is None:
        ms, sigma_ms = -1e3 * found.how.time_offset_s, 1e3 * facts.edges.lag_sigma_s
        out.append(f"depth is late by {ms:.1f} ± {sigma_ms:.1f} ms")
    if facts.focal is not None and found.sure.focal:
        of_fx_px = facts.focal.sigma * camera.fx
        out.append(f"focal length {camera.fx:.2f}, {camera.fy:.2f} ± {of_fx_px:.2f} px, from {facts.focal.pairs} pairs")
        ms, sigma_ms = 1e3 * facts.focal.readout_s, 1e3 * facts.focal.readout_sigma_s
        out.append(f"rolling shutter: {ms:.1f} ± {sigma_ms:.1f} ms from the first row to the last")
    return out


def _report(found: RgbdCalibration, statements: list[str]) -> dict[str, Any]:
    camera, facts = found.rig.cameras[0], found.before
    edges, focal = facts.edges, facts.focal
    return {
        "kind": "rgbd",
        "fx_px": camera.fx,
        "fy_px": camera.fy,
        "focal_sigma": None if focal is None else focal.sigma,
        "focal_known": found.sure.focal,
        "offset_px": list(found.how.offset_px),
        "offset_sigma_px": None if edges is None else edges.offset_sigma_px.tolist(),
        "offset_known": found.sure.offset,
        "time_offset_s": found.how.time_offset_s,
        "time_offset_sigma_s": None if edges is None else edges.lag_sigma_s,
        "time_offset_known": found.sure.lag,
        "readout_s": None if focal is None else focal.readout_s,
        "readout_sigma_s": None if focal is None else focal.readout_sigma_s,
        "invalid": [odd.value for odd in facts.odd_values],
        "units_per_m": found.how.units_per_m,
        "units_known": False,
        "left_offset_px": found.after.offset_px.tolist(),
        "left_lag_s": found.after.lag_s,
        "left_focal": None if found.after.focal is None else found.after.focal.factor - 1.0,
        "frames": facts.frames,
        "pairs": 0 if focal is None else focal.pairs,
        "ends": 0 if edges is None else edges.ends,
        "statements": statements,
        **({} if found.how.own is None else _place_report(found.place, found.how.own)),
    }


def _place_report(place: PlaceFit | None, own: DepthCamera) -> dict[str, Any]:
    return {
        "T_color_depth": own.T_color_depth.tolist(),
        "depth_fx_px": own.camera.fx,
        "turn_sigma_rad": None if place is None else place.turn_sigma_rad.tolist(),
        "place_sigma_m": None if place is None else place.place_sigma_m.tolist(),
        "depth_focal_sigma": None if place is None else place.focal_sigma,
        "lag_sigma_s": None if place is None else place.lag_sigma_s,
    }


def draw(figure: Figure, colors: Mapping[str, str], found: RgbdCalibration) -> None:
    """Draw how well ends of foregrounds meet edges of the image, before and after mending."""
    left, right = figure.subplots(1, 2)
    for facts, style, word in ((found.before, "--", "before"), (found.after, "-", "mended")):
        if facts.edges is None:
            continue
        for axis, (name, color) in enumerate((("right", colors["axis-x"]), ("down", colors["axis-z"]))):
            values = np.where(np.isfinite(facts.edges.by_offset[axis]), facts.edges.by_offset[axis], np.nan)
            left.plot(facts.edges.tried_px, values, style, color=color, label=f"{name}, {word}")
        right.plot(1e3 * facts.edges.tried_s, facts.edges.by_lag, style, color=colors["axis-x"], label=word)
    left.set(xlabel="place of depth [px]", ylabel="edges met, over their mean", title="where depth lies")
    right.set(xlabel="lag of depth [ms]", ylabel="edges met, over their mean", title="how late it is")
    if found.before.edges is not None:
        left.legend(loc="upper right")
        right.legend(loc="upper right")
