"""Scenes: their union, their leases, and that only what is held and heard is computed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch import wire
from handtouch.config.tables import Wants
from handtouch.daemon.follow import POSITION, Follower
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.scene import CONTROL, FILE, MOST_CLIENTS, Demand, Scenes, join, select
from handtouch.wire import PadState

PERIOD_NS = 5_000_000
NAMES = [("left", "thumb_tip"), ("left", "palm"), ("right", "thumb_tip"), ("right", "palm")]
SECOND = 10**9
wants = st.builds(
    Wants,
    links=st.lists(st.sampled_from(["*", "thumb_*", "left/palm", "right/*"]), max_size=3).map(tuple),
    outputs=st.lists(st.sampled_from(["location", "strength", "raw"]), max_size=3).map(tuple),
    tolerance_mm=st.floats(0, 10),
    rate_hz=st.none() | st.floats(1, 1000),
)


def test_patterns_name_pads_of_all_hands_or_of_one() -> None:
    assert select(["thumb_*"], NAMES).tolist() == [True, False, True, False]
    assert select(["left/*", "right/palm"], NAMES).tolist() == [True, True, False, True]
    assert not select([], NAMES).any()
    with pytest.raises(ValueError, match=r"nowhere.*left/thumb_tip"):
        select(["*", "nowhere"], NAMES)


@given(st.lists(wants, max_size=4), wants)
def test_one_more_scene_never_takes_anything_away(held: list[Wants], more: Wants) -> None:
    before, after = join(held, NAMES), join([*held, more], NAMES)
    for name in ("pads", "location", "strength", "raw"):
        assert (getattr(after, name) >= getattr(before, name)).all()
    assert (after.tolerance_m[before.pads] <= before.tolerance_m[before.pads]).all()
    assert (after.rate_hz >= before.rate_hz).all()
    mine = select(more.links, NAMES)
    assert (after.tolerance_m[mine] <= more.tolerance_mm * 1e-3).all()
    assert (after.rate_hz[mine] >= (more.rate_hz or np.inf)).all()
    assert join([more, *held], NAMES).pads.tolist() == after.pads.tolist()


def test_a_clients_scene_ends_with_its_lease_unless_it_is_renewed() -> None:
    scenes = Scenes(Wants(links=("left/*",)), NAMES)
    scenes.hold("planner", Wants(links=("right/palm",)), SECOND, 0)
    version = scenes.version
    assert scenes.needs.pads.tolist() == [True, True, False, True]
    scenes.poll(SECOND // 2)
    scenes.hold("planner", Wants(links=("right/palm",)), SECOND, SECOND // 2)
    assert scenes.version == version  # nothing to do anew
    scenes.poll(SECOND + SECOND // 2 - 1)
    assert scenes.needs.pads[3]
    scenes.poll(SECOND + SECOND // 2)
    assert scenes.needs.pads.tolist() == [True, True, False, False]
    scenes.leave("planner")


def test_control_replaces_the_files_scene_and_gives_it_back() -> None:
    scenes = Scenes(Wants(), NAMES)
    scenes.set_base(Wants(links=("left/palm",)))
    assert list(scenes.all()) == [CONTROL]
    scenes.set_file(Wants(links=("right/*",)))
    assert scenes.needs.pads.tolist() == [False, True, False, False]
    scenes.set_base(None)
    assert list(scenes.all()) == [FILE]
    assert scenes.needs.pads.tolist() == [False, False, True, True]


def test_a_scene_that_names_no_pad_changes_nothing() -> None:
    scenes = Scenes(Wants(), NAMES)
    wrong = Wants(links=("nowhere",))
    with pytest.raises(ValueError, match="nowhere"):
        scenes.set_base(wrong)
    with pytest.raises(ValueError, match="nowhere"):
        scenes.hold("a", wrong, SECOND, 0)
    assert list(scenes.all()) == [FILE]
    assert scenes.version == 0


def test_clients_are_bounded() -> None:
    scenes = Scenes(Wants(), NAMES)
    for number in range(MOST_CLIENTS):
        scenes.hold(f"c{number}", Wants(), SECOND, 0)
    with pytest.raises(ValueError, match="already"):
        scenes.hold("one more", Wants(), SECOND, 0)
    scenes.hold("c0", Wants(links=("left/*",)), SECOND, 0)


class Served:
    """A pipeline with all three pads touched, in a scene, heard by some; messages are kept."""

    def __init__(self, bench: Any, scene: Wants, *subscriptions: str) -> None:
        self.subscriptions = frozenset(prefix.encode() for prefix in subscriptions)
        self.messages: list[Any] = []
        self.pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, self)
        self.pipeline.node_state[:] = PadState.CLEAR
        self.solved: list[int] = []
        solve = self.pipeline.tick.follower.read
        self.pipeline.tick.follower.read = lambda pads, currents: (  # type: ignore[method-assign]
            self.solved.extend(pads.tolist()) or solve(pads, currents)  # type: ignore[func-returns-value]
        )
        self.touched = [bench.counts(pad, 0.4, 0.6, 1e-3).tobytes() for pad in range(3)]
        names = list(zip(bench.model.hands, bench.model.links, strict=True))
        self.demand = Demand(Scenes(scene, names), self, 200.0, self._apply)
        self.t_ns = SECOND
        self.demand.step(self.t_ns)

    def _apply(self, wanted: Any, needs: Any, enabled: Any, now_ns: int) -> None:
        del needs, enabled, now_ns
        self.pipeline.want(wanted)
        self.pipeline.frames_every = self.demand.frames_every

    def wants(self, topic: str) -> bool:
        return any(topic.encode().startswith(prefix) for prefix in self.subscriptions)

    def send(self, message: wire.Outgoing) -> None:
        self.messages.append(wire.decode(wire.encode(message)))

    def run(self, ticks: int) -> list[Any]:
        """What was sent meanwhile."""
        before = len(self.messages)
        for _ in range(ticks):
            self.t_ns += PERIOD_NS
            self.pipeline.begin(self.t_ns, self.t_ns)
            for pad, data in enumerate(self.touched):
                self.pipeline.slab.write(pad, data, self.t_ns + 1000)
            self.pipeline.advance(self.t_ns + PERIOD_NS - 1)
            self.demand.step(self.t_ns)
        return self.messages[before:]

    def rows(self) -> dict[str, Any]:
        return {row["link"]: row for row in self.demand.tell()}


def test_nothing_is_solved_or_encoded_that_nobody_hears(bench: Any) -> None:
    served = Served(bench, Wants())
    assert served.run(6) == []
    assert served.solved == []
    assert served.pipeline.tick.contacts.touching.all()  # touched and clear are followed
    served.subscriptions = frozenset([b"contact/h/round"])
    served.run(6)
    assert set(served.solved) == {1}
    assert {(m.link, m.location) for m in served.messages[1:]} == {("round", "valid")}
    assert served.rows()["plane"]["skipped"]["location"] == "nobody subscribed"
    assert served.rows()["round"]["subscriptions"] == ["contact/h/round"]
    served.subscriptions = frozenset([b"hand/"])
    served.solved.clear()
    served.run(3)
    assert set(served.solved) == {0, 1, 2}


def test_what_is_in_no_scene_is_skipped_and_says_so(bench: Any) -> None:
    served = Served(bench, Wants(links=("plane", "round"), outputs=("location",)), "contact/")
    last = {m.link: m for m in served.run(6)}
    assert last["plane"].location == "valid"
    assert (last["plane"].strength, last["plane"].force_n, last["plane"].force_std_n) == (
        "skipped",
        None,
        None,
    )
    assert (last["resisted"].location, last["resisted"].position_m) == ("skipped", None)
    assert last["resisted"].current_a > 0
    assert served.rows()["plane"]["skipped"]["strength"] == "in no scene's outputs"
    assert served.rows()["resisted"]["skipped"]["touched"] == "outside every scene"
    assert set(served.solved) == {0, 1}


def test_a_place_is_the_same_with_and_without_its_strength(bench: Any) -> None:
    full = Served(bench, Wants(), "contact/").run(6)[-3:]
    less = Served(bench, Wants(outputs=("location",)), "contact/").run(6)[-3:]
    for mine, theirs in zip(full, less, strict=True):
        np.testing.assert_allclose(mine.position_m, theirs.position_m, atol=1e-9)
        np.testing.assert_allclose(mine.covariance_m2, theirs.covariance_m2, rtol=1e-6)


def test_strength_comes_back_when_a_client_asks_and_goes_with_its_lease(bench: Any) -> None:
    served = Served(bench, Wants(outputs=("location",)), "contact/")
    served.run(6)
    lease = 10 * PERIOD_NS
    served.demand.scenes.hold("planner", Wants(links=("round",)), lease, served.t_ns)
    served.run(3)
    assert {m.link: m.strength for m in served.run(1)} == {
        "plane": "skipped",
        "round": "valid",
        "resisted": "skipped",
    }
    assert served.rows()["round"]["scenes"] == [FILE, "client planner"]
    served.run(10)
    assert {m.strength for m in served.run(1)} == {"skipped"}


def test_a_lower_rate_thins_updates_and_frames_but_delays_no_begin_and_no_end(bench: Any) -> None:
    served = Served(bench, Wants(rate_hz=20.0), "contact/h/plane", "hand/")
    pressed, released = served.touched, [bytes(8)] * 3
    sent: dict[str, list[int]] = {"begin": [], "update": [], "end": [], "frame": []}
    for number in range(61):
        served.touched = pressed if 3 <= number < 48 else released
        for message in served.run(1):
            kind = "frame" if isinstance(message, wire.HandFrame) else message.event
            sent[kind].append(number)
    assert sent["begin"] == [4]  # two samples above the threshold
    assert sent["end"] == [49]
    assert np.diff(sent["update"]).tolist() == [10] * (len(sent["update"]) - 1)
    assert len(sent["update"]) == 4
    assert np.diff(sent["frame"]).tolist() == [10] * 5
    assert served.rows()["plane"]["rate_hz"] == 20.0
    contacts = [m for m in served.messages if isinstance(m, wire.Contact)]
    assert [m.seq for m in contacts] == list(range(1, len(contacts) + 1))  # no gap is a loss


@pytest.mark.parametrize("tolerance_mm", [0.05, 0.2, 1.0])
def test_sliding_contacts_stay_within_the_tolerance(bench: Any, tolerance_mm: float) -> None:
    exact = Served(bench, Wants(), "contact/")
    tolerant = Served(bench, Wants(tolerance_mm=tolerance_mm), "contact/")
    off, draws = [], {id(exact): 0, id(tolerant): 0}
    for served in (exact, tolerant):
        draw = served.pipeline.tick.follower.draw

        def counted(*arguments: Any, me: int = id(served), draw: Any = draw, **more: Any) -> Any:
            draws[me] += len(arguments[0])
            return draw(*arguments, **more)

        served.pipeline.tick.follower.draw = counted  # type: ignore[method-assign]
    for step in range(300):
        x, y = 0.5 + 0.35 * np.sin(step / 60), 0.5 + 0.35 * np.cos(step / 40)
        for served in (exact, tolerant):
            served.touched = [bench.counts(pad, x, y, 1e-3).tobytes() for pad in range(3)]
            served.run(1)
        if step > 3:
            places = [s.pipeline.tick.columns.position_m.copy() for s in (exact, tolerant)]
            off.append(np.linalg.norm(places[0] - places[1], axis=1).max())
    assert max(off) * 1e3 <= tolerance_mm
    assert draws[id(tolerant)] < 0.8 * draws[id(exact)]


@pytest.mark.parametrize("tolerance_mm", [0.05, 0.2, 1.0, 10.0])
def test_a_map_is_trusted_no_farther_than_the_tolerance(bench: Any, tolerance_mm: float) -> None:
    model, chance = bench.model, np.random.default_rng(8)
    pads, sides = np.arange(3), bench.model.locator.sides

    def currents(at: Any) -> Any:
        return (model.locator.fractions(pads, *at.T) * (20 * model.on_a)).T

    follower, found, trusted = Follower(model), 0.0, 0
    follower.tolerance_m[:] = tolerance_mm * 1e-3
    for _ in range(100):
        drawn = chance.uniform(0.1, 0.9, (3, 2)) * sides
        follower.draw(pads, currents(drawn), drawn, solved=True)
        for _ in range(20):
            way = chance.normal(size=(3, 2)) * 1e-3 * np.sqrt(tolerance_mm)
            at = np.clip(drawn + way, 0.02 * sides, 0.98 * sides)
            values, off = follower.read(pads, currents(at))
            inside = off.max(axis=1) <= 1
            true = model.placement.place(pads, *at.T, np.zeros((3, 2, 2))).position_m
            apart = np.linalg.norm(values[:, POSITION] - true, axis=1)[inside]
            found, trusted = max(found, *apart, 0.0), trusted + len(apart)
    assert trusted > 500
    assert found * 1e3 <= tolerance_mm


def test_a_disabled_pad_is_not_computed_whoever_wants_it(bench: Any) -> None:
    served = Served(bench, Wants(), "contact/")
    served.demand.disable([1], "operator")
    served.run(6)
    assert set(served.solved) == {0, 2}
    assert served.rows()["round"]["skipped"]["location"] == "disabled by operator"
    served.demand.enable([1])
    served.run(2)
    assert 1 in served.solved


def test_nothing_is_joined_anew_while_nothing_changes(bench: Any) -> None:
    served = Served(bench, Wants(), "contact/")
    joined: list[int] = []
    served.demand._apply = lambda *_: joined.append(1)
    served.run(5)
    assert joined == []
    served.subscriptions = frozenset([b"hand/"])
    served.run(5)
    assert joined == [1]
