"""Estimators that are not vislam's: a class with two doors and an answer, on the pipeline's measurements."""

import hashlib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from vislam.config import Config
from vislam.core.camera import Rig
from vislam.core.errors import DataError, UsageError, VislamError
from vislam.core.files import write_json
from vislam.core.geometry import are_rotations
from vislam.core.imu_noise import ImuNoise
from vislam.core.kinds import Kinds, lacking
from vislam.core.messages import Array, Frame, ImuSample, MagSample
from vislam.core.progress import Progress, silent
from vislam.core.recording import Recording
from vislam.core.trajectory import Trajectory
from vislam.experiment.stated import checked, write_stated
from vislam.factors import nearest_rigid
from vislam.frontend import mode_for
from vislam.runs.cost import CostMeter
from vislam.runs.drive import imu_noise
from vislam.runs.sources import shaken
from vislam.trajectory import write_tum

_DOORS = ("inertial", "frame", "answer")
ESTIMATORS = Kinds[type[Any]]("vislam.estimators", {}, lacking(*_DOORS))  # by name, of installed packages
_RIGID = 1e-3  # largest entry of R^T R - 1; estimators round


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """What an estimator may know before the first measurement."""

    rig: Rig
    imu_noise: ImuNoise | None  # None: no IMU, or it is off
    gravity_m_s2: float  # differs by 1e-9 between the members of an ensemble
    mode: str  # "mono", "stereo", "rgbd" or "planar": how the pipeline would use the rig
    seed: int  # of every random choice


class Program(Protocol):
    """What the class has; it is made by `Class(setup, **options)`, once for each job, in a process of its own.

    World is any frame: it is aligned as the pipeline's is, by yaw and position with an IMU, else by SE(3), one camera
    without an IMU by Sim(3). A method `magnetic(sample: MagSample)` is called where there is one and a magnetometer.
    """

    def inertial(self, sample: ImuSample) -> None:
        """Take an inertial sample; all come in the order of time, together with the frames."""
        ...

    def frame(self, frame: Frame) -> Array | tuple[Array, Array] | None:
        """Take a frame; return T_world_body [4, 4] at its time as it is known now, None where it is not.

        Or (T_world_body, covariance [6, 6]): of rotation on the body side [rad] and position in world axes [m].
        """
        ...

    def answer(self) -> Trajectory | tuple[Trajectory, Array]:
        """Return the trajectory as it is known after all measurements.

        Or (trajectory, covariances [N, 6, 6]), NaN all over where a pose has none.
        """
        ...


class ProgramError(VislamError):
    """An estimator that is not vislam's failed, or answered what is no pose."""


def load(program: str) -> type[Any]:
    """Return the class, see `Program`, of `FILE.py`, `FILE.py:CLASS`, `PACKAGE.MODULE` or `PACKAGE.MODULE:CLASS`.

    Without a name it is the only class there with all doors. A name that a package brings by an entry point will do as
    well. Raises UsageError where there is none.
    """
    if program.isidentifier() and program in ESTIMATORS:
        return ESTIMATORS[program]
    place, _, name = program.rpartition(":") if ":" in program else (program, "", "")
    module = _module(place, program)
    own = [cls for _, cls in inspect.getmembers(module, inspect.isclass) if cls.__module__ == module.__name__]
    if name:
        chosen = getattr(module, name, None)
        if not inspect.isclass(chosen):
            raise UsageError(f"estimator {program}: no class '{name}'; there are: {_names(own)}")
        if missing := [door for door in _DOORS if not callable(getattr(chosen, door, None))]:
            raise UsageError(
                f"estimator {program}: '{name}' has no method '{missing[0]}'; it needs {', '.join(_DOORS)}"
            )
        return chosen
    fitting = [cls for cls in own if all(callable(getattr(cls, door, None)) for door in _DOORS)]
    if len(fitting) != 1:
        raise UsageError(
            f"estimator {program}: one class with the methods {', '.join(_DOORS)} is wanted, and {len(fitting)} of "
            f"{_names(own)} have them; name it as {place}:CLASS"
        )
    return fitting[0]


