"""The programs in examples/ close their loops with a simulated gripper."""

from __future__ import annotations

import asyncio
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from handtouch import request
from handtouch.simulate.gripper import COMMAND_TIMEOUT_S, GripperWorld
from handtouch.simulate.gripper_client import GripperClient

EXAMPLES = Path(__file__).parents[1] / "examples"
PERIOD_MS = 20.0  # half the rate, for machines under load
PULLS = 4
COASTING_M = 0.02 * COMMAND_TIMEOUT_S
"""Distance of a finger at 20 mm/s under its last command."""


@pytest.fixture(scope="module")
def programs() -> Iterator[Any]:
    """Return a function that imports a program by name, as they import one another."""
    sys.path.insert(0, str(EXAMPLES))
    yield __import__
    sys.path.remove(str(EXAMPLES))


@pytest.fixture(scope="module")
def endpoints(programs: Any, network: list[str]) -> Iterator[Any]:
    """Run daemon and gripper for all tests."""
    with (
        tempfile.TemporaryDirectory(prefix="ht.") as folder,
        programs("run_all").rig(Path(folder), network, PERIOD_MS) as options,
    ):
        yield options


@pytest.fixture
def gripper(endpoints: Any) -> Iterator[GripperClient]:
    with GripperClient(endpoints.robot, timeout_s=30.0) as made:
        yield made


def test_a_finger_stops_on_touch(programs: Any, endpoints: Any, gripper: GripperClient) -> None:
    async def act() -> None:
        await programs("common").insert_object(gripper, "block", endpoints.live)
        await programs("stop_on_touch").stop_on_touch(gripper, endpoints.live, "index", 0.02)

    asyncio.run(act())
    stopped = gripper.read_state()
    assert 0 < stopped.truth["index_depth_m"] < 2 * COASTING_M
    assert stopped.position_m["index"] < 0.013


def test_the_grip_force_is_constant_while_the_object_relaxes(
    programs: Any, endpoints: Any, gripper: GripperClient
) -> None:
    keep = programs("keep_force")

    async def act() -> None:
        await programs("common").insert_object(gripper, "block", endpoints.live)
        for finger in ("thumb", "index"):
            await programs("stop_on_touch").stop_on_touch(gripper, endpoints.live, finger)
        await keep.keep_force(gripper, endpoints.live, keep.ForceControl(2.0), 2.5)

    asyncio.run(act())
    assert gripper.read_state().truth["index_force_n"] == pytest.approx(2.0, rel=0.05)


def test_the_edge_stays_under_the_centre_of_the_pad(
    programs: Any, endpoints: Any, gripper: GripperClient
) -> None:
    follow = programs("follow_edge")

    async def act() -> list[tuple[float, float]]:
        await programs("common").insert_object(gripper, "edge", endpoints.live)
        await programs("stop_on_touch").stop_on_touch(gripper, endpoints.live, "index")
        return list(await follow.follow_edge(gripper, endpoints.live, 0.04))

    request("scene", outputs=["position", "force", "base"], endpoint=endpoints.control, timeout_s=30.0)
    begin_m = gripper.read_state().truth.get("along_m", 0.0)
    errors = asyncio.run(act())
    assert gripper.read_state().truth["along_m"] - begin_m > 0.03
    assert errors[0][1] > 1.5e-3  # it has something to do
    assert max(error for along, error in errors if along > 0.01) < 1e-3


def test_the_grip_force_increases_on_slip(programs: Any, endpoints: Any, gripper: GripperClient) -> None:
    slip = programs("stop_slip")
    lost, without_reaction_m = asyncio.run(slip.pull_object(gripper, endpoints.live, react=False))
    assert without_reaction_m > 0.0115  # out of the grip
    assert lost.truth["thumb_force_n"] == 0.0
    for _ in range(PULLS):  # a machine that pauses lets any block go; without the reaction every one goes
        held, with_reaction_m = asyncio.run(slip.pull_object(gripper, endpoints.live, react=True))
        if held.truth["thumb_force_n"] > 0:
            break
    assert with_reaction_m < 0.6 * without_reaction_m
    assert held.truth["thumb_force_n"] > 2 * slip.INITIAL_N


