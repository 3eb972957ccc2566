"""The programs in examples/ do what they say, to a simulated gripper that answers."""

from __future__ import annotations

import asyncio
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from handtouch import request
from handtouch.simulate.gripper import COMMAND_S, GripperWorld
from handtouch.simulate.gripper_client import Gripper

EXAMPLES = Path(__file__).parents[1] / "examples"
PERIOD_MS = 20.0  # half the pace, for machines that test other things too
PULLS = 4
TOO_LATE_M = 0.02 * COMMAND_S
"""How far a finger may go on at 20 mm/s with the last command that it got."""


@pytest.fixture(scope="module")
def programs() -> Iterator[Any]:
    """Modules by name, imported as those programs import one another."""
    sys.path.insert(0, str(EXAMPLES))
    yield __import__
    sys.path.remove(str(EXAMPLES))


@pytest.fixture(scope="module")
def asked(programs: Any, network: list[str]) -> Iterator[Any]:
    """Daemon and gripper, shared."""
    with (
        tempfile.TemporaryDirectory(prefix="ht.") as folder,
        programs("run_all").rig(Path(folder), network, PERIOD_MS) as options,
    ):
        yield options


@pytest.fixture
def gripper(asked: Any) -> Iterator[Gripper]:
    with Gripper(asked.robot, timeout_s=30.0) as made:
        yield made


def test_a_finger_stops_on_touch(programs: Any, asked: Any, gripper: Gripper) -> None:
    async def act() -> None:
        await programs("common").fresh(gripper, "block", asked.live)
        await programs("stop_on_touch").stop_on_touch(gripper, asked.live, "index", 0.02)

    asyncio.run(act())
    stopped = gripper.look()
    assert 0 < stopped.truth["index_depth_m"] < 2 * TOO_LATE_M
    assert stopped.position_m["index"] < 0.013


def test_a_grip_force_is_kept_while_the_object_gives_way(programs: Any, asked: Any, gripper: Gripper) -> None:
    keep = programs("keep_force")

    async def act() -> None:
        await programs("common").fresh(gripper, "block", asked.live)
        for finger in ("thumb", "index"):
            await programs("stop_on_touch").stop_on_touch(gripper, asked.live, finger)
        await keep.keep_force(gripper, asked.live, keep.ForceControl(2.0), 2.5)

    asyncio.run(act())
    assert gripper.look().truth["index_force_n"] == pytest.approx(2.0, rel=0.05)


def test_an_edge_stays_under_the_middle_of_the_pad(programs: Any, asked: Any, gripper: Gripper) -> None:
    pytest.importorskip("pinocchio")
    follow = programs("follow_edge")

    async def act() -> list[tuple[float, float]]:
        await programs("common").fresh(gripper, "edge", asked.live)
        await programs("stop_on_touch").stop_on_touch(gripper, asked.live, "index")
        return list(await follow.follow_edge(gripper, asked.live, 0.04))

    request("scene", outputs=["location", "strength", "base"], endpoint=asked.control, timeout_s=30.0)
    begin_m = gripper.look().truth.get("along_m", 0.0)
    errors = asyncio.run(act())
    assert gripper.look().truth["along_m"] - begin_m > 0.03
    assert errors[0][1] > 1.5e-3  # it has something to do
    assert max(error for along, error in errors if along > 0.01) < 1e-3


def test_an_object_that_slips_is_gripped_harder(programs: Any, asked: Any, gripper: Gripper) -> None:
    slip = programs("stop_slip")
    lost, careless_m = asyncio.run(slip.pulled(gripper, asked.live, careful=False))
    assert careless_m > 0.0115  # out of the grip
    assert lost.truth["thumb_force_n"] == 0.0
    for _ in range(PULLS):  # a machine that pauses lets any block go; without the reaction every one goes
        held, careful_m = asyncio.run(slip.pulled(gripper, asked.live, careful=True))
        if held.truth["thumb_force_n"] > 0:
            break
    assert careful_m < 0.6 * careless_m
    assert held.truth["thumb_force_n"] > 2 * slip.HOLD_N


def test_the_notebook_logs_and_plots(programs: Any, asked: Any, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    figure = tmp_path / "contacts.png"
    assert programs("run_all").log(asked.live, figure, 1.0).wait(60) == 0
    assert figure.stat().st_size > 10_000


# --- the gripper itself


def pressed(world: GripperWorld, depth_m: float) -> float:
    """Close both fingers until each is so deep in the block; the time then."""
    t_s = 0.0
    while world.truth()["index_depth_m"] < depth_m:
        world.command(t_s, {"thumb": 0.02, "index": 0.02})
        t_s += 0.01
        world.sample(t_s)
    return t_s


def test_forces_of_a_grip_are_equal_and_relax() -> None:
    world = GripperWorld(0.012)
    t_s = pressed(world, 1e-3)
    first = world.truth()
    for step in range(500):
        world.sample(t_s + 0.01 * step)
    last = world.truth()
    assert first["thumb_force_n"] == pytest.approx(first["index_force_n"])
    assert last["index_force_n"] == pytest.approx(1500 * last["index_depth_m"], rel=0.02)
    assert last["index_force_n"] / last["index_depth_m"] < first["index_force_n"] / first["index_depth_m"]


@pytest.mark.parametrize(("share", "slides"), [(0.98, False), (1.02, True)])
def test_an_object_slides_when_the_pull_exceeds_friction(share: float, slides: bool) -> None:
    world = GripperWorld(0.012)
    world.reset("block", relaxing_n_m=0.0)
    t_s = pressed(world, 1e-3) + 0.2
    world.sample(t_s - 0.16)
    for step in range(20):
        world.sample(t_s - 0.15 + 0.01 * step)
    truth = world.truth()
    world.pull(t_s + 0.05, share * 0.5 * (truth["thumb_force_n"] + truth["index_force_n"]), 0.0)
    for step in range(50):
        world.sample(t_s + 0.05 + 0.01 * step)
    assert (world.truth()["slipped_m"] > 0) is slides


def test_joints_stop_when_nobody_commands_them() -> None:
    world = GripperWorld(0.012)
    world.command(0.0, {"reach": 0.1})
    for step in range(100):
        world.sample(0.01 * step)
    assert world.position_m["reach"] == pytest.approx(0.1 * COMMAND_S, rel=0.1)


@pytest.mark.parametrize(
    ("thing", "numbers", "told"),
    [
        ("ball", {}, "there are: block, edge"),
        ("block", {"colour": 1.0}, "width_m"),
        ("edge", {"wave_m": 0.0}, "wave_m"),
    ],
)
def test_wrong_objects_are_refused_with_what_there_is(
    thing: str, numbers: dict[str, float], told: str
) -> None:
    with pytest.raises(ValueError, match=told):
        GripperWorld(0.012).reset(thing, **numbers)
