"""What labels mean: the ids in label images, their names and colours."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.reading import read_toml

UNLABELLED = 0  # the id without a meaning
MAX_ID = 65535
FILE_NAME = "labels.toml"
_MAX_CLASSES = 4096
_MAX_NAME = 100  # letters
_GOLDEN = 0.618033988749895  # neighbouring ids get hues far apart

Color = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class LabelClass:
    """One kind of thing."""

    id: int
    name: str
    color: Color  # RGB


class LabelClasses:
    """The classes of a set of label images, by id; ids without a name of their own are called by their number."""

    def __init__(self, classes: Mapping[int, LabelClass] | None = None) -> None:
        self._classes = dict(sorted((classes or {}).items()))

    def __len__(self) -> int:
        return len(self._classes)

    def __getitem__(self, class_id: int) -> LabelClass:
        """Return the class of an id."""
        return self._classes.get(class_id) or LabelClass(class_id, f"label {class_id}", usual_color(class_id))

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which ids [65536] have a name; all of them where no name was given."""
        known = np.full(MAX_ID + 1, not self._classes)
        known[[*self._classes, UNLABELLED]] = True
        return known

    @classmethod
    def read(cls, path: Path) -> LabelClasses:
        """Return the classes of a TOML file of `ID = "name"`, or `ID = { name = "name", color = [R, G, B] }`.

        Raises DataError when it cannot be used.
        """
        try:
            data = read_toml(path)
        except FileNotFoundError as error:
            raise DataError(
                f'{path} is not there; write what the ids in the label images mean, a line each, such as 3 = "door"'
            ) from error
        except OSError as error:
            raise DataError(f"{path} cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise DataError(f"{path} is no TOML: {error}") from error
        return cls.of(data, str(path))

    @classmethod
    def of(cls, data: Any, where: str) -> LabelClasses:
        """Return the classes of plain data, see `read` and `data`; raises DataError that names `where`."""
        if not isinstance(data, dict) or len(data) > _MAX_CLASSES:
            raise DataError(f"{where}: labels must be a table of at most {_MAX_CLASSES} ids and names")
        classes = [_class_of(key, value, where) for key, value in data.items()]
        names: dict[str, int] = {}
        for one in classes:
            if names.setdefault(one.name, one.id) != one.id:
                raise DataError(f"{where}: {names[one.name]} and {one.id} are both called '{one.name}'; rename one")
        return cls({one.id: one for one in classes})

    def data(self) -> dict[str, Any]:
        """Return the classes as plain data."""
        return {str(one.id): {"name": one.name, "color": list(one.color)} for one in self._classes.values()}


def usual_color(class_id: int) -> Color:
    """Return a bright RGB colour for an id, unlike those of ids beside it."""
    r, g, b = colorsys.hsv_to_rgb((class_id * _GOLDEN) % 1.0, 0.65, 0.95)
    return round(255 * r), round(255 * g), round(255 * b)


def _class_of(key: str, value: Any, where: str) -> LabelClass:
    if not (key.isascii() and key.isdecimal() and len(key) <= 5 and UNLABELLED < int(key) <= MAX_ID):
        raise DataError(f"{where}: '{key}' is no id of a label; they are whole numbers from 1 to {MAX_ID}")
    table = value if isinstance(value, dict) else {"name": value}
    name, color = table.get("name"), table.get("color", usual_color(int(key)))
    if not isinstance(name, str) or not 0 < len(name.strip()) <= _MAX_NAME or not name.isprintable():
        raise DataError(f"{where}: label {key} needs a name of 1 to {_MAX_NAME} letters, got {name!r}")
    is_color = isinstance(color, (list, tuple)) and len(color) == 3
    if not is_color or not all(type(part) is int and 0 <= part <= 255 for part in color):
        raise DataError(f"{where}: the color of label {key} must be [R, G, B] from 0 to 255, got {color!r}")
    return LabelClass(int(key), name.strip(), (color[0], color[1], color[2]))