def identity(program: str) -> str:
    """Return what a program is: its class, and the SHA-256 of its file or, in a package, of all that package's."""
    cls = load(program)
    file = Path(inspect.getfile(cls))
    top = sys.modules[cls.__module__.partition(".")[0]]
    folders = [] if _is_file(program) else [Path(folder) for folder in getattr(top, "__path__", [])]
    digest = hashlib.sha256()
    for source in sorted(source for folder in folders for source in folder.rglob("*.py")) or [file]:
        digest.update(source.name.encode() + source.read_bytes())
    return f"{cls.__qualname__} {digest.hexdigest()}"


def run_program(
    program: str, options: Mapping[str, Any], recording: Recording, config: Config, out: Path,
    progress: Progress = silent,
) -> dict[str, Any]:  # fmt: skip
    """Run an estimator over a recording, write its trajectories and the truth into `out`, and return its metrics.

    Raises:
        UsageError: there is no such class, or it takes no such options.
        ProgramError: it raised, or answered what is no pose; what was known before is written.
        DataError: the recording cannot be used.
    """
    run = _Run(program, options, shaken(recording, config.imu.vibration), config)
    try:
        run.feed(progress)
    finally:
        metrics = run.write(out)
    return metrics


def setup_of(recording: Recording, config: Config) -> Setup:
    """Return what an estimator may know before the first measurement."""
    rig, noise = recording.rig, imu_noise(config.imu, recording.imu_noise)
    return Setup(rig, noise, config.machine.gravity_m_s2, mode_for(config.frontend, rig), config.seed)


def write_metrics(out: Path, name: str, setup: Setup, t_ns: Sequence[int], cost: Mapping[str, Any]) -> dict[str, Any]:
    """Write what of a run's metrics an estimator by others has, too: of frames at `t_ns`, at a cost (`CostMeter`)."""
    metrics = {
        "mode": setup.mode,
        "has_imu": setup.imu_noise is not None,
        "frames": len(t_ns),
        "keyframes": None,
        "duration_s": (t_ns[-1] - t_ns[0]) * 1e-9 if t_ns else 0.0,
        "loops": {"accepted": None},
        "initialisation": {"status": name, "t_s": cost["first_pose_s"], "scale_sigma": None},
        "timing_ms": {},
        "cost": cost,
        "nis": {},
        "doubts": [],
        "warnings": [],
    }
    write_json(out / "metrics.json", metrics)
    return metrics


