"""Scenes: union, leases, and computation of requested and subscribed outputs only."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch import wire
from handtouch.config.tables import SceneRequest
from handtouch.core.linearisation import POSITION_COLUMNS, ContactLinearisations
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import (
    CONTROL_OWNER,
    FILE_OWNER,
    MAX_CLIENTS,
    ActiveScenes,
    Demand,
    merge_scenes,
    select_pads,
)
from handtouch.wire import PadState

PERIOD_NS = 5_000_000
NAMES = [("left", "thumb_tip"), ("left", "palm"), ("right", "thumb_tip"), ("right", "palm")]
SECOND = 10**9
scene_requests = st.builds(
    SceneRequest,
    links=st.lists(st.sampled_from(["*", "thumb_*", "left/palm", "right/*"]), max_size=3).map(tuple),
    outputs=st.lists(st.sampled_from(["position", "force", "raw"]), max_size=3).map(tuple),
    tolerance_mm=st.floats(0, 10),
    rate_hz=st.none() | st.floats(1, 1000),
)


def test_patterns_select_pads_of_all_hands_or_of_one() -> None:
    assert select_pads(["thumb_*"], NAMES).tolist() == [True, False, True, False]
    assert select_pads(["left/*", "right/palm"], NAMES).tolist() == [True, True, False, True]
    assert not select_pads([], NAMES).any()
    with pytest.raises(ValueError, match=r"nowhere.*left/thumb_tip"):
        select_pads(["*", "nowhere"], NAMES)


@given(st.lists(scene_requests, max_size=4), scene_requests)
def test_an_additional_scene_removes_nothing(present: list[SceneRequest], more: SceneRequest) -> None:
    before, after = merge_scenes(present, NAMES), merge_scenes([*present, more], NAMES)
    for name in ("pads", "position", "force", "raw"):
        assert (getattr(after, name) >= getattr(before, name)).all()
    assert (after.tolerance_m[before.pads] <= before.tolerance_m[before.pads]).all()
    assert (after.rate_hz >= before.rate_hz).all()
    mine = select_pads(more.links, NAMES)
    assert (after.tolerance_m[mine] <= more.tolerance_mm * 1e-3).all()
    assert (after.rate_hz[mine] >= (more.rate_hz or np.inf)).all()
    assert merge_scenes([more, *present], NAMES).pads.tolist() == after.pads.tolist()


def test_a_clients_scene_ends_with_its_lease_unless_it_is_renewed() -> None:
    scenes = ActiveScenes(SceneRequest(links=("left/*",)), NAMES)
    scenes.set_client_scene("planner", SceneRequest(links=("right/palm",)), SECOND, 0)
    version = scenes.version
    assert scenes.requirements.pads.tolist() == [True, True, False, True]
    scenes.expire_leases(SECOND // 2)
    scenes.set_client_scene("planner", SceneRequest(links=("right/palm",)), SECOND, SECOND // 2)
    assert scenes.version == version  # unchanged
    scenes.expire_leases(SECOND + SECOND // 2 - 1)
    assert scenes.requirements.pads[3]
    scenes.expire_leases(SECOND + SECOND // 2)
    assert scenes.requirements.pads.tolist() == [True, True, False, False]
    scenes.remove_client("planner")


def test_control_replaces_and_restores_the_scene_of_the_file() -> None:
    scenes = ActiveScenes(SceneRequest(), NAMES)
    scenes.set_base(SceneRequest(links=("left/palm",)))
    assert list(scenes.by_owner()) == [CONTROL_OWNER]
    scenes.set_file(SceneRequest(links=("right/*",)))
    assert scenes.requirements.pads.tolist() == [False, True, False, False]
    scenes.set_base(None)
    assert list(scenes.by_owner()) == [FILE_OWNER]
    assert scenes.requirements.pads.tolist() == [False, False, True, True]


def test_a_scene_that_names_no_pad_changes_nothing() -> None:
    scenes = ActiveScenes(SceneRequest(), NAMES)
    wrong = SceneRequest(links=("nowhere",))
    with pytest.raises(ValueError, match="nowhere"):
        scenes.set_base(wrong)
    with pytest.raises(ValueError, match="nowhere"):
        scenes.set_client_scene("a", wrong, SECOND, 0)
    assert list(scenes.by_owner()) == [FILE_OWNER]
    assert scenes.version == 0


def test_the_number_of_clients_is_limited() -> None:
    scenes = ActiveScenes(SceneRequest(), NAMES)
    for number in range(MAX_CLIENTS):
        scenes.set_client_scene(f"c{number}", SceneRequest(), SECOND, 0)
    with pytest.raises(ValueError, match="already"):
        scenes.set_client_scene("one more", SceneRequest(), SECOND, 0)
    scenes.set_client_scene("c0", SceneRequest(links=("left/*",)), SECOND, 0)


class TouchedPads:
    """A pipeline with three touched pads, a scene and subscriptions; collects messages."""

    def __init__(self, bench: Any, scene: SceneRequest, *subscriptions: str) -> None:
        self.subscriptions = frozenset(prefix.encode() for prefix in subscriptions)
        self.messages: list[Any] = []
        self.pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, self)
        self.pipeline.node_state[:] = PadState.CLEAR
        self.solved: list[int] = []
        solve = self.pipeline.tick.linearisations.evaluate
        self.pipeline.tick.linearisations.evaluate = lambda pads, currents: (  # type: ignore[method-assign]
            self.solved.extend(pads.tolist()) or solve(pads, currents)  # type: ignore[func-returns-value]
        )
        self.touched = [bench.counts(pad, 0.4, 0.6, 1e-3).tobytes() for pad in range(3)]
        names = list(zip(bench.model.hands, bench.model.links, strict=True))
        self.demand = Demand(ActiveScenes(scene, names), self, 200.0, self._apply)
        self.t_ns = SECOND
        self.demand.update(self.t_ns)

    def _apply(self, requested: Any, needed: Any, enabled: Any, now_ns: int) -> None:
        del needed, enabled, now_ns
        self.pipeline.apply_demand(requested)
        self.pipeline.ticks_per_hand_frame = self.demand.ticks_per_hand_frame

    def has_subscriber(self, topic: str) -> bool:
        return any(topic.encode().startswith(prefix) for prefix in self.subscriptions)

    def send(self, message: wire.OutgoingMessage) -> None:
        self.messages.append(wire.decode(wire.encode(message)))

    def run(self, ticks: int) -> list[Any]:
        """Return the messages sent during some ticks."""
        before = len(self.messages)
        for _ in range(ticks):
            self.t_ns += PERIOD_NS
            self.pipeline.begin_cycle(self.t_ns, self.t_ns)
            for pad, data in enumerate(self.touched):
                self.pipeline.slab.write_pdo(pad, data, self.t_ns + 1000)
            self.pipeline.tick_if_due(self.t_ns + PERIOD_NS - 1)
            self.demand.update(self.t_ns)
        return self.messages[before:]

    def rows(self) -> dict[str, Any]:
        return {row["link"]: row for row in self.demand.describe_pads()}


def test_nothing_is_solved_or_encoded_without_a_subscriber(bench: Any) -> None:
    rig = TouchedPads(bench, SceneRequest())
    assert rig.run(6) == []
    assert rig.solved == []
    assert rig.pipeline.tick.contacts.touching.all()  # contacts are detected
    rig.subscriptions = frozenset([b"contact/h/round"])
    rig.run(6)
    assert set(rig.solved) == {1}
    assert {(m.link, m.position_status) for m in rig.messages[1:]} == {("round", "valid")}
    assert rig.rows()["plane"]["not_computed"]["position"] == "no subscriber"
    assert rig.rows()["round"]["subscriptions"] == ["contact/h/round"]
    rig.subscriptions = frozenset([b"hand/"])
    rig.solved.clear()
    rig.run(3)
    assert set(rig.solved) == {0, 1, 2}


def test_outputs_in_no_scene_are_not_computed_and_reported(bench: Any) -> None:
    rig = TouchedPads(bench, SceneRequest(links=("plane", "round"), outputs=("position",)), "contact/")
    last = {m.link: m for m in rig.run(6)}
    assert last["plane"].position_status == "valid"
    assert (last["plane"].force_status, last["plane"].force_n, last["plane"].force_std_n) == (
        "not_computed",
        None,
        None,
    )
    assert (last["resisted"].position_status, last["resisted"].position_m) == ("not_computed", None)
    assert last["resisted"].total_current_a > 0
    assert rig.rows()["plane"]["not_computed"]["force"] == "in no scene's outputs"
    assert rig.rows()["resisted"]["not_computed"]["contact"] == "in no scene"
    assert set(rig.solved) == {0, 1}


def test_a_position_is_the_same_with_and_without_force(bench: Any) -> None:
    full = TouchedPads(bench, SceneRequest(), "contact/").run(6)[-3:]
    less = TouchedPads(bench, SceneRequest(outputs=("position",)), "contact/").run(6)[-3:]
    for one, other in zip(full, less, strict=True):
        np.testing.assert_allclose(one.position_m, other.position_m, atol=1e-9)
        np.testing.assert_allclose(one.covariance_m2, other.covariance_m2, rtol=1e-6)


def test_force_is_computed_during_the_lease_of_a_client(bench: Any) -> None:
    rig = TouchedPads(bench, SceneRequest(outputs=("position",)), "contact/")
    rig.run(6)
    lease = 10 * PERIOD_NS
    rig.demand.scenes.set_client_scene("planner", SceneRequest(links=("round",)), lease, rig.t_ns)
    rig.run(3)
    assert {m.link: m.force_status for m in rig.run(1)} == {
        "plane": "not_computed",
        "round": "valid",
        "resisted": "not_computed",
    }
    assert rig.rows()["round"]["scenes"] == [FILE_OWNER, "client planner"]
    rig.run(10)
    assert {m.force_status for m in rig.run(1)} == {"not_computed"}


def test_a_lower_rate_reduces_updates_and_frames_but_delays_no_begin_or_end(bench: Any) -> None:
    rig = TouchedPads(bench, SceneRequest(rate_hz=20.0), "contact/h/plane", "hand/")
    pressed, released = rig.touched, [bytes(8)] * 3
    sent: dict[str, list[int]] = {"begin": [], "update": [], "end": [], "frame": []}
    for number in range(61):
        rig.touched = pressed if 3 <= number < 48 else released
        for message in rig.run(1):
            kind = "frame" if isinstance(message, wire.HandFrame) else message.event
            sent[kind].append(number)
    assert sent["begin"] == [4]  # two samples above the threshold
    assert sent["end"] == [49]
    assert np.diff(sent["update"]).tolist() == [10] * (len(sent["update"]) - 1)
    assert len(sent["update"]) == 4
    assert np.diff(sent["frame"]).tolist() == [10] * 5
    assert rig.rows()["plane"]["rate_hz"] == 20.0
    contacts = [m for m in rig.messages if isinstance(m, wire.Contact)]
    assert [m.seq for m in contacts] == list(range(1, len(contacts) + 1))  # no gaps


@pytest.mark.parametrize("tolerance_mm", [0.05, 0.2, 1.0])
def test_sliding_contacts_stay_within_the_tolerance(bench: Any, tolerance_mm: float) -> None:
    exact = TouchedPads(bench, SceneRequest(), "contact/")
    tolerant = TouchedPads(bench, SceneRequest(tolerance_mm=tolerance_mm), "contact/")
    errors, calls = [], {id(exact): 0, id(tolerant): 0}
    for rig in (exact, tolerant):
        linearise = rig.pipeline.tick.linearisations.linearise

        def counted(*arguments: Any, me: int = id(rig), linearise: Any = linearise, **more: Any) -> Any:
            calls[me] += len(arguments[0])
            return linearise(*arguments, **more)

        rig.pipeline.tick.linearisations.linearise = counted  # type: ignore[method-assign]
    for step in range(300):
        x, y = 0.5 + 0.35 * np.sin(step / 60), 0.5 + 0.35 * np.cos(step / 40)
        for rig in (exact, tolerant):
            rig.touched = [bench.counts(pad, x, y, 1e-3).tobytes() for pad in range(3)]
            rig.run(1)
        if step > 3:
            positions = [s.pipeline.tick.columns.position_m.copy() for s in (exact, tolerant)]
            errors.append(np.linalg.norm(positions[0] - positions[1], axis=1).max())
    assert max(errors) * 1e3 <= tolerance_mm
    assert calls[id(tolerant)] < 0.8 * calls[id(exact)]


@pytest.mark.parametrize("tolerance_mm", [0.05, 0.2, 1.0, 10.0])
def test_a_linearisation_is_used_within_the_tolerance_only(bench: Any, tolerance_mm: float) -> None:
    model, chance = bench.model, np.random.default_rng(8)
    pads, sides = np.arange(3), bench.model.locator.sides

    def currents(at: Any) -> Any:
        return (model.locator.fractions(pads, *at.T) * (20 * model.begin_threshold_a)).T

    linearisations, error_m, valid = ContactLinearisations(model), 0.0, 0
    linearisations.tolerance_m[:] = tolerance_mm * 1e-3
    for _ in range(100):
        centre = chance.uniform(0.1, 0.9, (3, 2)) * sides
        linearisations.linearise(pads, currents(centre), centre, solved=True)
        for _ in range(20):
            offset = chance.normal(size=(3, 2)) * 1e-3 * np.sqrt(tolerance_mm)
            at = np.clip(centre + offset, 0.02 * sides, 0.98 * sides)
            values, off = linearisations.evaluate(pads, currents(at))
            inside = off.max(axis=1) <= 1
            true = model.placement.to_link_frame(pads, *at.T, np.zeros((3, 2, 2))).position_m
            apart = np.linalg.norm(values[:, POSITION_COLUMNS] - true, axis=1)[inside]
            error_m, valid = max(error_m, *apart, 0.0), valid + len(apart)
    assert valid > 500
    assert error_m * 1e3 <= tolerance_mm


def test_a_disabled_pad_is_not_computed_with_any_subscription(bench: Any) -> None:
    rig = TouchedPads(bench, SceneRequest(), "contact/")
    rig.demand.disable([1], "operator")
    rig.run(6)
    assert set(rig.solved) == {0, 2}
    assert rig.rows()["round"]["not_computed"]["position"] == "disabled by operator"
    rig.demand.enable([1])
    rig.run(2)
    assert 1 in rig.solved


def test_scenes_are_merged_after_changes_only(bench: Any) -> None:
    rig = TouchedPads(bench, SceneRequest(), "contact/")
    merged: list[int] = []
    rig.demand._apply = lambda *_: merged.append(1)
    rig.run(5)
    assert merged == []
    rig.subscriptions = frozenset([b"hand/"])
    rig.run(5)
    assert merged == [1]
