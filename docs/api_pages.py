"""Hook of mkdocs (mkdocs.yml): a page of the API reference for each room, made of its docstrings."""

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

PACKAGE = Path(__file__).resolve().parent.parent / "vislam"


def on_files(files: Files, config: Any) -> Files:
    """Add `api/ROOM.md` for each room; mkdocstrings fills them."""
    rooms = sorted(path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file())
    for room in rooms:
        if not room.startswith("_"):
            content = f"# vislam.{room}\n\n::: vislam.{room}\n"
            files.append(File.generated(config, f"api/{room}.md", content=content))
    return files
