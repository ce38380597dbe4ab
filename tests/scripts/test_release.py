"""What is handed out: a wheel with all that the package needs, and one version and one way to install everywhere."""

import hashlib
import importlib.util
import json
import re
import subprocess
import sys
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest
import yaml

from vislam.core.errors import install_line

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
HOME = "https://example.org/vislam"

_spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
hatch_build = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(hatch_build)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """Built as `python -m build` builds it, twice: the bytes have to agree."""
    built = []
    for name in ("once", "twice"):
        folder = tmp_path_factory.mktemp(name)
        command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        built += folder.glob("*.whl")
    assert built[0].read_bytes() == built[1].read_bytes()
    return zipfile.ZipFile(built[0])


def own(wheel: zipfile.ZipFile, name: str) -> bytes:
    return wheel.read(f"vislam-{PROJECT['version']}.dist-info/{name}")


def test_the_wheel_has_every_file_of_the_package_and_no_other(wheel):
    made = {".nbi", ".nbc", ".pyc"}
    files = (path.relative_to(ROOT) for path in (ROOT / "vislam").rglob("*") if path.is_file())
    wanted = {path.as_posix() for path in files if path.suffix not in made and "__pycache__" not in path.parts}
    found = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert found == wanted
    assert {Path(name).suffix for name in found} >= {".js", ".npz", ".ino", ".h", ".css", ".typed"}


def test_its_metadata_have_no_link_that_leads_nowhere(wheel):
    metadata = message_from_bytes(own(wheel, "METADATA"))
    assert (metadata["Name"], metadata["Version"]) == ("vislam", PROJECT["version"])
    assert metadata["License-Expression"] == "MIT" and "Typing :: Typed" in metadata.get_all("Classifier")
    text = metadata.get_payload(decode=True).decode()
    assert "# vislam" in text and not hatch_build.RELATIVE.search(text)


def test_links_and_addresses_lead_to_the_release_once_there_is_a_home():
    readme = "![a](docs/a.png) [b\nc](docs/d.md#e) [f](#g) [h](https://rerun.io)"
    assert hatch_build.long_description(readme, HOME, "1.2") == (
        f"![a]({HOME}/raw/v1.2/docs/a.png) [b\nc]({HOME}/blob/v1.2/docs/d.md#e) [f](#g) [h](https://rerun.io)"
    )
    assert hatch_build.long_description(readme, "", "1.2") == " b\nc [f](#g) [h](https://rerun.io)"
    whole = hatch_build.long_description((ROOT / "README.md").read_text(encoding="utf-8"), HOME, "1.2")
    assert not hatch_build.RELATIVE.search(whole)
    assert {"Homepage", "Documentation", "Source", "Issues", "Changelog"} == hatch_build.addresses(HOME).keys()
    assert hatch_build.addresses("") == {}


def test_its_bill_of_materials_has_what_is_inside_and_what_the_lock_says(wheel):
    bill = json.loads(own(wheel, "sboms/vislam.cdx.json"))
    by_name = {part["name"]: part for part in bill["components"]}
    script = wheel.read("vislam/runs/report/assets/vendor/three.min.js")
    assert by_name["three"]["hashes"] == [{"alg": "SHA-256", "content": hashlib.sha256(script).hexdigest()}]
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    for text in PROJECT["dependencies"]:
        part = by_name[re.match(r"[\w-]+", text)[0]]
        assert part["scope"] == "required" and f"{part['name']}=={part['version']}" in lock
    assert by_name["llvmlite"]["scope"] == "required"  # of numba
    assert by_name["open3d"]["scope"] == "optional" and "pytest" in lock and "mypy" not in by_name
    references = {part["bom-ref"] for part in bill["components"]} | {bill["metadata"]["component"]["bom-ref"]}
    assert len(references) == len(bill["components"]) + 1
    edges = {edge["ref"]: set(edge["dependsOn"]) for edge in bill["dependencies"]}
    assert set().union(edges, *edges.values()) <= references
    numba = by_name["numba"]["bom-ref"]
    assert by_name["llvmlite"]["bom-ref"] in edges[numba]


def test_the_version_is_the_same_everywhere():
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    changes = re.search(r"^## (\S+?),? ", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    page = re.search(r"vislam-(.+?)-py3", (ROOT / "docs" / "install.md").read_text(encoding="utf-8"))
    named = {recipe["context"]["version"], citation["version"], changes[1], page[1]}
    assert named == {PROJECT["version"]}


def test_the_conda_recipe_needs_what_the_wheel_needs():
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    elsewhere = {"opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}  # names of conda-forge
    wanted = {f"python{PROJECT['requires-python']}"}
    for text in PROJECT["dependencies"]:
        name, limits = re.match(r"([\w-]+)(.*)", text).groups()
        wanted.add(elsewhere.get(name, name) + limits)
    assert {text.replace(" ", "", 1) for text in recipe["requirements"]["run"]} == wanted


def test_how_vislam_is_installed_stands_on_one_page_and_in_one_function():
    quoted = {}
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")):
        lines = re.findall(r"pip install '(?:\.|vislam)\[.*?\]'", page.read_text(encoding="utf-8"))
        quoted |= {page.relative_to(ROOT).as_posix(): lines} if lines else {}
    assert quoted.pop("docs/README.md") == ["pip install '.[docs]'"]  # for who writes them, in a clone
    assert quoted == {"docs/install.md": [re.search(r"pip install '.*?'", install_line("map,view"))[0]]}
