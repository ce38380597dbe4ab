"""What is written down runs: every experiment and benchmark on its smallest input, every command and snippet quoted.

Scripts run in this process, one after the other, so that what they share is imported and compiled once.
"""

import argparse
import ast
import builtins
import re
import runpy
import shlex
import sys
import tomllib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import NoReturn

import pytest

from vislam.cli import run_verb
from vislam.cli.verbs import VERBS
from worlds.shared import shared

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(ROOT.glob("docs/**/*.md")),
    ROOT / "benchmarks/README.md",
]
PLAN = """
name = "starts"
title = "one start"
config = {"frontend.mode" = "mono", "loop.enabled" = false}
sequences = [{name = "laps", source = "points:laps", options = {rig = "mono", duration_s = 4.0, tracks = 60}}]
estimators = [{name = "tight", outputs = ["live", "graph"]}]
"""

# Arguments of the smallest run. {recording}: 3 s of a simulated depth camera with an IMU, {run}: a finished run of it,
# {cart}: 3 s of a cart over a floor, {graph}: a pose graph of 60 poses, {plan}: a plan of one start.
# What takes minutes whatever its input has --help: it is imported, and understands its options.
SMALLEST = {
    "experiments/aliasing.py": "--worlds panels-2.0 --losses 1 --length-m 7",
    "experiments/breaks.py": "--help",
    "experiments/cart_ride.py": "--help",
    "experiments/cart_wheels.py": "--seeds 0 --duration-s 12 --blind-at-s 4 --radii 'as told'",
    "experiments/cloud_smoothing.py": "--seconds 0.1",
    "experiments/depth_alone.py": "--source {recording} --dark 0.5 --begin 1 --length 2.5",
    "experiments/depth_in_map.py": "--source {recording} --split 1.5 --until 3 --dark-after 0.4",
    "experiments/drive_goals.py": "--help",
    "experiments/false_loops.py": "{graph} --loops 20 --groups 1",
    "experiments/free_voxels.py": "--run {run}",
    "experiments/gtsam_drives.py": "--out out",
    "experiments/label_noise.py": "--hz 0.2 --width 64",
    "experiments/loop_precision_recall.py": "--sources points:laps,duration_s=2,tracks=60 --seeds 1 --out out",
    "experiments/rigs.py": "--rigs stereo+1 --seeds 0 --seconds 2",
    "experiments/masks.py": "--shares 0.3 --seconds 2.3 --width 64",
    "experiments/moving_person.py": "--seconds 3 --width 64",
    "experiments/odometry_consistency.py": "{recording}",
    "experiments/planar_odometry.py": "--source {cart} --out out",
    "experiments/relocalisation.py": "--recording {recording} --out out",
    "experiments/robust_routes.py": "--simulated ring-once --false 0 --out routes.json",
    "experiments/seed_vocabulary.py": "--out words.npz --seeds 0 --duration-s 1",
    "experiments/self_calibration.py": "{recording} --out out",
    "experiments/spoilt_rgbd.py": "{recording} --cases 0",
    "experiments/starts.py": "--plan {plan} --count 1",
    "experiments/unregistered_depth.py": "--help",
    "experiments/up_without_imu.py": "--recording {recording}",
    "benchmarks/bag_reader.py": "--frames 5 --size 64 48 --rounds 1",
    "benchmarks/drawn_camera.py": "--width 64 --frames 1 --rounds 1 --moments 2",
    "benchmarks/ekf.py": "cost --rounds 1",
    "benchmarks/initialisation.py": "1 moving",
    "benchmarks/live_latency.py": "processes --seconds 3 --keyframes 20",
    "benchmarks/long_run.py": "chain --kilometres 0.05",
    "benchmarks/loop_index.py": "--sources {recording} --sizes 100 --depths 3",
    "benchmarks/loop_step.py": "{run}",
    "benchmarks/map_correction.py": "--help",
    "benchmarks/map_load.py": "20 50",
    "benchmarks/mesh_truth.py": "{run}",
    "benchmarks/monodepth.py": "--frames 0 --accuracy-frames 3",
    "benchmarks/pose_graph.py": "growth --shapes manhattan --sizes 100",
    "benchmarks/range_frames.py": "2",
    "benchmarks/sensor_cost.py": "--seconds 1 --rounds 1 --calls 5",
    "benchmarks/startup.py": "--help",
    "benchmarks/window.py": "compare --seconds 2 --seeds 1",
}
ELSEWHERE = {  # what runs the others, or what they need that is not here
    "experiments/bombs.py": "tests/test_fuzz.py",
    "experiments/failures.py": "tests/scripts/test_failures.py",
    "experiments/fuzz.py": "tests/test_fuzz.py",
    "experiments/readme_table.py": "tests/test_readme_table.py",
    "experiments/reference.py": ".ci/run",
    "benchmarks/attitude.py": "the package vqf",
    "benchmarks/cost.py": ".ci/run",
    "benchmarks/octomap.py": "the headers of OctoMap",
    "benchmarks/peers_cost.py": "ORB-SLAM3 and Basalt",
    "benchmarks/results.py": "tests/scripts/test_benchmark_results.py",
}
QUOTED = {"tum:PATH": "recording", "runs/mine": "run", "runs/desk": "run", "sphere2500.g2o": "graph"}  # in snippets


