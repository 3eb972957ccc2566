"""Design of electrodes: theory against the simulator, limits, drawings, tables of the deployment."""

from __future__ import annotations

import itertools
import json
import re
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import config
from handtouch.cli import main
from handtouch.design.deployed import deployment_text, pad_with_layout
from handtouch.design.drawing import LayeredDrawing, write_dxf, write_svg
from handtouch.design.fabrication import fabrication_drawing
from handtouch.design.goals import GOALS, goal_map, goal_value
from handtouch.design.layout import ElectrodeLayout, FabricationLimits
from handtouch.design.optimise import optimise_layout
from handtouch.design.pad_task import PadTask
from handtouch.design.simulated_check import simulated_goal_map
from handtouch.hand import electrode_network, pad_network
from handtouch.hand.expected_error import expected_error, pad_design
from handtouch.simulate.worlds import WORLDS
from tests.deployments import CYLINDER, PLANE, pad_text
from tests.deployments import deployment_text as deployment_of_pads

FloatArray = NDArray[np.float64]
CONFIG = Path(__file__).parents[2] / "config"
TIP = "index_distal"


@pytest.fixture(scope="module")
def deployment() -> config.Deployment:
    return config.load(CONFIG / "utah_mit.toml")


@pytest.fixture(scope="module")
def task(deployment: config.Deployment) -> PadTask:
    return PadTask.from_deployment(deployment, TIP, 1.0).with_points(5)


@pytest.fixture(scope="module")
def shorter(task: PadTask) -> ElectrodeLayout:
    """Electrodes on the sides with unequal gaps and two resistors."""
    ends = np.column_stack([task.boundary.corners_m[:-1], task.boundary.corners_m[1:]])
    gaps = np.array([[2.0, 1.0], [3.0, 0.5], [0.7, 2.5], [1.5, 1.0]]) * 1e-3
    return ElectrodeLayout(ends + gaps * [1, -1], np.array([0.0, 82.0, 0.0, 10.0]))


def test_position_without_tolerances_is_that_of_the_pads_map(deployment: config.Deployment) -> None:
    task = PadTask.from_deployment(deployment, TIP, 0.1, nominal=True)
    pad = pad_design(deployment, TIP)
    expected, _ = expected_error(pad, 0.1, *task.grid)
    found = goal_map(GOALS["position"], task, task.configured).ravel()
    np.testing.assert_allclose(found, 1e3 * expected, rtol=1e-4)


def test_a_layout_becomes_the_same_electrodes_in_the_deployment(
    task: PadTask, shorter: ElectrodeLayout
) -> None:
    pad = pad_with_layout(task, shorter)
    by_side = electrode_network(pad, task.sheet)
    around = shorter.network(task.boundary, task.sheet.ohm_per_square)
    x, y = task.grid
    np.testing.assert_allclose(around.fractions(x, y)[[3, 1, 0, 2]], by_side.fractions(x, y), atol=1e-5)


@pytest.mark.parametrize("goal", ["position", "linearity", "two-contacts"])
def test_goals_are_those_of_simulated_pads(goal: str, task: PadTask, shorter: ElectrodeLayout) -> None:
    expected = goal_map(GOALS[goal], task, shorter)
    world = WORLDS["default"].only("parts")
    found = simulated_goal_map(task, shorter, GOALS[goal], world, draws=10)
    assert goal_value(found, "mean") == pytest.approx(goal_value(expected, "mean"), rel=0.25)


def test_a_worse_node_makes_each_goal_worse(deployment: config.Deployment) -> None:
    nodes = {name: node.model_copy(update={"noise_counts": 50.0}) for name, node in deployment.nodes.items()}
    noisy = deployment.model_copy(update={"nodes": nodes})
    for goal in GOALS.values():
        values = [
            goal_value(goal_map(goal, task, task.configured), "mean")
            for task in (PadTask.from_deployment(d, TIP, 0.1).with_points(3) for d in (deployment, noisy))
        ]
        assert values[1] > values[0], goal.name


def test_the_best_layout_is_better_and_keeps_the_limits(deployment: config.Deployment) -> None:
    task = PadTask.from_deployment(deployment, TIP, 1.0, nominal=True).with_points(5)
    limits = FabricationLimits(min_gap_mm=0.5, min_electrode_mm=6.0, max_series_ohm=50.0)
    result = optimise_layout(task, GOALS["linearity"], "worst", limits, starts=1)
    assert result.value_after < 0.5 * result.value_before
    assert result.after.lengths_m.min() >= 5.9e-3
    assert result.after.series_ohm.max() <= 50.0
    ends = np.column_stack([task.boundary.corners_m[:-1], task.boundary.corners_m[1:]])
    assert np.abs(result.after.stretches_m - ends).min() >= 0.5e-3 - 1e-9


