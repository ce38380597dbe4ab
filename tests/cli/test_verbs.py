"""Every verb of the command line is there, explains itself, and is not imported before it is asked for."""

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from vislam.cli import run_verb
from vislam.cli.verbs import VERBS, terminal
from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.brief import said_of
from vislam.cli.verbs.completion import known_options, script
from vislam.cli.verbs.live import PageOptions, ResumeOptions, opened
from vislam.config.ranges import settings_of
from vislam.core.errors import UsageError


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_explains_itself(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = run_verb([verb, "--help"])
    except SystemExit as end:
        code = end.code
    assert code == 0
    assert f"vislam {verb}" in capsys.readouterr().out


def test_help_lists_every_verb_and_imports_nothing_heavy() -> None:
    script = "import sys; from vislam.cli import run_verb; run_verb(['--help']); print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert all(f"  {name} " in done.stdout for name in VERBS)
    assert not {"numpy", "tyro", "rich", "cv2", "numba", "gtsam", "vislam.config"} & set(done.stderr.split())


def test_an_unknown_verb_is_a_wrong_usage_that_names_the_verbs(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb(["fly"]) == 2
    assert "no verb 'fly'; there are: demo, run" in capsys.readouterr().err


def help_of(verb: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as end:
        run_verb([verb, "--help"])
    assert end.value.code == 0
    return capsys.readouterr().out


BRIEF = ("run", "live", "doctor", "record", "map", "drive")


@pytest.mark.parametrize("verb", BRIEF)
def test_the_short_help_fits_two_screens_and_explains_whatever_it_lists(
    verb: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    lines = help_of(verb, capsys).splitlines()
    assert len(lines) <= 2 * 45
    assert max(map(len, lines)) <= 100
    module = import_module(f"vislam.cli.verbs.{verb}")
    settings = {".".join(setting.path): setting for cls in module.OPTIONS for setting in settings_of(cls)}
    assert all(said_of(settings[name]) for name in module.BRIEF.often)
    assert all(said_of(setting) for setting in settings.values() if setting.owner in module.OPTIONS)


def test_every_example_of_the_short_help_names_existing_options(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in BRIEF:
        known = known_options(verb)[0]
        for example in import_module(f"vislam.cli.verbs.{verb}").BRIEF.examples:
            assert {word for word in example.split() if word.startswith("--")} <= {*known}


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("loops run --query 1 2", "Unrecognized options: --query, 1, 2"),
        ("run x", "Missing from vislam run: --out PATH Folder to make for everything that the run leaves (required)"),
        ("live --out", "Missing value for argument '--out'. Expected 1 values"),
        ("map x --query 1 2 b", "--query: no type matching {None}|{FLOAT FLOAT FLOAT} could be instantiated from"),
        (
            "calibrate camera --model z a",
            "invalid choice 'z' for argument '--model'. Expected one of ('auto', 'radtan',",
        ),
    ],
)
def test_wrong_arguments_are_one_line(typed: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb(typed.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    verb = " ".join(typed.split()[: 2 if typed.startswith("calibrate") else 1])
    assert said in line and line.endswith(f"; vislam {verb} --help has the options") and "\u2502" not in line


def test_the_long_help_has_all_settings(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        run_verb(["run", "--help-all"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    assert "--graph.freeze-after" in said and "--window.rho-sigma-1-m" in said


def test_the_version_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb(["--version"]) == 0
    assert capsys.readouterr().out.startswith("vislam ")


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("pose", {"posegraph"}),
        ("run --graph.coup", {"--graph.coupling"}),
        ("run --graph.coupling t", {"tight"}),
        ("calibrate camera-", {"camera-imu"}),
        ("completion z", {"zsh"}),
    ],
)
def test_bash_completes_what_was_begun(typed: str, offered: set[str]) -> None:
    words = ["vislam", *typed.split()]
    call = f"COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; _vislam; echo ${{COMPREPLY[@]}}"
    done = subprocess.run(["bash", "-c", f"{script()}\n{call}"], capture_output=True, text=True, check=True)
    assert {*done.stdout.split()} == offered


@pytest.mark.parametrize(
    ("given", "page"),
    [
        (["--seconds", "1"], PageOptions()),
        (["--web"], PageOptions(())),
        (["--web", "--seconds", "1"], PageOptions(())),
        (["--seconds", "1", "--web", ":9000"], PageOptions((":9000",))),
        (["--web=0.0.0.0:1", "--web-waits"], PageOptions(("0.0.0.0:1",), True)),
        (["--web", "--web-host", "a.b", "--web-host", "c"], PageOptions((), False, ("a.b", "c"))),
    ],
)
def test_options_of_the_page_are_understood(given, page) -> None:
    assert parse(ResumeOptions, given, "live").page == page


@pytest.mark.parametrize(
    "page",
    [
        PageOptions(None, True),
        PageOptions(web_host=("a",)),
        PageOptions((), False, ("http://a",)),
        PageOptions(("a:1", "b:2")),
    ],
)
def test_options_of_the_page_that_make_no_sense_are_refused(page, tmp_path) -> None:
    with pytest.raises(UsageError), opened(page, "cart", tmp_path):
        pass


def test_a_pose_graph_given_to_optimize_is_handed_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "one.g2o"
    path.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n", encoding="utf-8")
    answers = []
    for verb in ("posegraph", "optimize"):
        assert run_verb([verb, str(path), "--out", str(tmp_path / verb), "--no-report", "--no-certify", "--json"]) == 0
        answers.append(json.loads(capsys.readouterr().out))
    assert answers[0]["poses"] == answers[1]["poses"] == 2


def test_a_run_without_a_camera_is_evaluated_and_optimised_and_what_needs_images_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sensors, out = tmp_path / "cart.toml", str(tmp_path / "run")
    sensors.write_text('[sensors.wheels]\nkind = "wheels"\nsimulated_hz = 20.0\n')
    source = "points:cart-drive,rig=none,duration_s=8"
    assert run_verb(["run", source, "--sensors.file", str(sensors), "--out", out]) == 0
    assert run_verb(["optimize", out, "--no-report"]) == 0
    assert run_verb(["eval", out]) == 0
    capsys.readouterr()
    for asked in (["eval", out, "--loops"], ["map", out]):
        assert run_verb(asked) == 3
        said = capsys.readouterr().err
        assert "camera" in said and "Traceback" not in said


def test_progress_of_what_has_no_known_end_shows_what_is_done(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "_EVERY_S", 0.0)
    for total, shown in ((0, "cart: 850 frames  blind"), (900, "cart: 850/900 frames  blind")):
        with terminal.progress_bar("cart") as show:
            show(850, total, "blind")
        assert shown in capsys.readouterr().err