def make_inputs(folder: Path) -> None:
    (folder / "plan.toml").write_text(PLAN)
    size = "--duration-s 3 --camera-hz 10 --exposure-s 0 --image-width-px 160"
    for command in (
        f"simulate handheld-room --rig rgbd {size} --out {folder}/recording",
        f"run {folder}/recording --out {folder}/run --view.no-enabled --map.products cloud octomap mesh grid drive",
        f"simulate cart-drive {size} --out {folder}/cart",
        f"simulate --graph manhattan --poses 60 --out {folder}/graph.g2o",
    ):
        assert run_verb(shlex.split(command)) == 0, command


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = shared(tmp_path_factory, "written-down", make_inputs)
    return {path.stem: path for path in folder.iterdir()}


def test_every_script_has_its_smallest_input() -> None:
    scripts = [*ROOT.glob("experiments/*.py"), *ROOT.glob("benchmarks/*.py")]
    assert sorted({**SMALLEST, **ELSEWHERE}) == sorted(path.relative_to(ROOT).as_posix() for path in scripts)


@pytest.mark.slow
@pytest.mark.parametrize("script", SMALLEST)
def test_a_script_runs_on_its_smallest_input(
    script: str, inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    path = ROOT / script
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(path.parent))
    monkeypatch.setattr(sys, "argv", [str(path), *shlex.split(SMALLEST[script].format(**inputs))])
    try:
        runpy.run_path(str(path), run_name="__main__")
    except SystemExit as end:
        assert end.code in (None, 0), capsys.readouterr()
    assert capsys.readouterr().out.strip()


class Parsed(BaseException):
    """The arguments were understood; nothing else is wanted."""