def test_impossible_requests_are_refused(task: PadTask, shorter: ElectrodeLayout) -> None:
    with pytest.raises(ValueError, match="min_gap_mm"):
        optimise_layout(task, GOALS["position"], limits=FabricationLimits(min_electrode_mm=30.0))
    with pytest.raises(ValueError, match="min_gap_mm"):
        optimise_layout(task, GOALS["position"], limits=FabricationLimits(min_gap_mm=5.0), electrodes=12)
    with pytest.raises(ValueError, match="one electrode on each side"):
        optimise_layout(task, GOALS["linearity"], electrodes=6)
    anywhere = ElectrodeLayout(shorter.stretches_m + 4e-3, shorter.series_ohm)
    with pytest.raises(ValueError, match="cylinder or plane; this pad's is sphere"):
        pad_with_layout(task, anywhere)


@pytest.mark.parametrize(
    ("file", "link"),
    [("utah_mit", TIP), ("utah_mit", "thumb_middle"), ("two_finger", "thumb_tip")],
)
def test_tails_cross_neither_each_other_nor_other_electrodes(file: str, link: str) -> None:
    task = PadTask.from_deployment(config.load(CONFIG / f"{file}.toml"), link, 1.0)
    lines = fabrication_drawing(task, task.configured).lines
    tails = [points for layer, points in lines if layer == "TAILS"]
    bands = [points for layer, points in lines if layer == "ELECTRODES"]
    assert len(tails) == len(bands) == 4
    for one, other in itertools.combinations(tails, 2):
        assert not crosses(one, other)
    assert [sum(crosses(tail, band) for band in bands) for tail in tails] == [1, 1, 1, 1]


def crosses(one: FloatArray, other: FloatArray) -> bool:
    """Return True if a segment of one line meets one of another."""

    def side(a: FloatArray, b: FloatArray, p: FloatArray) -> FloatArray:
        across = (b[..., 0] - a[..., 0]) * (p[..., 1] - a[..., 1])
        return np.asarray(across - (b[..., 1] - a[..., 1]) * (p[..., 0] - a[..., 0]))

    a, b = one[:-1, None], one[1:, None]
    c, d = other[None, :-1], other[None, 1:]
    apart = side(a, b, c) * side(a, b, d) < 0
    return bool((apart & (side(c, d, a) * side(c, d, b) < 0)).any())


def test_svg_and_dxf_have_the_drawing_in_millimetres() -> None:
    drawing = LayeredDrawing("a pad")
    drawing.line("CUT", [(0, 0), (30, 0), (30, 20), (0, 0)])
    drawing.line("TAILS", [(1, 1), (2, 3)])
    drawing.text("TEXT", 1.0, 2.0, "2 < 3")
    root = ElementTree.fromstring(write_svg(drawing))
    assert root.attrib["width"] == "38.00mm"
    assert root.attrib["viewBox"].split()[2:] == ["38.000", "28.000"]
    tags = write_dxf(drawing).splitlines()
    pairs = list(zip(tags[::2], tags[1::2], strict=True))
    assert pairs[-1] == ("  0", "EOF")
    assert [value for code, value in pairs if code == "  0"].count("VERTEX") == 5
    at = pairs.index(("  9", "$INSUNITS"))
    assert pairs[at + 1] == (" 70", "4")
    assert [value for code, value in pairs if code == " 10"][3:6] == ["0.000000", "30.000000", "30.000000"]


def test_the_deployment_of_a_design_loads_and_keeps_the_rest(
    task: PadTask, shorter: ElectrodeLayout, tmp_path: Path
) -> None:
    path = CONFIG / "utah_mit.toml"
    (tmp_path / "new.toml").write_text(deployment_text(path, task, shorter, tmp_path))
    new, old = config.load(tmp_path / "new.toml"), config.load(path)
    pads = {entry.pad.link: entry.pad for entry in new.pads}
    assert pads[TIP] == pad_with_layout(task, shorter)
    assert pads[TIP].gap_mm == 0.5
    assert pads[TIP].series_ohm == (10.0, 82.0, 0.0, 0.0)
    assert {**pads, TIP: task.pad} == {entry.pad.link: entry.pad for entry in old.pads}
    assert "# A Utah/MIT hand" in (tmp_path / "new.toml").read_text()


def flat_file(folder: Path, surface: str, channels: str = "") -> Path:
    """A deployment of two pads, the first with this surface."""
    text = deployment_of_pads(
        pad_text("tip", 1, surface, "serial = 1"), pad_text("other", 2, extra="serial = 2")
    )
    path = folder / "flat.toml"
    path.write_text(text.replace("drive_v = 5.0", f"{channels}\ndrive_v = 5.0"))
    return path


