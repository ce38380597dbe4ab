"""Known systems as commands of a plan: `--peer orbslam3`, run by an interpreter that has them.

Nothing of them is imported, linked or installed here; each has a driver in peer_drivers/, a script that its own Python
runs, and its own licence.
"""

import hashlib
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from vislam.core.errors import UsageError

DRIVERS = Path(__file__).resolve().parent / "peer_drivers"
VOCABULARY = "ORBSLAM3_VOCABULARY"
_PACE = "1"  # as it was recorded: their threads use what time they get
_ANSWER_S = 60.0  # an interpreter on a slow disk
_ASK = """
import importlib.metadata, importlib.util, sys
missing = [name for name in sys.argv[2:] if importlib.util.find_spec(name) is None]
try:
    print(importlib.metadata.version(sys.argv[1]), *missing)
except importlib.metadata.PackageNotFoundError:
    print("none")
"""


@dataclass(frozen=True, slots=True)
class Peer:
    """A system that vislam knows how to run where its user has installed it."""

    title: str
    package: str  # that brings it
    licence: str
    driver: str  # the script in peer_drivers/
    modes: tuple[str, ...]  # of the front end; with one and two cameras it uses the IMU


PEERS = {
    "orbslam3": Peer("ORB-SLAM3", "pyorbslam3", "GPL-3.0", "orbslam3_peer.py", ("mono", "stereo", "rgbd")),
    "basalt": Peer("Basalt", "depthai", "BSD-3, its package MIT", "basalt_peer.py", ("stereo",)),
}
_NEEDS = ("numpy", "cv2", "yaml")  # of every driver
_INSTALLED_AS = "numpy opencv-python-headless pyyaml"


def command_of(asked: str, variables: Mapping[str, str]) -> tuple[str, ...]:
    """Return the command (see `commands`) of a peer: NAME, or NAME=PYTHON with the interpreter that has its package.

    Without an interpreter it is the first `python3` or `python` in PATH that has it. The package's version is a word of
    the command, so that another one is another estimator. Raises UsageError saying what to install.
    """
    name, _, python = asked.partition("=")
    if name not in PEERS:
        raise UsageError(f"no peer '{name}'; there are: {', '.join(PEERS)}. Any other program is a `command` of a plan")
    peer = PEERS[name]
    interpreter, version = _interpreter(peer, name, python)
    driver = str(DRIVERS / peer.driver)
    start = (interpreter, driver, "{mode}", "{recording}", "{causal}")
    if name == "basalt":
        if shutil.which("g++") is None:
            raise UsageError("peer basalt: its driver compiles a shim of a page, and g++ is not in PATH; install g++")
        return (*start, "{work}", _PACE, f"{peer.package} {version}")
    return (*start, _vocabulary(variables, interpreter), _PACE, "{final}", f"{peer.package} {version}")


def driver_identity(word: str) -> str | None:
    """Return what a driver is, all that lies beside it included; None for a word of a command that is no driver."""
    if Path(word).parent != DRIVERS:
        return None
    digest = hashlib.sha256(Path(word).name.encode())
    for file in sorted(path for path in DRIVERS.iterdir() if path.suffix in (".py", ".cpp")):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


def _interpreter(peer: Peer, name: str, python: str) -> tuple[str, str]:
    """Return an interpreter with the package of a peer, and that package's version."""
    candidates = [python] if python else [found for each in ("python3", "python") if (found := shutil.which(each))]
    if python and shutil.which(python) is None:
        raise UsageError(f"peer {name}: there is no interpreter '{python}'{_how(peer, name)}")
    lacking = ""
    for candidate in candidates:
        version, *missing = _asked(candidate, peer)
        if version != "none" and not missing:
            return str(shutil.which(candidate)), version
        lacking = lacking or f"{candidate} has no {', '.join(missing) if version != 'none' else peer.package}"
    raise UsageError(f"peer {name}: {lacking or 'no Python in PATH'}{_how(peer, name)}")


def _asked(python: str, peer: Peer) -> list[str]:
    """Return the version of a peer's package in an interpreter, or "none", and the modules its driver lacks there."""
    try:
        said = subprocess.run(
            [python, "-c", _ASK, peer.package, *_NEEDS],
            capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=_ANSWER_S, check=True,
        ).stdout.split()  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return ["none"]
    return said or ["none"]


def _how(peer: Peer, name: str) -> str:
    return (
        f". vislam installs nothing of others; {peer.title} ({peer.licence}) comes with the package {peer.package}: "
        f"python3 -m venv peers && peers/bin/pip install {peer.package} {_INSTALLED_AS}, "
        f"then --peer {name}=peers/bin/python"
    )


def _vocabulary(variables: Mapping[str, str], python: str) -> str:
    path = variables.get(VOCABULARY, "")
    if not Path(path).is_file():
        raise UsageError(
            f"peer orbslam3: {VOCABULARY} names {f'no file: {path}' if path else 'no vocabulary'}; set it to the "
            "ORBvoc.txt of ORB-SLAM3's repository, or to one of your images: "
            f"{python} {DRIVERS / 'orbslam3_vocabulary.py'} OUT.txt IMAGES..."
        )
    return str(Path(path).resolve())
