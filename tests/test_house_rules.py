"""Rules of the house that a reader of the code may rely on; what breaks one today stands here with its reason."""

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

VISLAM = Path(__file__).resolve().parent.parent / "vislam"
MAX_TOP_NAMES = 24
MAX_SAME_NAME = 2
MAX_CLASS_LINES = 250
MOST_ARGUMENTS = 8

# classes beyond the limit and how long they may be, by tens: one state machine each, whose parts share most attributes
LONG_CLASSES = {
    "Estimator": 470,  # ladder of solvers around one iSAM2
    "FastPath": 260,
    "Front": 470,  # odometry and keyframes of one run
    "Gy85": 260,  # one board's clock, queue and faults
    "Initialiser": 430,
    "LiveRun": 270,
    "LoopSet": 410,  # decides about all loops of a run
    "Mapper": 280,  # every product of a map
    "MetricFrontEnd": 470,  # keyframe life of stereo and RGB-D
    "PoseGraph": 340,
    "Run": 320,
    "RunViewer": 290,
    "SerialBridge": 300,
    "SlidingWindow": 330,
    "Updater": 290,
    "_Inspector": 270,
}


def top_names() -> list[str]:
    paths = [path for path in VISLAM.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()]
    return sorted(path.stem for path in paths if path.name not in ("__init__.py", "__main__.py"))


def class_lines() -> dict[str, int]:
    """Lines of each class by name; of classes that share one, of the longest."""
    lines: dict[str, int] = {}
    for path in VISLAM.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                lines[node.name] = max(lines.get(node.name, 0), node.end_lineno - node.lineno + 1)
    return lines


def test_a_newcomer_meets_at_most_24_names_at_the_top():
    assert len(top_names()) <= MAX_TOP_NAMES, top_names()


def test_the_algorithm_stands_on_one_screen():
    assert len((VISLAM / "slam.py").read_text(encoding="utf-8").splitlines()) <= 120


def test_no_file_name_stands_for_three_things():
    counts = Counter(path.name for path in VISLAM.rglob("*.py") if path.name != "__init__.py")
    beyond = {name: count for name, count in counts.items() if count > MAX_SAME_NAME}
    assert beyond == {}, "give a file the name of what only it holds"


def test_no_class_is_longer_than_250_lines_and_longer_ones_do_not_grow():
    beyond = {name: lines for name, lines in class_lines().items() if lines > LONG_CLASSES.get(name, MAX_CLASS_LINES)}
    assert beyond == {}, "take a noun out of it"


def test_exceptions_that_nobody_needs_are_gone():
    lines = class_lines()
    assert [name for name in LONG_CLASSES if lines.get(name, 0) <= MAX_CLASS_LINES] == []


@pytest.mark.parametrize(
    "package", sorted(VISLAM.rglob("__init__.py")), ids=lambda p: str(p.parent.relative_to(VISLAM))
)
def test_the_first_line_of_every_package_says_its_noun(package):
    docstring = ast.get_docstring(ast.parse(package.read_text(encoding="utf-8"))) or ""
    first, _, rest = docstring.partition("\n")
    assert first.endswith("."), "one line that says what the package holds"
    assert not rest or rest.startswith("\n"), "the first line is a sentence of its own"


def kernels(source: str) -> Iterator[tuple[str, int]]:
    """Yield name and number of arguments of each function that numba compiles."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.FunctionDef):
            continue
        called = (d.func if isinstance(d, ast.Call) else d for d in node.decorator_list)
        names = {d.attr if isinstance(d, ast.Attribute) else getattr(d, "id", "") for d in called}
        if names & {"njit", "jit", "vectorize", "guvectorize", "cfunc"}:
            a = node.args
            yield node.name, len(a.posonlyargs) + len(a.args) + len(a.kwonlyargs)


def test_no_kernel_takes_more_than_eight_arguments():
    """More are named tuples of arrays: whoever calls with a dozen arrays in a row will swap two of them."""
    found = [(path, *kernel) for path in sorted(VISLAM.rglob("*.py")) for kernel in kernels(path.read_text())]
    assert len(found) > 100
    too_many = [f"{path.relative_to(VISLAM)}: {name}, {count}" for path, name, count in found if count > MOST_ARGUMENTS]
    assert not too_many, "kernels with too many arguments:\n" + "\n".join(too_many)


def test_arguments_of_kernels_are_counted():
    source = "@njit(cache=True)\ndef f(a, b, *, c): ...\n@numba.njit\ndef g(): ...\ndef h(a): ...\n"
    assert list(kernels(source)) == [("f", 3), ("g", 0)]
