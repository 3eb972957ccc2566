"""Additions take what docs/architecture.md says: each is made in a copy of the sources, and works there."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CONTACT_FIELD = """
    squared_misfit: Annotated[float | None, HandColumn()] = None
    \"\"\"of a point contact, in variances of noise and tolerances\"\"\"


@dataclass(frozen=True, slots=True)
class HandFrameHead:"""
USE_OF_CONTACT_FIELD = """
import numpy as np
from dataclasses import fields
from handtouch import wire
from handtouch.bridge.ros2.contact_messages import RosContact
from handtouch.client.hand_arrays import HandArrays
from handtouch.config import parse
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.table_cache import build_pad_model
from handtouch.simulate.tactile.reading import TactileReading
from tests.core.conftest import TOLERANT_DEPLOYMENT

class Sink:
    def has_subscriber(self, topic):
        return topic.startswith("hand/")
    def send(self, message):
        sent.append(wire.decode(wire.encode(message)))

sent = []
pipeline = Pipeline(build_pad_model(parse(TOLERANT_DEPLOYMENT)), 5_000_000, 0.6, Sink())
tick, (hand, *_), link = pipeline.tick, pipeline.model.hands, pipeline.model.links[1]
tick.state.values[1], tick.state.contact_id[1] = 0.5, 7
tick.state.touching[1] = tick.state.solved[1] = True
tick.columns.squared_misfit[1] = 2.25
tick.output.publish()
retained = pipeline.messages.retained_messages()[f"contact/{hand}/{link}"]
contact = wire.decode(wire.encode(retained(10**9)))
assert contact.squared_misfit == 2.25, contact
pipeline.messages.send_hand_frames(pipeline.slab, 1, 10**9, Sink())
assert HandArrays(sent[0]).squared_misfit[link] == 2.25
assert np.isnan(HandArrays(sent[0]).squared_misfit[pipeline.model.links[0]])
names = {field.name for field in fields(TactileReading)} & RosContact.__annotations__.keys()
assert "squared_misfit" in names
"""
PACKAGE = """
import math
from dataclasses import dataclass
from typing import ClassVar
from handtouch.field import CylinderSurface

@dataclass(frozen=True)
class TubeSurface(CylinderSurface):
    kind: ClassVar[str] = "tube"

def simulate_tube(table):
    from handtouch.simulate.pad_geometry import SimulatedSurface
    return SimulatedSurface(table.length_mm * 1e-3, math.radians(table.arc_deg), table.radius_mm * 1e-3)

def add_arguments(parser):
    parser.add_argument("--count", type=int, default=1)
    parser.set_defaults(command=run)

def run(count):
    print("tube " * count)
    return 0
"""
ENTRY_POINTS = """
[handtouch.surfaces]
tube = tubes:TubeSurface
[handtouch.simulated_surfaces]
tube = tubes:simulate_tube
[handtouch.commands]
tubes = tubes:add_arguments
"""
USE_OF_SURFACE = """
from handtouch.config.surfaces import surface_table
from handtouch.simulate.surfaces import simulated_surface
keys = {"radius_mm": 8.0, "length_mm": 30.0, "arc_deg": 350.0}
table, like = surface_table("tube", **keys), surface_table("cylinder", **keys)
assert table.rectangle_mm == like.rectangle_mm
assert simulated_surface(table) == simulated_surface(like)
"""
GENERATED = (
    "docs/wire.md",
    "docs/wire.schema.json",
    "clients/cpp/include/handtouch/fields.hpp",
    "clients/js/fields.js",
    "clients/js/fields.d.ts",
    "clients/ros2/handtouch_msgs/msg/Contact.msg",
)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of sources, clients and pages."""
    for name in ("src", "docs", "clients"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "_build"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def run(tree: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python on the copy, with the tests of this one."""
    variables = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (tree / "src", tree, ROOT)))}
    return subprocess.run(
        [sys.executable, *arguments], cwd=tree, env=variables, capture_output=True, text=True, check=False
    )


def test_a_contact_field_is_declared_once(tree: Path) -> None:
    declared = tree / "src/handtouch/wire/contact.py"
    before, head, after = declared.read_text().partition(
        "\n\n@dataclass(frozen=True, slots=True)\nclass HandFrameHead:"
    )
    assert head
    declared.write_text(before + CONTACT_FIELD + after)
    stale = run(tree, "-m", "docs.wire_files", "--check")
    assert stale.returncode == 1
    for name in GENERATED:
        assert f"{name} differs from the declarations: run `make tables`" in stale.stderr
    assert run(tree, "-m", "docs.wire_files").returncode == 0
    assert run(tree, "-m", "docs.wire_files", "--check").returncode == 0
    for name in GENERATED:
        assert "squared_misfit" in (tree / name).read_text()
    used = run(tree, "-c", USE_OF_CONTACT_FIELD)
    assert used.returncode == 0, used.stderr


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder with an installed package, as an installer leaves it."""
    info = tmp_path / "site" / "tubes-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: tubes\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (tmp_path / "site" / "tubes.py").write_text(PACKAGE)
    return tmp_path / "site"


def run_with(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with a package installed beside handtouch."""
    variables = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{site}"}
    return subprocess.run(
        [sys.executable, *arguments], env=variables, capture_output=True, text=True, check=False
    )


def test_a_surface_of_another_package_is_configured_and_simulated(installed: Path) -> None:
    used = run_with(installed, "-c", USE_OF_SURFACE)
    assert used.returncode == 0, used.stderr
    (installed / "tubes-1.0.dist-info/entry_points.txt").write_text(
        "[handtouch.surfaces]\ntube = tubes:run\n"
    )
    wrong = run_with(installed, "-c", USE_OF_SURFACE)
    assert "entry point tube of tubes: <function run" in wrong.stderr
    assert "is no subclass of Surface" in wrong.stderr
    (installed / "tubes-1.0.dist-info/entry_points.txt").write_text(ENTRY_POINTS.replace("simulated_", "no_"))
    unsimulated = run_with(installed, "-c", USE_OF_SURFACE)
    assert 'surface kind "tube" has no simulated geometry' in unsimulated.stderr


def test_a_command_of_another_package_runs_and_is_listed(installed: Path) -> None:
    done = run_with(installed, "-m", "handtouch", "tubes", "--count", "2")
    assert (done.returncode, done.stdout.split()) == (0, ["tube", "tube"]), done.stderr
    assert "from the package tubes" in run_with(installed, "-m", "handtouch", "--help").stdout
