"""Software bill of materials of a lock, as CycloneDX JSON: `python locks/sbom.py run >handtouch.cdx.json`.

Public names: `bill_of_materials`, `locked_packages`, `Package`, `LICENSES`.
"""

from __future__ import annotations

import importlib.metadata
import json
import re
import sys
import tomllib
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
LICENSES: dict[str, Any] = tomllib.loads((ROOT / "locks/licenses.toml").read_text())
"""`allowed`, a list of SPDX identifiers, and `packages`, SPDX expressions by name."""


class Package(NamedTuple):
    """A package in a lock; `marker`: the environments that it is for, empty for all."""

    name: str
    version: str
    marker: str
    hashes: list[str]
    """SHA-256 of its files: one per platform and version of Python"""


def locked_packages(lock: str) -> Iterator[Package]:
    """Yield the packages of locks/LOCK.lock. Raises OSError."""
    text = (ROOT / f"locks/{lock}.lock").read_text().replace("\\\n", " ")
    for line in text.splitlines():
        words, *hashes = re.split(r"\s+--hash=sha256:", line.strip())
        requirement = Requirement(words)
        version = str(requirement.specifier).removeprefix("==")
        yield Package(canonicalize_name(requirement.name), version, str(requirement.marker or ""), hashes)


def bill_of_materials(lock: str) -> dict[str, Any]:
    """Return the CycloneDX 1.6 document of handtouch with the packages of a lock; the same for equal locks.

    Raises OSError for a missing lock, KeyError for a package that locks/licenses.toml doesn't list.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    packages = list(locked_packages(lock))
    own = _purl(project["name"], project["version"])
    identity = json.dumps([own, packages])
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, identity)}",
        "version": 1,
        "metadata": {
            "component": {
                "type": "application",
                "bom-ref": own,
                "name": project["name"],
                "version": project["version"],
                "purl": own,
                "licenses": [{"expression": project["license"]}],
            }
        },
        "components": [_component(package) for package in packages],
        "dependencies": [
            {"ref": own, "dependsOn": _resolve(packages, project["dependencies"])},
            *(
                {
                    "ref": _purl(package.name, package.version),
                    "dependsOn": _resolve(packages, _requirements(package)),
                }
                for package in packages
            ),
        ],
    }


def _component(package: Package) -> dict[str, Any]:
    hashes = [{"name": "handtouch:file-sha256", "value": value} for value in package.hashes]
    marker = [{"name": "handtouch:marker", "value": package.marker}] if package.marker else []
    return {
        "type": "library",
        "bom-ref": _purl(package.name, package.version),
        "name": package.name,
        "version": package.version,
        "purl": _purl(package.name, package.version),
        "licenses": [{"expression": LICENSES["packages"][package.name]}],
        "properties": [*marker, *hashes],
    }


def _requirements(package: Package) -> list[str]:
    """Return the requirements of a package that is installed here; none for one of other environments."""
    try:
        return importlib.metadata.requires(package.name) or []
    except importlib.metadata.PackageNotFoundError:
        return []


def _resolve(packages: list[Package], requirements: list[str]) -> list[str]:
    """Return the references of required packages, leaving extras out."""
    parsed = [Requirement(text) for text in requirements]
    names = {canonicalize_name(item.name) for item in parsed if "extra" not in str(item.marker or "")}
    return [_purl(package.name, package.version) for package in packages if package.name in names]


def _purl(name: str, version: str) -> str:
    """Return the package URL, also its reference: a lock may have two versions of a package."""
    return f"pkg:pypi/{name}@{version}"


if __name__ == "__main__":
    print(json.dumps(bill_of_materials(sys.argv[1]), indent=2))
