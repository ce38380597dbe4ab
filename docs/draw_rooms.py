"""Draw the house from its code: `docs/images/rooms.svg` (layers and imports) and `values.svg` (who makes what).

Layers are those that import-linter enforces (pyproject.toml); imports and values are found in the source, so the
pictures cannot say what the code does not.

    .venv/bin/python docs/draw_rooms.py
"""

import ast
import tomllib
from collections import defaultdict
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parent.parent
PACKAGE, IMAGES = ROOT / "vislam", ROOT / "docs" / "images"
VALUES = (
    "ImuSample", "MagSample", "Frame", "Observations", "VoMeasurement", "Keyframe", "KeyframePacket", "ImuSpan",
    "LoopCandidate", "LoopEdge", "NavState", "GraphUpdate", "Trajectory",
)  # fmt: skip
INK, PAPER, BAND, GRID, ACCENT = "#24292f", "#ffffff", "#f0f3f6", "#d8dee4", "#2f6f9f"


def layers() -> list[list[str]]:
    """Return the rooms from top to bottom, those of a layer together."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = (c for c in settings["tool"]["importlinter"]["contracts"] if c["type"] == "layers")
    return [[room.strip().removeprefix("vislam.") for room in row.split("|")] for row in contract["layers"]]


def room_of(path: Path) -> str:
    """Return the room that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def is_type_checking(node: ast.AST) -> bool:
    """Whether a statement is there for the type checker alone."""
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def statements(tree: ast.AST) -> list[ast.AST]:
    """Return all nodes but those under `if TYPE_CHECKING`."""
    found, waiting = [], [tree]
    while waiting:
        node = waiting.pop()
        found.append(node)
        waiting += [child for child in ast.iter_child_nodes(node) if not is_type_checking(child)]
    return found


def read() -> tuple[dict[tuple[str, str], int], dict[str, set[str]], dict[str, set[str]]]:
    """Return imports between rooms with their number, and the rooms that make and that use each value."""
    imports: dict[tuple[str, str], int] = defaultdict(int)
    makes, uses = defaultdict(set), defaultdict(set)
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.parent == PACKAGE and path.name.startswith("__"):
            continue  # the front door belongs to no room
        room = room_of(path)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in statements(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vislam."):
                other = node.module.split(".")[1]
                imports[room, other] += other != room
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in VALUES:
                makes[node.func.id].add(room)
            if isinstance(node, ast.Name) and node.id in VALUES:
                uses[node.id].add(room)
    return imports, makes, uses


def first_line(room: str) -> str:
    """Return what a room says of itself."""
    path = PACKAGE / f"{room}.py"
    tree = ast.parse((path if path.is_file() else PACKAGE / room / "__init__.py").read_text(encoding="utf-8"))
    return (ast.get_docstring(tree) or "").split("\n")[0].replace("`", "").rstrip(".:")


def draw_rooms(imports: dict[tuple[str, str], int]) -> Figure:
    """Draw a row per room, banded by layers: a dot for each room that it imports from, and what it is.

    No dot lies left of the diagonal or within a band: that is what the layers forbid.
    """
    rows = layers()
    rooms = [room for row in rows for room in row]
    at = {room: i for i, room in enumerate(rooms)}
    n = len(rooms)
    figure = Figure(figsize=(0.3 * n + 7.5, 0.3 * n + 1.3), layout="constrained")
    axes = figure.add_subplot()
    top = 0
    for k, row in enumerate(rows):
        axes.axhspan(top - 0.5, top + len(row) - 0.5, color=BAND if k % 2 else PAPER, zorder=0)
        top += len(row)
    for (room, other), count in imports.items():
        if count and room in at:
            axes.scatter(at[other], at[room], s=18 * np.sqrt(count), color=ACCENT, zorder=3)
    axes.plot([0, n - 1], [0, n - 1], color=GRID, linewidth=1.0, zorder=1)
    for room, y in at.items():
        axes.text(n, y, first_line(room), va="center", color=INK, fontsize=8.5)
    axes.set_xticks(range(n), rooms, rotation=60, ha="left", rotation_mode="anchor")
    axes.set_yticks(range(n), rooms)
    axes.set(xlim=(-0.7, n + 28), ylim=(n - 0.5, -0.5))
    finish(axes)
    return figure


def finish(axes: Axes) -> None:
    """Put the names on top and take the frame away."""
    axes.xaxis.tick_top()
    axes.tick_params(length=0, labelcolor=INK)
    axes.spines[:].set_visible(False)


def draw_values(makes: dict[str, set[str]], uses: dict[str, set[str]]) -> Figure:
    """Draw a table of values against rooms: a full dot where a value is made, a ring where it is used."""
    named = set().union(*makes.values(), *uses.values())
    rooms = [room for row in reversed(layers()) for room in row if room in named]
    figure = Figure(figsize=(0.42 * len(rooms) + 2.2, 0.36 * len(VALUES) + 1.5), layout="constrained")
    axes = figure.add_subplot()
    for y, value in enumerate(VALUES):
        for x, room in enumerate(rooms):
            if room in makes[value]:
                axes.scatter(x, y, s=55, color=ACCENT, zorder=3)
            elif room in uses[value]:
                axes.scatter(x, y, s=55, facecolor=PAPER, edgecolor=ACCENT, zorder=3)
    axes.set_xticks(range(len(rooms)), rooms, rotation=60, ha="left", rotation_mode="anchor")
    axes.set_yticks(range(len(VALUES)), VALUES)
    axes.invert_yaxis()
    axes.grid(color=GRID, linewidth=0.6)
    finish(axes)
    return figure


def main() -> None:
    """Write both pictures."""
    imports, makes, uses = read()
    mpl.rcParams.update({"svg.hashsalt": "vislam", "svg.fonttype": "none", "font.family": "sans-serif"})
    for name, figure in (("rooms", draw_rooms(imports)), ("values", draw_values(makes, uses))):
        figure.savefig(IMAGES / f"{name}.svg", metadata={"Date": None}, facecolor=PAPER)


if __name__ == "__main__":
    main()
