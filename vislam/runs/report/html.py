"""Small pieces of HTML: every text from outside is escaped here."""

import base64
import html
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vislam.core.reading import read_bytes

_MAX_PICTURE_PX = 1600
_LETTERS_PX = 11.0  # the smallest that can be read on a phone
_KEEP_BYTES = 400_000  # a smaller PNG stays one
_MAX_PICTURE_BYTES = 64 * 2**20


@dataclass(frozen=True, slots=True)
class Cell:
    """A table cell; `mark` puts a coloured dot before the text."""

    text: str
    mark: str = ""
    kind: str = ""  # "text" (left) or "text long" (left, may wrap)


def stylesheet() -> str:
    """Return the style sheet of every page, to be embedded."""
    return Path(__file__).with_name("style.css").read_text(encoding="utf-8")


def day_colors() -> dict[str, str]:
    """Return the page's colours by day, #rrggbb, by their names in the style sheet."""
    return dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6})", stylesheet().partition("}")[0]))


def escape(value: object) -> str:
    """Return a value as text that is safe inside HTML."""
    return html.escape(str(value), quote=True)


def number(value: Any, digits: int = 3, unit: str = "") -> str:
    """Return a number with fixed decimals, or a dash when there is none."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    if digits == 0 and abs(value) < 1e15:
        return f"{round(value):,}".replace(",", "\u202f") + unit
    return f"{value:.{digits}f}{unit}"


def percent(value: Any, digits: int = 1) -> str:
    """Return a share as percent, or a dash."""
    return number(100.0 * value, digits, "\u202f%") if isinstance(value, int | float) else "–"


def table(head: Sequence[str], rows: Sequence[Sequence[str | Cell]], text_columns: Sequence[int] = (0,)) -> str:
    """Return a table; columns in `text_columns` are left-aligned, the others hold numbers. Empty ones are left out."""
    kept = [k for k in range(len(head)) if not rows or any(_text_of(row[k]) for row in rows)]
    head, rows = [head[k] for k in kept], [[row[k] for k in kept] for row in rows]
    text_columns = [kept.index(k) for k in text_columns if k in kept]

    def kind(column: int) -> str:
        return "text" if column in text_columns else ""

    title = "".join(f'<th class="{kind(k)}">{escape(name)}</th>' for k, name in enumerate(head))
    lines = []
    for row in rows:
        cells = []
        for k, value in enumerate(row):
            cell = value if isinstance(value, Cell) else Cell(value)
            dot = f'<i class="dot {escape(cell.mark)}"></i>' if cell.mark else ""
            cells.append(f'<td class="{cell.kind or kind(k)}">{dot}{escape(cell.text)}</td>')
        lines.append("".join(cells))
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="scroll"><table><thead><tr>{title}</tr></thead><tbody>{body}</tbody></table></div>'


def _text_of(value: str | Cell) -> str:
    return value.text if isinstance(value, Cell) else value


def tile(value: str, unit: str, label: str, kind: str = "plain") -> str:
    """Return one headline number."""
    small = f" <small>{escape(unit)}</small>" if unit else ""
    return f'<div class="tile {escape(kind)}"><b>{escape(value)}{small}</b><span>{escape(label)}</span></div>'


def card(*content: str, title: str = "", kind: str = "") -> str:
    """Return a framed block of finished HTML."""
    head = f"<h3>{escape(title)}</h3>" if title else ""
    return f'<div class="card {escape(kind)}">{head}{"".join(content)}</div>'


def grid(*cards: str) -> str:
    """Return blocks side by side where there is room."""
    present = [text for text in cards if text]
    return f'<div class="grid">{"".join(present)}</div>' if present else ""


def section(title: str, *content: str, kind: str = "") -> str:
    """Return a titled section, or nothing when it has no content."""
    body = "".join(content)
    classes = f' class="{escape(kind)}"' if kind else ""
    return f"<section{classes}><h2>{escape(title)}</h2>{body}</section>" if body else ""


def note(text: str) -> str:
    """Return a paragraph of small print."""
    return f'<p class="note">{escape(text)}</p>'


def bullets(lines: Sequence[str]) -> str:
    """Return a list."""
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def preformatted(text: object) -> str:
    """Return text in fixed width."""
    return f"<pre>{escape(text)}</pre>"


def drawn(svg: str) -> str:
    """Return a drawing that keeps its letters readable: where there is no room it is moved under the finger."""
    width = float(re.search(r'viewBox="0 0 ([\d.]+) ', svg)[1])  # type: ignore[index]  # each of ours has one
    letters = min(map(float, re.findall(r'font-size(?:="|: ?)([\d.]+)', svg)), default=width)
    least_px = math.ceil(_LETTERS_PX * width / letters)
    return f'<div class="scroll"><div class="wide" style="min-width: {least_px}px">{svg}</div></div>'


def folded(title: str, content: str) -> str:
    """Return finished HTML that opens on a click."""
    return f"<details><summary>{escape(title)}</summary><div>{content}</div></details>"


def picture(path: Path, caption: str, kind: str = "") -> str:
    """Return an image embedded as data, made smaller where it is large; a reason when it cannot be read.

    One of kind "plan" means the same on dark paper with its lightness turned round; others are as a camera saw them.
    """
    import cv2

    from vislam.core.encoded_image import decoded

    try:
        data = read_bytes(path, _MAX_PICTURE_BYTES)
    except OSError as error:
        return card(note(f"{path.name} cannot be read: {error.strerror or error}"))
    image = decoded(data, cv2.IMREAD_COLOR)
    if image is None:
        return card(note(f"{path.name} is not a readable image"))
    # written again: no byte of the file itself leaves, which may be a link to anything
    keeps = len(data) <= _KEEP_BYTES and path.suffix == ".png"
    scale = 1.0 if keeps else min(1.0, _MAX_PICTURE_PX / max(image.shape[:2]))
    size = (max(round(scale * image.shape[1]), 1), max(round(scale * image.shape[0]), 1))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale < 1.0 else image
    suffix, options = (".png", []) if keeps else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, 90])
    data, mime = cv2.imencode(suffix, small, options)[1].tobytes(), "image/png" if keeps else "image/jpeg"
    encoded = base64.b64encode(data).decode("ascii")
    return card(f'<img alt="{escape(caption)}" src="data:{mime};base64,{encoded}">', title=caption, kind=kind)
