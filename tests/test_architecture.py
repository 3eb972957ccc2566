"""Import graph: layers of docs/architecture.md, no cycle, no private module of another package."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src"
PAGE = (ROOT / "docs" / "architecture.md").read_text()
HEAVY = {"core": ("can", "canopen", "zmq"), "canbus": ("scipy",), "wire": ("can", "canopen", "zmq", "scipy")}
"""Libraries that a package must not import."""

RUN = (
    "handtouch.cli.run",
    "handtouch.daemon.metrics_server",
    "handtouch.percept.child",
    "handtouch.supervisor.child",
)
"""Modules that `handtouch run` and its processes start with."""

Graph = dict[str, dict[str, int]]


def _name(path: Path) -> str:
    name = ".".join(path.relative_to(SOURCE).with_suffix("").parts)
    return name.removesuffix(".__init__")


FILES = {_name(path): path for path in SOURCE.rglob("*.py")}


@cache
def _statements(module: str) -> list[ast.AST]:
    """Return the imports and classes of a module, at any depth."""
    nodes = ast.walk(ast.parse(FILES[module].read_text()))
    return [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom | ast.ClassDef)]


def _imports(module: str) -> Iterator[tuple[str, int]]:
    """Yield every module that a module imports, at any depth, with its line."""
    path = FILES[module]
    for node in _statements(module):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                folder = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
                parts = folder[: len(folder) - node.level + 1]
                base = ".".join([*parts, *([node.module] if node.module else [])])
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield (full if full in FILES else base), node.lineno


@pytest.fixture(scope="module")
def graph() -> Graph:
    """Module -> imported module of handtouch -> line."""
    found: Graph = defaultdict(dict)
    for module in FILES:
        for imported, line in _imports(module):
            if imported.split(".")[0] == "handtouch" and imported != module:
                found[module].setdefault(imported, line)
    return found


def _layers() -> dict[str, int]:
    block = re.search(r"## Layers.*?```text\n(.*?)```", PAGE, re.DOTALL)
    assert block is not None
    return {package: level for level, line in enumerate(block[1].splitlines()) for package in line.split()}


def _package(module: str) -> str:
    """The package of a module; empty for handtouch itself, whose lazy imports are its public interface."""
    return "" if module.count(".") == 0 or module == "handtouch.__main__" else module.split(".")[1]


def _across(graph: Graph) -> Iterator[tuple[str, str, int]]:
    for module, imported in graph.items():
        for other, line in imported.items():
            if _package(module) and _package(other) and _package(module) != _package(other):
                yield module, other, line


def test_every_package_has_a_layer_and_a_row_on_the_architecture_page() -> None:
    packages = {_package(module) for module in FILES} - {""}
    assert packages == _layers().keys()
    assert packages == set(re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE))


def test_imports_go_down_the_layers_only(graph: Graph) -> None:
    level = _layers()
    wrong = [
        f"{module}:{line} imports {other}"
        for module, other, line in _across(graph)
        if level[_package(other)] >= level[_package(module)]
    ]
    assert not wrong


def test_no_module_imports_a_private_module_of_another_package(graph: Graph) -> None:
    wrong = [
        f"{module}:{line} imports {other}"
        for module, other, line in _across(graph)
        if any(part.startswith("_") for part in other.split("."))
    ]
    assert not wrong


def test_modules_import_each_other_in_no_cycle(graph: Graph) -> None:
    """Also under TYPE_CHECKING and inside functions."""
    try:
        TopologicalSorter(
            {module: set(imported) & FILES.keys() for module, imported in graph.items()}
        ).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def _reached(graph: Graph, roots: Iterable[str]) -> set[str]:
    """Return the modules that these import, also later and in turn, with the packages that hold them."""
    reached, waiting = set[str](), list(roots)
    while waiting:
        module = waiting.pop()
        if module not in reached and module in FILES and module != "handtouch":
            reached.add(module)
            waiting += [*graph[module], module.rpartition(".")[0]]
    return reached


def test_the_daemon_and_its_processes_load_the_listed_packages_only(graph: Graph) -> None:
    (block,) = re.findall(r"## What `handtouch run` loads.*?```text\n(.*?)```", PAGE, re.DOTALL)
    reached = _reached(graph, RUN)
    assert {_package(module) for module in reached} == set(block.split())
    assert not {module for module in reached if _package(module) == "cli"} - {
        f"handtouch.{name}" for name in ("cli", "cli.run", "cli.options", "cli.errors")
    }


@pytest.mark.parametrize("package", sorted(HEAVY))
def test_a_package_imports_no_library_of_another_concern(package: str) -> None:
    wrong = [
        f"{module}:{line} imports {imported}"
        for module in FILES
        if _package(module) == package
        for imported, line in _imports(module)
        if imported.split(".")[0] in HEAVY[package]
    ]
    assert not wrong


def test_the_simulator_uses_none_of_the_estimators(graph: Graph) -> None:
    """An error in either must show, and what is tuned must not change what it is tuned on."""
    estimators = {"field", "sheet", "calibration", "core", "supervisor", "percept"}
    joined = "handtouch.simulate.tactile.sensor"  # simulator and core together, which only a task uses
    loader = "handtouch.core.compiled"  # of compiled modules, the simulator's among them
    assert {module for module, imported in graph.items() if joined in imported} == {
        "handtouch.simulate",
        "handtouch.simulate.tactile.bolt_workcell",
        "handtouch.simulate.tactile.grip_environment",
    }
    wrong = [
        f"{module}:{line} imports {other}"
        for module, other, line in _across(graph)
        if _package(module) == "simulate" and _package(other) in estimators and other != loader
        if module != joined
    ]
    assert not wrong


def test_class_names_are_unique() -> None:
    places: dict[str, list[str]] = defaultdict(list)
    for module in FILES:
        for node in _statements(module):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(f"{module}:{node.lineno}")
    assert not {name: where for name, where in places.items() if len(where) > 1}


MAX_PARAMETERS = 8


def _parameters(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return len([one for one in given if one.arg not in ("self", "cls")])


def _may_have_more(module: str, function: str) -> bool:
    """Return True for the options of a command, which argparse gives by name, and for a function of C when
    compiled: its calls are checked there, and an object for its numbers would cost time in every tick."""
    if _package(module) == "cli":
        return function == "run"
    types = FILES[module].with_suffix(".pxd")
    return types.exists() and bool(re.search(rf"^cdef \S+ {function}\(", types.read_text(), re.MULTILINE))


def test_no_function_takes_more_than_eight_parameters() -> None:
    long = [
        f"{module}:{node.lineno} {node.name}: {_parameters(node)}"
        for module, path in FILES.items()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and _parameters(node) > MAX_PARAMETERS
        and not _may_have_more(module, node.name)
    ]
    assert not long
