"""A finished run as plain values, for scripts and notebooks: `load_run("runs/desk")`."""

import base64
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError, VislamError
from vislam.core.messages import Array, LoopDecision
from vislam.loop import LoopRow, read_loops
from vislam.runs.folder import read_metrics, recorded_alignment
from vislam.runs.levelled import onto_map
from vislam.trajectory import Trajectory, align, associate, read_states_csv, read_tum

_MAX_DRAWN = 2000  # poses per line: more cannot be seen and only make the notebook heavy


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class KeyframeStates:
    """What was estimated at each keyframe; velocity and biases are NaN where the run had no IMU."""

    keyframe_id: NDArray[np.int64]  # [N]
    t_ns: NDArray[np.int64]  # [N]
    T_world_body: Array  # [N, 4, 4]
    velocity_world_m_s: Array  # [N, 3]
    gyro_bias_rad_s: Array  # [N, 3]
    accel_bias_m_s2: Array  # [N, 3]
    covariance: Array  # [N, 15, 15] rotation, position, velocity, gyro bias, accel bias; see `NavState`

    def __len__(self) -> int:
        return len(self.t_ns)

    def __repr__(self) -> str:
        return f"KeyframeStates({len(self)} keyframes)"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoadedRun:
    """What a run left, as far as it came; in a notebook it shows itself with a picture."""

    folder: Path
    trajectories: dict[str, Trajectory]  # "ekf" in odom; "live", "graph", "batch" in map; "truth" in its own world
    states: dict[str, KeyframeStates]  # "ekf", "graph", "batch"
    loops: tuple[LoopRow, ...]  # every candidate, with its decision and reason
    metrics: dict[str, Any]  # metrics.json; empty where the run was killed

    def __repr__(self) -> str:
        lines = [f"run in {self.folder}: {self._verdict}"]
        lines += [f"  {name}: {text}" for name, text in self._contents()]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in self._contents())
        title = f"<b>{escape(str(self.folder))}</b>: {escape(self._verdict)}"
        return f"<p>{title}</p><table>{rows}</table>{self._picture()}"

    @property
    def _verdict(self) -> str:
        verdict = self.metrics.get("verdict")
        return str(verdict.get("state", "no verdict")) if isinstance(verdict, dict) else "no verdict"

    def _contents(self) -> list[tuple[str, str]]:
        """Return what there is, a name and a text each."""
        accuracy = self.metrics.get("accuracy", {})
        rows = []
        for name, path in self.trajectories.items():
            error = accuracy.get(name, {}).get("ate_rmse_m")
            against = "" if error is None else f", ATE {error:.3f} m"
            rows.append(
                (f"trajectories['{name}']", f"{len(path)} poses, {path.duration_s:.1f} s, {path.path_m:.1f} m{against}")
            )
        rows += [(f"states['{name}']", f"{len(states)} keyframes") for name, states in self.states.items()]
        accepted = sum(row.decision == LoopDecision.ACCEPTED for row in self.loops)
        rows.append(("loops", f"{len(self.loops)} candidates, {accepted} accepted"))
        rows.append(("metrics", f"{len(self.metrics)} entries"))
        return rows

    def _picture(self) -> str:
        """Return all trajectories from above as an inline image; empty where there is none."""
        drawn = {name: path for name, path in self.trajectories.items() if len(path)}
        if not drawn:
            return ""
        from matplotlib.figure import Figure  # here and nowhere else: who only computes need not wait for it

        figure = Figure(figsize=(5.0, 4.0), layout="constrained")
        axes = figure.add_subplot()
        for name, path in drawn.items():
            x, y, _ = self._onto_truth(onto_map(path, name, self.metrics))[:: max(1, len(path) // _MAX_DRAWN)].T
            is_truth = name == "truth"
            axes.plot(x, y, label=name, color="black" if is_truth else None, linewidth=0.8 if is_truth else 1.4)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="x [m]", ylabel="y [m]")
        axes.legend()
        png = BytesIO()
        figure.savefig(png, format="png", dpi=100)
        data = base64.b64encode(png.getvalue()).decode()
        return f'<img alt="trajectories from above" src="data:image/png;base64,{data}">'

    def _onto_truth(self, path: Trajectory) -> Array:
        """Return positions [N, 3], moved onto the truth as the run's own errors were, where there is a truth."""
        truth = self.trajectories.get("truth")
        if truth is None or truth is path:
            return path.positions_m
        try:
            S = align(associate(path, truth), recorded_alignment(self.metrics))
        except VislamError:
            return path.positions_m  # too little in common: drawn as it is
        return path.transformed(S).positions_m


def load_run(folder: Path | str) -> LoadedRun:
    """Read what `vislam run`, `vislam live` or `vislam optimize RUN` left in a folder, as far as it came.

    Raises DataError, with the next step, for what is no run folder and for a file in it that is damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"{folder} is not a run folder; `vislam run SOURCE --out {folder}` makes one")
    trajectories = {path.stem.removeprefix("trajectory_"): path for path in sorted(folder.glob("trajectory_*.tum"))}
    if not trajectories and not (folder / "metrics.json").is_file():
        raise DataError(
            f"{folder} holds neither metrics.json nor a trajectory; give the --out of a run, or `vislam run --resume "
            f"{folder}` where one was killed"
        )
    loops = folder / "loops.csv"
    return LoadedRun(
        folder,
        {name: read_tum(path) for name, path in trajectories.items()},
        {path.stem.removeprefix("states_"): _read_states(path) for path in sorted(folder.glob("states_*.csv"))},
        tuple(read_loops(loops)) if loops.is_file() else (),
        read_metrics(folder),
    )


def _read_states(path: Path) -> KeyframeStates:
    ids, states = read_states_csv(path)

    def stacked(name: str, *shape: int) -> Array:
        return np.array([getattr(state, name) for state in states], dtype=np.float64).reshape(len(states), *shape)

    return KeyframeStates(
        ids,
        np.array([state.t_ns for state in states], dtype=np.int64),
        stacked("T_world_body", 4, 4),
        stacked("velocity_world_m_s", 3),
        stacked("gyro_bias_rad_s", 3),
        stacked("accel_bias_m_s2", 3),
        stacked("covariance", 15, 15),
    )