def test_the_notebook_logs_and_plots(programs: Any, endpoints: Any, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    figure = tmp_path / "contacts.png"
    assert programs("run_all").log(endpoints.live, figure, 1.0).wait(60) == 0
    assert figure.stat().st_size > 10_000


def test_the_notebook_of_one_pad_shows_what_it_states(programs: Any) -> None:
    pytest.importorskip("matplotlib").use("agg")
    names: dict[str, Any] = {}
    exec(programs("run_all").cells(EXAMPLES / "one_pad.ipynb"), names)
    names["plt"].close("all")
    assert (names["contact"].x, names["contact"].y) == pytest.approx((0.008, 0.012), rel=1e-12)
    assert 1860 < names["inside"] < 1940  # binomial, 4 sigma
    assert names["back"].force_n == pytest.approx(names["force_n"], rel=1e-6)


@pytest.mark.parametrize("notebook", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebooks_are_kept_without_outputs(notebook: Path) -> None:
    code = [cell for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code"]
    assert code
    assert not any(cell["outputs"] or cell["execution_count"] for cell in code)


# --- the gripper itself


def pressed(world: GripperWorld, depth_m: float) -> float:
    """Close both fingers until each is so deep in the block; the time then."""
    t_s = 0.0
    while world.truth()["index_depth_m"] < depth_m:
        world.command_velocity(t_s, {"thumb": 0.02, "index": 0.02})
        t_s += 0.01
        world.sample_contacts(t_s)
    return t_s


def test_forces_of_a_grip_are_equal_and_relax() -> None:
    world = GripperWorld(0.012)
    t_s = pressed(world, 1e-3)
    first = world.truth()
    for step in range(500):
        world.sample_contacts(t_s + 0.01 * step)
    last = world.truth()
    assert first["thumb_force_n"] == pytest.approx(first["index_force_n"])
    assert last["index_force_n"] == pytest.approx(1500 * last["index_depth_m"], rel=0.02)
    assert last["index_force_n"] / last["index_depth_m"] < first["index_force_n"] / first["index_depth_m"]


@pytest.mark.parametrize(("share", "slides"), [(0.98, False), (1.02, True)])
def test_an_object_slides_when_the_pull_exceeds_friction(share: float, slides: bool) -> None:
    world = GripperWorld(0.012)
    world.reset("block", relaxing_stiffness_n_m=0.0)
    t_s = pressed(world, 1e-3) + 0.2
    world.sample_contacts(t_s - 0.16)
    for step in range(20):
        world.sample_contacts(t_s - 0.15 + 0.01 * step)
    truth = world.truth()
    world.pull_object(t_s + 0.05, share * 0.5 * (truth["thumb_force_n"] + truth["index_force_n"]), 0.0)
    for step in range(50):
        world.sample_contacts(t_s + 0.05 + 0.01 * step)
    assert (world.truth()["slipped_m"] > 0) is slides


def test_joints_stop_without_commands() -> None:
    world = GripperWorld(0.012)
    world.command_velocity(0.0, {"reach": 0.1})
    for step in range(100):
        world.sample_contacts(0.01 * step)
    assert world.position_m["reach"] == pytest.approx(0.1 * COMMAND_TIMEOUT_S, rel=0.1)


@pytest.mark.parametrize(
    ("kind", "parameters", "message"),
    [
        ("ball", {}, "known: block, edge"),
        ("block", {"colour": 1.0}, "width_m"),
        ("edge", {"wavelength_m": 0.0}, "wavelength_m"),
    ],
)
def test_invalid_objects_are_rejected_listing_the_known_ones(
    kind: str, parameters: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        GripperWorld(0.012).reset(kind, **parameters)
