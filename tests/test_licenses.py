"""Licences of locked packages are reviewed, and the bill of materials lists all of them."""

from __future__ import annotations

import importlib.metadata
import re

import pytest

from locks.sbom import LICENSES, bill_of_materials, locked_packages

SHIPPED = ("run", "view")


def test_every_shipped_package_has_an_allowed_licence() -> None:
    packages = LICENSES["packages"]
    assert set(packages) == {package.name for lock in SHIPPED for package in locked_packages(lock)}
    for name, expression in packages.items():
        terms = set(re.split(r" (?:AND|OR|WITH) |[()]", expression)) - {""}
        assert terms <= set(LICENSES["allowed"]), name


def test_the_list_agrees_with_the_metadata_of_installed_packages() -> None:
    stated = {}
    for name in LICENSES["packages"]:
        try:
            stated[name] = importlib.metadata.metadata(name).json.get("license_expression")
        except importlib.metadata.PackageNotFoundError:
            continue
    stated = {name: expression for name, expression in stated.items() if expression}
    assert len(stated) > 10
    assert stated == {name: LICENSES["packages"][name] for name in stated}


@pytest.mark.parametrize("lock", SHIPPED)
def test_the_bill_of_materials_is_complete_and_reproducible(lock: str) -> None:
    bill = bill_of_materials(lock)
    assert bill == bill_of_materials(lock)
    listed = [(item["name"], item["version"]) for item in bill["components"]]
    assert listed == [(package.name, package.version) for package in locked_packages(lock)]
    references = [item["bom-ref"] for item in bill["components"]]
    assert len(set(references)) == len(references)
    own, *others = bill["dependencies"]
    assert {"numpy", "pyzmq", "python-can"} <= {ref[9:].split("@")[0] for ref in own["dependsOn"]}
    assert [item["ref"] for item in others] == references
    assert any("typing-extensions" in ref for item in others for ref in item["dependsOn"])
