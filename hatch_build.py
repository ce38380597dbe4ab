"""What the build adds to a distribution: addresses, a long description without relative links, a bill of materials."""

from __future__ import annotations

import json
import re
import shutil
import tempfile
import tomllib
from collections import defaultdict
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

VENDORED = "vislam/runs/report/assets/vendor/versions.json"  # JavaScript that the wheel contains
NOT_RUNTIME = {"dev", "docs"}  # extras of whoever changes vislam
RELATIVE = re.compile(r"(!?)\[([^\]]*)\]\((?!#|[a-z]+:)([^)\s]+)\)")
PINNED = re.compile(r"^([a-z0-9][\w.-]*)==([^\s;]+)(?: ; ([^\\\n]+?))? *\\?$")


def long_description(readme: str, home: str, version: str) -> str:
    """Return the README with links to files of release `version` below `home`, an address as GitHub has it.

    Where `home` is empty nothing is published yet: of a link its text is left, and of a picture nothing.
    """

    def absolute(link: re.Match[str]) -> str:
        is_picture, text, path = link.groups()
        if not home:
            return "" if is_picture else text
        return f"{is_picture}[{text}]({home}/{'raw' if is_picture else 'blob'}/v{version}/{path})"

    return RELATIVE.sub(absolute, readme)


def addresses(home: str) -> dict[str, str]:
    """Return the project's addresses by their labels, none where `home` is empty."""
    pages = {"Homepage": "", "Documentation": "/tree/main/docs", "Source": "", "Issues": "/issues"}
    pages["Changelog"] = "/blob/main/CHANGELOG.md"
    return {label: home + path for label, path in pages.items()} if home else {}


def locked(lock: str) -> tuple[dict[str, list[tuple[str, str]]], dict[str, set[str]]]:
    """Return (version, marker) of every package of a lock by its name, and which packages each one needs."""
    versions: dict[str, list[tuple[str, str]]] = defaultdict(list)
    needs: dict[str, set[str]] = defaultdict(set)
    name = ""
    for line in lock.splitlines():
        if pinned := PINNED.match(line):
            name = canonicalize_name(pinned[1])
            versions[name].append((pinned[2], pinned[3] or ""))
        elif line.startswith("    # via "):
            for user in line.removeprefix("    # via ").split(", "):
                needs[user.split(" ")[0]].add(name)
    return versions, needs


def reached(roots: set[str], needs: dict[str, set[str]]) -> set[str]:
    """Return the packages that `roots` need, themselves included."""
    found: set[str] = set()
    while roots:
        found |= roots
        roots = {needed for name in roots for needed in needs.get(name, ())} - found
    return found


def named(requirements: list[str]) -> set[str]:
    """Return the names of what is required, as the lock has them."""
    return {canonicalize_name(Requirement(text).name) for text in requirements} - {"vislam"}


def bill_of_materials(root: Path) -> dict[str, Any]:
    """Return a CycloneDX document: JavaScript that the wheel contains, and the packages it was tested with.

    These are those of requirements.lock that vislam needs (`required`) or one of its extras does (`optional`).
    """
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    versions, needs = locked((root / "requirements.lock").read_text(encoding="utf-8"))
    direct = named(project["dependencies"])
    extras = project["optional-dependencies"]
    required = reached(direct, needs)
    optional = reached(named([text for name in extras.keys() - NOT_RUNTIME for text in extras[name]]), needs)
    components, references = [], defaultdict(list)
    for name in sorted((required | optional) & versions.keys()):
        for version, marker in versions[name]:
            purl = f"pkg:pypi/{name}@{version}"
            references[name].append(purl)
            component: dict[str, Any] = {"type": "library", "bom-ref": purl, "name": name, "version": version}
            component |= {"purl": purl, "scope": "required" if name in required else "optional"}
            if marker:
                component["properties"] = [{"name": "vislam:where", "value": marker}]
            components.append(component)
    contained = []
    for file, facts in sorted(json.loads((root / VENDORED).read_text(encoding="utf-8")).items()):
        purl = f"pkg:npm/{file.partition('.')[0]}@{facts['version']}"
        contained.append({
            "type": "library", "bom-ref": purl, "name": file.partition(".")[0], "version": facts["version"],
            "purl": purl, "scope": "required", "licenses": [{"license": {"id": "MIT"}}],
            "hashes": [{"alg": "SHA-256", "content": facts["sha256"]}],
        })  # fmt: skip
    own = f"pkg:pypi/vislam@{project['version']}"
    edges = {own: sorted(part["purl"] for part in contained)}
    edges[own] += sorted(purl for name in direct for purl in references[name])
    for name, purls in references.items():
        for purl in purls:
            edges[purl] = sorted(ref for needed in needs.get(name, ()) for ref in references[needed])
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json", "bomFormat": "CycloneDX", "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": {
            "type": "library", "bom-ref": own, "name": "vislam", "version": project["version"], "purl": own,
            "licenses": [{"license": {"id": project["license"]}}],
        }},
        "components": contained + components,
        "dependencies": [{"ref": ref, "dependsOn": on} for ref, on in sorted(edges.items())],
    }  # fmt: skip


class Metadata(MetadataHookInterface):
    """Fills what pyproject.toml declares as dynamic."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the long description and the addresses."""
        readme = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = long_description(readme, self.config["home"], metadata["version"])
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
        metadata["urls"] = addresses(self.config["home"])


class Build(BuildHookInterface):
    """Puts the bill of materials into a wheel, at `.dist-info/sboms/` (PEP 770)."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write it beside the tree and have it included; an editable installation has none."""
        self.folder = Path(tempfile.mkdtemp())
        if version == "standard":
            file = self.folder / "vislam.cdx.json"
            file.write_text(json.dumps(bill_of_materials(Path(self.root)), indent=1) + "\n", encoding="utf-8")
            build_data["sbom_files"].append(str(file))

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was written beside the tree."""
        shutil.rmtree(self.folder)