@pytest.mark.parametrize("surface", [PLANE, CYLINDER], ids=["plane", "cylinder"])
@pytest.mark.parametrize("count", [3, 6, 8])
def test_electrodes_anywhere_become_arcs_of_an_outline_in_the_deployment(
    surface: str, count: int, tmp_path: Path
) -> None:
    path = flat_file(tmp_path, surface, 'channels = ["0x2001:3:i16", "0x2001:4:i16", "0x2001:5", "0x2001:6"]')
    path.write_text(path.read_text().replace('"0x2001:5", "0x2001:6"', '"0x2001:5:i16", "0x2001:6:i16"'))
    old = config.load(path)
    task = PadTask.from_deployment(old, "tip", 1.0).with_points(5)
    whole = task.boundary.perimeter_m
    begin = 7e-3 + whole * np.arange(count) / count
    layout = ElectrodeLayout(
        np.column_stack([begin, begin + 0.7 * whole / count]), np.resize([0.0, 82.0, 10.0], count)
    )
    (tmp_path / "new.toml").write_text(deployment_text(path, task, layout, tmp_path))
    new = config.load(tmp_path / "new.toml")
    pads = {entry.pad.link: entry.pad for entry in new.pads}
    x, y = task.grid
    network = pad_network(pads["tip"], task.sheet)
    place = task.surface.point(x, y)
    on_outline = pads["tip"].surface.build()
    scaled = (x * on_outline.a / task.surface.a, y * on_outline.b / task.surface.b)
    np.testing.assert_allclose(on_outline.point(*scaled), place, atol=2e-7)
    expected = layout.network(task.boundary, task.sheet.ohm_per_square).fractions(x, y)
    np.testing.assert_allclose(network.fractions(*scaled), expected, atol=2e-5)
    channels = new.nodes[pads["tip"].node].channels
    assert channels == tuple(f"0x2001:{3 + k}:i16" for k in range(count))
    assert (pads["other"], new.nodes["n"]) == (old.pads[1].pad, old.nodes["n"])


def test_channels_that_do_not_follow_each_other_are_not_continued(tmp_path: Path) -> None:
    path = flat_file(tmp_path, PLANE, 'channels = ["0x6401:4", "0x6401:1", "0x6401:2", "0x6401:3"]')
    task = PadTask.from_deployment(config.load(path), "tip", 1.0)
    begin = task.boundary.perimeter_m * np.arange(6) / 6
    layout = ElectrodeLayout(np.column_stack([begin, begin + 8e-3]), np.zeros(6))
    with pytest.raises(ValueError, match=r"0x6401:4, .* write a \[node\] table with as many channels"):
        deployment_text(path, task, layout, tmp_path)


def test_electrodes_anywhere_above_a_shear_pad_are_not_written() -> None:
    deployment = config.load(CONFIG / "shear.toml")
    task = PadTask.from_deployment(deployment, deployment.pads[0].pad.link, 1.0)
    begin = task.boundary.perimeter_m * np.arange(6) / 6
    layout = ElectrodeLayout(np.column_stack([begin, begin + 7e-3]), np.zeros(6))
    with pytest.raises(ValueError, match="can't lie above a shear pad"):
        pad_with_layout(task, layout)


def test_design_command_writes_tables_of_six_electrodes_that_the_daemon_accepts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("handtouch.design.optimise.optimise_layout", partial(optimise_layout, starts=1))
    command = ["design", str(flat_file(tmp_path, PLANE)), "--link", "tip", "--goal", "position"]
    assert main([*command, "--electrodes", "6", "--world", "ideal", "--json", "-o", str(tmp_path)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["no_tables"], len(report["electrodes"])) == ("", 6)
    assert report["after"] < report["before"]
    assert main(["check", str(tmp_path / "tip_position.toml")]) == 0


def test_design_command_writes_drawings_and_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--goal", "force", "--world", "ideal", "--force", "0.06", "--max-series-ohm", "0"]
    command = ["design", str(CONFIG / "two_finger.toml"), "--link", "thumb_tip", *arguments]
    assert main([*command, "--no-check", "--json", "-o", str(tmp_path)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["after"] <= report["before"]
    assert {Path(file).suffix for file in report["files"]} == {".png", ".svg", ".dxf", ".toml"}
    assert report["sheet_forces_n"] == [0.06, 0.1, 0.3]
    assert [case["is_configured"] for case in report["sheets"]][:2] == [True, False]
    assert main(["check", str(tmp_path / "thumb_tip_force.toml")]) == 0
    assert re.search(r"no warnings", capsys.readouterr().out)


def test_design_of_an_unknown_pad_is_a_usage_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["design", str(CONFIG / "two_finger.toml"), "--link", "tail", "--goal", "position"]
    assert main([*command, "-o", str(tmp_path)]) == 2
    assert "thumb_tip" in capsys.readouterr().err
