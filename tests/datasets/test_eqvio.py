"""Real tracks without images: the table is read as it is, damage is counted or refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.needs import missing
from vislam.core.errors import DataError, UsageError, VislamError
from vislam.core.messages import Frame, ImuSample
from vislam.datasets.formats.eqvio import TrackOptions, TrackRecording, read_track_table
from vislam.frontend.intake import Intake
from vislam.runs.sources import open_source, recorded_path

HEAD = (
    "row_type,t_abs,t_rel,seq,frame_idx,landmark_id,gx,gy,gz,ax,ay,az,bgx,bgy,bgz,bax,bay,baz,u_norm,v_norm,key,value"
)
META = {
    "camera_fx": 458.654, "camera_fy": 457.296, "camera_cx": 367.2, "camera_cy": 248.4, "T_ci_tx": -0.02,
    "T_ci_ty": -0.06, "T_ci_tz": 0.01, "T_ci_qw": 1.0, "T_ci_qx": 0.0, "T_ci_qy": 0.0, "T_ci_qz": 0.0,
    "eqf.input_var_gyr": 4e-8, "eqf.input_var_acc": 1e-4, "eqf.input_var_gyr_bias_walk": 1e-10,
    "eqf.input_var_acc_bias_walk": 1e-6,
}  # fmt: skip


def sample(t_s: float, accel: float = 9.81) -> str:
    return f"imu,{t_s:.7f},0,0,,,0.1,0.2,0.3,0.0,0.0,{accel},0,0,0,0,0,0,,,,"


def sight(t_s: float, landmark: int, u: float, v: float) -> str:
    return f"vision_feature,{t_s:.7f},0,0,0,{landmark},,,,,,,,,,,,,{u},{v},,"


def rows(seconds: float = 2.0) -> list[str]:
    """Return a table: 100 samples and 20 frames a second, five landmarks that drift to the right."""
    out = [HEAD, *(f"meta{',' * 20}{name},{value}" for name, value in META.items())]
    for k in range(round(seconds * 100)):
        if k % 5 == 0:
            out += [sight(5.0 + k / 100, i, 0.1 * i - 0.2 + k * 1e-4, 0.05 * i) for i in range(5, 0, -1)]
        out.append(sample(5.0 + k / 100))
    return out


def written(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def test_samples_and_tracks_come_as_they_were_written(tmp_path: Path) -> None:
    recording = TrackRecording(written(tmp_path / "tracks.csv", rows()))
    events = list(recording.events())
    stamps = [event.t_ns for event in events]
    frames = [event for event in events if isinstance(event, Frame)]
    assert stamps == sorted(stamps) and recording.problems == {} and recording.name == "tracks"
    assert len(frames) == recording.frame_count == 40 and len(events) - 40 == 197
    assert frames[3].t_ns == 5_150_000_000 and frames[3].images == () and frames[3].index == 3
    tracks, camera = frames[3].tracks, recording.rig.cameras[0]
    assert tracks is not None and tracks.track_ids.tolist() == [1, 2, 3, 4, 5]
    assert camera.normalise(tracks.pixels_px)[1] == pytest.approx([0.0015, 0.1])
    assert all(camera.contains(frame.tracks.pixels_px).all() for frame in frames if frame.tracks)
    Intake(recording.rig, 0).accept(frames[0])
    assert recording.rig.T_body_cams[0][:3, 3] == pytest.approx([-0.02, -0.06, 0.01])
    noise = recording.imu_noise
    assert noise is not None and noise.rate_hz == pytest.approx(100.0)
    assert [noise.gyroscope_noise_density, noise.accelerometer_noise_density] == pytest.approx([2e-4, 1e-2])
    assert recording.truth() is None
    later = [event for event in recording.events(5_500_000_000) if isinstance(event, Frame)]
    assert [frame.index for frame in later] == list(range(10, 40))


def test_a_part_has_its_frames_and_the_samples_around_them(tmp_path: Path) -> None:
    path = written(tmp_path / "tracks.csv", rows(4.0))
    recording = TrackRecording(path, TrackOptions(start_s=1.0, duration_s=2.0))
    events = list(recording.events())
    frames = [event.t_ns for event in events if isinstance(event, Frame)]
    samples = [event.t_ns for event in events if isinstance(event, ImuSample)]
    assert (frames[0], frames[-1]) == (6_000_000_000, 8_000_000_000)
    assert samples[0] <= frames[0] and samples[-1] > frames[-1]
    with pytest.raises(UsageError, match=r"lasts 4\.0 s, asked for 3 s from 2 s on"):
        TrackRecording(path, TrackOptions(start_s=2.0, duration_s=3.0))
    with pytest.raises(UsageError, match="no option 'begin_s'"):
        open_source(f"eqvio:{path},begin_s=3")
    assert recorded_path(f"eqvio:{path},start_s=1") == path


def without(name: str) -> Callable[[list[str]], list[str]]:
    return lambda lines: [line for line in lines if f",{name}," not in line]


def with_meta(name: str, value: str) -> Callable[[list[str]], list[str]]:
    return lambda lines: [*without(name)(lines), f"meta{',' * 20}{name},{value}"]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda lines: lines[1:], "no table of tracks: its first line"),
        (lambda lines: [line for line in lines if not line.startswith("imu")], "0 inertial samples and 40 frames"),
        (lambda lines: [line for line in lines if not line.startswith("vision")], "200 inertial samples and 0 frames"),
        (without("camera_fx"), "lacks the meta value camera_fx"),
        (with_meta("camera_fx", "-3"), "focal lengths must be"),
        (with_meta("camera_fx", "1e9"), "focal lengths must be"),
        (with_meta("camera_fy", "wide"), "must be finite numbers"),
        (with_meta("T_ci_qw", "0.2"), "has norm 0.2 instead of 1"),
        (with_meta("eqf.input_var_gyr", "0"), r"must be positive.*give truth=RECORDING"),
        (lambda lines: [lines[0], *("x" + line for line in lines[1:])], "cannot be used, like"),
        (lambda lines: [lines[0], "a" * 5000], "a line of 4096 bytes or more"),
    ],
)
def test_what_cannot_be_used_is_one_line(tmp_path: Path, spoil: Callable[[list[str]], list[str]], message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        TrackRecording(written(tmp_path / "tracks.csv", spoil(rows())))
    assert "\n" not in str(caught.value)


def test_bad_rows_are_counted_and_the_others_used(tmp_path: Path) -> None:
    lines = rows()
    lines += [
        sight(5.1, 3, 0.0, 0.0), sight(5.1, -4, 0.0, 0.0), sight(5.1, 9, 77.0, 0.0), sight(5.1, 9, np.nan, 0.0),
        sample(5.2), sample(6.9999, np.inf), "imu,soon", "lidar,5.0" + "," * 20,
    ]  # fmt: skip
    problems: dict[str, int] = {}
    table = read_track_table(written(tmp_path / "tracks.csv", lines), problems)
    print(problems)
    assert len(table.imu_t_ns) == 200 and [len(ids) for ids, _ in table.seen] == [5] * 40
    assert sum(problems.values()) == 8
    with (tmp_path / "tracks.csv").open("a") as file:
        file.write(sample(7.0)[:-30])  # cut by a crash
    read_track_table(tmp_path / "tracks.csv", problems := {})
    assert any("cut short" in kind for kind in problems)


@given(data=st.data())
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_is_in_the_file_it_is_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    """Bytes changed, cut or put in anywhere: values in order of time, or an error of ours."""
    text = bytearray("\n".join(rows(0.6)).encode() + b"\n")
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(text) - 1))
        text[at : at + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=12))
    path = tmp_path / "damaged.csv"
    path.write_bytes(bytes(text))
    try:
        recording = TrackRecording(path)
        stamps = [event.t_ns for event in recording.events()]
        assert stamps == sorted(stamps)
        intake = Intake(recording.rig, 0)
        for event in recording.events():
            if isinstance(event, Frame):
                intake.accept(event)
        assert intake.refused_tracks == 0
    except VislamError as error:
        assert "\n" not in str(error)


def test_the_table_that_gtsam_brings_is_found() -> None:
    path = recorded_path("eqvio:gtsam")
    assert path is not None and path.is_file()
    recording = open_source("eqvio:gtsam,start_s=3,duration_s=6")
    frames = [event for event in recording.events() if isinstance(event, Frame)]
    assert len(frames) == recording.frame_count == 121 and recording.problems == {}
    assert 10 < np.mean([len(frame.tracks.track_ids) for frame in frames if frame.tracks is not None]) < 30


@pytest.mark.data
def test_real_tracks_lie_on_the_epipolar_lines_of_the_true_motion(data_root: Path) -> None:
    folder = data_root / "euroc_v101_imu"
    if not folder.is_dir():
        missing(f"{folder}")
    recording = open_source(f"eqvio:gtsam,truth={folder}")
    truth, camera, T_body_cam = recording.truth(), recording.rig.cameras[0], recording.rig.T_body_cams[0]
    assert truth is not None and recording.imu_noise is not None and recording.imu_noise.rate_hz == 200.0
    frames = [e for e in recording.events() if isinstance(e, Frame) and truth.t_ns[0] < e.t_ns < truth.t_ns[-1]]
    errors_px = []
    for a, b in zip(frames[::10], frames[10::10], strict=False):
        M = np.linalg.inv(truth.at(b.t_ns) @ T_body_cam) @ truth.at(a.t_ns) @ T_body_cam
        if np.linalg.norm(M[:3, 3]) < 0.1 or a.tracks is None or b.tracks is None:
            continue
        _, i, j = np.intersect1d(a.tracks.track_ids, b.tracks.track_ids, return_indices=True)
        x, y = camera.unproject(a.tracks.pixels_px[i]), camera.unproject(b.tracks.pixels_px[j])
        E = np.cross(M[:3, 3] / np.linalg.norm(M[:3, 3]), M[:3, :3], axisb=0, axisc=0)
        line, back = x @ E.T, y @ E
        norm = np.sqrt(line[:, 0] ** 2 + line[:, 1] ** 2 + back[:, 0] ** 2 + back[:, 1] ** 2)
        errors_px += (np.abs(np.sum(y * line, axis=1)) / norm * camera.fx).tolist()
    print(f"{len(errors_px)} pairs half a second apart: {np.median(errors_px):.2f} px in the median")
    assert len(errors_px) > 300 and np.median(errors_px) < 0.6