class _Run:
    """One estimator over one recording."""

    def __init__(self, program: str, options: Mapping[str, Any], recording: Recording, config: Config) -> None:
        self._setup = setup_of(recording, config)
        self._program, self._recording, self._cost = program, recording, CostMeter()
        self._t_ns: list[int] = []  # of all frames
        self._known: list[tuple[int, Array]] = []
        self._final: Trajectory | None = None
        self._stated: dict[str, dict[int, Array]] = {"causal": {}, "final": {}}  # covariances by time
        cls = load(program)
        make: Callable[..., Any] = cls
        try:
            inspect.signature(cls).bind(self._setup, **options)
        except TypeError as error:
            raise UsageError(f"estimator {program}: {cls.__name__}(setup, **options): {error}") from error
        self._estimator = self._asked(partial(make, self._setup, **options), "at the start")

    def feed(self, progress: Progress) -> None:
        """Give everything to the estimator, and ask for its answer."""
        magnetic = getattr(self._estimator, "magnetic", None)
        for value in self._recording.events():
            if isinstance(value, Frame):
                self._see(value)
                progress(len(self._t_ns), self._recording.frame_count, "")
            elif isinstance(value, MagSample):
                if magnetic is not None:
                    self._asked(partial(magnetic, value), f"magnetometer sample at {value.t_ns} ns")
            elif self._setup.imu_noise is not None:
                self._asked(partial(self._estimator.inertial, value), f"inertial sample at {value.t_ns} ns")
        answer = self._asked(self._estimator.answer, "in the end")
        self._final = self._final_of(answer)

    def write(self, out: Path) -> dict[str, Any]:
        """Write what is known; return the metrics, those of the pipeline that an estimator by others has, too."""
        truth = self._recording.truth()
        if truth is not None:
            write_tum(truth, out / "trajectory_truth.tum")
        if self._known:
            t_ns, T = zip(*self._known, strict=True)
            self._write(out, "causal", Trajectory(np.array(t_ns), np.array(T)))
        if self._final is not None:
            self._write(out, "final", self._final)
        return write_metrics(out, self._program, self._setup, self._t_ns, self._cost.entry({}))

    def _write(self, out: Path, name: str, trajectory: Trajectory) -> None:
        write_tum(trajectory, out / f"trajectory_{name}.tum")
        if stated := self._stated[name]:
            known = np.isin(trajectory.t_ns, list(stated))
            t_ns, poses = trajectory.t_ns[known], trajectory.T_world_body[known]
            write_stated(out / f"states_{name}.csv", t_ns, poses, [stated[t] for t in t_ns.tolist()])

    def _see(self, frame: Frame) -> None:
        where = f"frame {len(self._t_ns)} at {frame.t_ns} ns"
        answered = self._asked(partial(self._estimator.frame, frame), where)
        self._t_ns.append(frame.t_ns)
        if isinstance(answered, tuple) and len(answered) == 2:
            answered, given = answered
            if given is not None:
                self._stated["causal"][frame.t_ns] = self._covariance(given, where)
        if answered is not None:
            self._known.append((frame.t_ns, self._pose(answered, where)))
        self._cost.count(frame.t_ns, answered is not None)

    def _asked(self, ask: Callable[[], Any], where: str) -> Any:
        """Return what an estimator answers; whatever it raises is reported with its name and place."""
        try:
            return ask()
        except Exception as error:
            raise ProgramError(f"{self._program}: {where}: {type(error).__name__}: {error}") from error

    def _final_of(self, answer: Any) -> Trajectory:
        """Return the trajectory of an answer, and keep the covariances that came with it."""
        given = None
        if isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[0], Trajectory):
            answer, given = answer
        if not isinstance(answer, Trajectory):
            raise ProgramError(f"{self._program}: answer() gave {type(answer).__name__}; a Trajectory is wanted")
        if given is None:
            return answer
        try:
            covariances = np.array(given, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ProgramError(f"{self._program}: answer(): {error}; covariances [N, 6, 6] are wanted") from error
        if len(covariances) != len(answer):
            raise ProgramError(f"{self._program}: answer() gave {len(answer)} poses and {len(covariances)} covariances")
        for t_ns, P in zip(answer.t_ns.tolist(), covariances, strict=True):
            if not np.isnan(P).all():
                self._stated["final"][t_ns] = self._covariance(P, f"answer(), pose at {t_ns} ns")
        return answer

    def _covariance(self, given: Any, where: str) -> Array:
        try:
            return checked(given, where)
        except (TypeError, ValueError, DataError) as error:
            raise ProgramError(f"{self._program}: {where}: {str(error).removeprefix(f'{where}: ')}") from error

    def _pose(self, answered: Any, where: str) -> Array:
        try:
            T = np.array(answered, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ProgramError(f"{self._program}: {where}: {error}; a pose [4, 4] is wanted") from error
        if T.shape != (4, 4):
            raise ProgramError(f"{self._program}: {where}: a pose is an array [4, 4], not {[*T.shape]}")
        if not np.isfinite(T).all() or not are_rotations(T[:3, :3], _RIGID):
            raise ProgramError(f"{self._program}: {where}: the pose is no rigid motion: {T.round(3).tolist()}")
        return nearest_rigid(T)


def _is_file(program: str) -> bool:
    return program.partition(":")[0].endswith(".py")


def _names(classes: list[type]) -> str:
    return ", ".join(cls.__name__ for cls in classes) or "none"


@contextmanager
def _beside(folder: Path) -> Iterator[None]:
    """Inside, what lies in a folder can be imported, as for a script there."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))


def _module(place: str, program: str) -> ModuleType:
    if not _is_file(program):
        try:
            return importlib.import_module(place)
        except Exception as error:
            raise UsageError(f"estimator {program}: {type(error).__name__}: {error}") from error
    path = Path(place).resolve()
    if not path.is_file():
        raise UsageError(f"estimator {program}: there is no file {path}")
    name = f"estimator_{hashlib.sha256(str(path).encode() + path.read_bytes()).hexdigest()[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    found = importlib.util.spec_from_file_location(name, path)
    assert found is not None and found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        with _beside(path.parent):
            found.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise UsageError(f"estimator {program}: {type(error).__name__}: {error}") from error
    return module