def blocks(page: Path, languages: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Yield where it begins, and its text, of each block of code: fenced, or indented (language "")."""
    text = page.read_text(encoding="utf-8")
    fenced = list(re.finditer(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL))
    for match in fenced:
        if match[1] in languages:
            yield f"{page.relative_to(ROOT)}:{text.count(chr(10), 0, match.start(2)) + 1}", match[2]
    if "" in languages:
        for match in fenced:  # what is left are lines of the page itself
            text = text.replace(match[0], "\n" * match[0].count("\n"), 1)
        for match in re.finditer(r"(?:^    .*\n)+", text, re.MULTILINE):
            yield f"{page.relative_to(ROOT)}:{text.count(chr(10), 0, match.start()) + 1}", match[0]


def commands(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield where it is, and its words, of each command for a shell that a page quotes."""
    for where, text in blocks(page, ("sh", "")):
        for line in text.replace("\\\n", " ").splitlines():
            try:
                words = shlex.split(line, comments=True)
            except ValueError:  # an apostrophe: prose, or output of a command
                continue
            for command in re.split(r"(?:^| )(?:;|&&|\|\|?|&)(?: |$)", "\0".join(words).replace("\0", " \0")):
                parts = [part.strip() for part in command.split("\0") if part.strip()]
                while parts and re.fullmatch(r"[A-Z_]+=.*", parts[0]):
                    parts = parts[1:]
                if parts:
                    yield where, parts


def only_parse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have verbs and scripts stop once their arguments are understood."""

    def stopping(parse):
        def parsed(*arguments: object, **named: object) -> NoReturn:
            parse(*arguments, **named)
            raise Parsed

        return parsed

    for verb in VERBS:
        module = import_module(f"vislam.cli.verbs.{verb}")
        if hasattr(module, "parse"):
            monkeypatch.setattr(module, "parse", stopping(module.parse))
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stopping(argparse.ArgumentParser.parse_args))


def make_ready(arguments: list[str]) -> None:
    """Make what a reader has by then: files of settings, and runs that are joined."""
    for word in arguments:
        if word.startswith("runs/") and arguments[0] == "optimize":
            Path(word).mkdir(parents=True, exist_ok=True)
        elif word.endswith(".toml") and not Path(word).is_absolute():
            Path(word).parent.mkdir(parents=True, exist_ok=True)
            Path(word).touch()


def fault(words: list[str], monkeypatch: pytest.MonkeyPatch) -> object:
    """Return what is wrong with a command, None where nothing is; one of another program is taken as it is."""
    program, *arguments = words[1:] if words[:2] == ["./run", "vislam"] else words
    make_ready(arguments)
    try:
        if Path(program).name == "vislam":
            return run_verb(arguments) or None
        if Path(program).name == "python" and arguments[0].endswith(".py"):
            monkeypatch.setattr(sys, "argv", arguments)
            monkeypatch.syspath_prepend(str((ROOT / arguments[0]).parent))
            runpy.run_path(str(ROOT / arguments[0]), run_name="__main__")
    except Parsed:
        return None
    except SystemExit as end:
        return end.code or None
    is_known = True
    if program == "./run":
        is_known = f"\n{arguments[0]})" in (ROOT / "run").read_text(encoding="utf-8")
    elif program == "pip" and arguments[1].startswith((".", "vislam")):  # no index has the name
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
            "optional-dependencies"
        ]
        is_known = arguments[1].startswith(".[") and set(re.findall(r"[\w-]+", arguments[1])) <= set(extras)
    return None if is_known else "there is no such thing"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_the_commands_of_a_page_are_understood(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    only_parse(monkeypatch)
    wrong = []
    for where, words in commands(page):
        if any(word.startswith("[") for word in words):  # a synopsis
            continue
        whole = [word for word in words if word != "..."]
        answer = fault(whole if whole == words else [*whole, "--out", "OUT"], monkeypatch)
        if answer is not None:
            wrong.append((where, shlex.join(words), answer, capsys.readouterr().err))
    assert wrong == []


def free_names(tree: ast.Module) -> set[str]:
    """Return the names that a snippet uses and does not define."""
    names = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
    made = {node.id for node in names if not isinstance(node.ctx, ast.Load)} | set(dir(builtins))
    made |= {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef | ast.FunctionDef)}
    made |= {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    imports = (node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom))
    made |= {alias.asname or alias.name.partition(".")[0] for node in imports for alias in node.names}
    return {node.id for node in names} - made


def with_inputs(text: str, inputs: dict[str, Path], out: Path) -> str:
    """Return a snippet with the recordings and runs of these tests in place of the reader's; new runs go to `out`."""
    text = re.sub(r'\bout="[^"]*"', lambda _: f"out={str(out)!r}", text)
    return re.sub("|".join(QUOTED), lambda quoted: str(inputs[QUOTED[quoted[0]]]), text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_the_snippets_of_a_page_run(
    page: Path, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole ones run, on the recording, run and graph of these tests; of parts the imports do."""
    monkeypatch.chdir(tmp_path)
    for number, (where, text) in enumerate(blocks(page, ("python",))):
        tree = ast.parse(text, where)
        imports = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
        if imports and not free_names(tree):
            inputs = request.getfixturevalue("inputs")
            exec(compile(with_inputs(text, inputs, tmp_path / f"out{number}"), where, "exec"), {"__name__": "snippet"})
        else:
            exec(compile(ast.Module(imports, []), where, "exec"), {})
