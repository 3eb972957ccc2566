"""Scenes: union, leases, and computation of requested and subscribed outputs only."""

from __future__ import annotations

import time
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch import wire
from handtouch.client import columns
from handtouch.config.tables import SceneRequest
from handtouch.core.pad_patterns import PadNames
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import (
    CONTROL_OWNER,
    FILE_OWNER,
    MAX_CLIENTS,
    ActiveScenes,
    Demand,
    SceneRequirements,
)
from handtouch.wire import PadState

PERIOD_NS = 5_000_000
NAMES = [("left", "thumb_tip"), ("left", "palm"), ("right", "thumb_tip"), ("right", "palm")]
SECOND = 10**9
scene_requests = st.builds(
    SceneRequest,
    links=st.lists(st.sampled_from(["*", "thumb_*", "left/palm", "right/*"]), max_size=3).map(tuple),
    outputs=st.lists(st.sampled_from(["position", "force", "raw"]), max_size=3).map(tuple),
    rate_hz=st.none() | st.floats(1, 1000),
)


PARTS = st.sampled_from(
    ["*", "?", "[", "]", "!", "[a-m]", "[!lp]", "[]-a]", "[!]a]", "[a-]", "[p-a]", "z", "^"]
)
ODD_NAMES = [*NAMES, ("r", "a]b"), ("r", "a-b"), ("r", "a!b"), ("r", "a^b"), ("r", "a[b"), ("r", "a")]


def test_patterns_select_pads_of_all_hands_or_of_one() -> None:
    pads = PadNames(NAMES)
    assert pads.select(["thumb_*"]).tolist() == [True, False, True, False]
    assert pads.select(["left/*", "right/palm"]).tolist() == [True, True, False, True]
    assert not pads.select([]).any()
    with pytest.raises(ValueError, match=r"nowhere.*left/thumb_tip"):
        pads.select(["*", "nowhere"])


@given(st.sampled_from(ODD_NAMES), st.booleans(), st.data())
def test_patterns_match_as_those_of_files(name: tuple[str, str], of_hand: bool, data: st.DataObject) -> None:
    """Patterns are names of which some characters were replaced."""
    text = "/".join(name) if of_hand else name[1]
    pattern = "".join(data.draw(st.just(character) | PARTS) for character in text)
    full = pattern if "/" in pattern else f"*/{pattern}"
    expected = [fnmatchcase("/".join(known), full) for known in ODD_NAMES]
    if any(expected):
        assert PadNames(ODD_NAMES).select([pattern]).tolist() == expected
    else:
        with pytest.raises(ValueError, match="no pad is named"):
            PadNames(ODD_NAMES).select([pattern])


def merged(scenes: list[SceneRequest]) -> SceneRequirements:
    """Return what scenes require together: of a base, and of a client each."""
    active = ActiveScenes(scenes[0], NAMES)
    for number, scene in enumerate(scenes[1:]):
        active.set_client_scene(f"c{number}", scene, SECOND, 0)
    return active.requirements


@given(st.lists(scene_requests, min_size=1, max_size=4), scene_requests)
def test_an_additional_scene_removes_nothing(present: list[SceneRequest], more: SceneRequest) -> None:
    before, after = merged(present), merged([*present, more])
    for name in ("pads", "position", "force", "raw"):
        assert (getattr(after, name) >= getattr(before, name)).all()
    assert (after.rate_hz >= before.rate_hz).all()
    mine = PadNames(NAMES).select(more.links)
    assert (after.rate_hz[mine] >= (more.rate_hz or np.inf)).all()
    for name in ("position", "force", "raw"):
        assert (getattr(after, name) >= (mine & (name in more.outputs))).all()
    assert merged([more, *present]).pads.tolist() == after.pads.tolist()


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
        self.touched = [bench.counts(pad, 0.4, 0.6, 1e-3).tobytes() for pad in range(3)]
        names = list(zip(bench.model.hands, bench.model.links, strict=True))
        self.demand = Demand(ActiveScenes(scene, names), self, 200.0, self._apply)
        self.t_ns = SECOND
        self.demand.update(self.t_ns)

    @property
    def solved(self) -> set[int]:
        """Pads whose contact has a computed position."""
        return set(np.flatnonzero(np.isfinite(self.pipeline.tick.columns.xy[:, 0])).tolist())

    def _apply(self, requested: Any, needed: Any, enabled: Any, now_ns: int) -> None:
        del needed, enabled, now_ns
        self.pipeline.apply_demand(requested, self.demand.ticks_per_hand_frame)

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
    assert not rig.solved
    assert rig.pipeline.tick.state.touching.all()  # contacts are detected
    rig.subscriptions = frozenset([b"contact/h/round"])
    rig.run(6)
    assert rig.solved == {1}
    assert {(m.link, m.position_status) for m in rig.messages[1:]} == {("round", "valid")}
    assert rig.rows()["plane"]["not_computed"]["position"] == "no subscriber"
    assert rig.rows()["round"]["subscriptions"] == ["contact/h/round"]
    rig.subscriptions = frozenset([b"hand/"])
    rig.run(3)
    assert rig.solved == {0, 1, 2}


@pytest.mark.parametrize("released", [False, True])
def test_a_contact_that_was_not_requested_before_is_not_computed_instead_of_invalid(
    bench: Any, released: bool
) -> None:
    rig = TouchedPads(bench, SceneRequest())
    rig.run(6)
    rig.subscriptions = frozenset([b"contact/h/round", b"hand/"])
    rig.demand.update(rig.t_ns)
    retained = rig.pipeline.messages.retained_messages()
    messages = [retained[topic](rig.t_ns) for topic in ("contact/h/round", "hand/h")]
    contact, frame = (wire.decode(wire.encode(message)) for message in messages if message is not None)
    assert isinstance(contact, wire.Contact)
    assert isinstance(frame, wire.HandFrame)
    rows = columns(frame)
    if released:
        rig.touched = [bytes(8)] * 3
        contact = next(m for m in rig.run(8) if isinstance(m, wire.Contact) and m.event == "end")
    assert (contact.position_status, contact.force_status) == ("not_computed", "not_computed")
    assert set(rows["position_status"].tolist()) == set(rows["force_status"].tolist()) == {0}
    if not released:
        assert {m.position_status for m in rig.run(2) if isinstance(m, wire.Contact)} == {"valid"}


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
    assert rig.solved == {0, 1}


def test_a_position_is_the_same_with_and_without_force(bench: Any) -> None:
    full = TouchedPads(bench, SceneRequest(), "contact/").run(6)[-3:]
    less = TouchedPads(bench, SceneRequest(outputs=("position",)), "contact/").run(6)[-3:]
    for one, other in zip(full, less, strict=True):
        np.testing.assert_allclose(one.position_m, other.position_m, atol=1e-9)
        np.testing.assert_allclose(one.covariance_m2, other.covariance_m2, rtol=1e-6)


def test_force_is_computed_during_the_lease_of_a_client(bench: Any) -> None:
    rig = TouchedPads(bench, SceneRequest(outputs=("position",)), "contact/")
    pressed, rig.touched = rig.touched, [bytes(8)] * 3
    rig.run(40)  # until the baselines are known
    rig.touched = pressed
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


def test_a_disabled_pad_is_not_computed_with_any_subscription(bench: Any) -> None:
    rig = TouchedPads(bench, SceneRequest(), "contact/")
    rig.demand.disable([1], "operator")
    rig.run(6)
    assert rig.solved == {0, 2}
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


def test_a_scene_s_patterns_are_matched_once() -> None:
    """However many clients have scenes, a further one and their description cost no more matching."""
    names = [("right", f"link_{number}") for number in range(15)]
    scenes = ActiveScenes(SceneRequest(), names)
    worst_s = 0.0
    for client in range(MAX_CLIENTS):
        links = tuple(f"*/*[!{31 * client + number}]" for number in range(30))
        begin_s = time.process_time()
        scenes.set_client_scene(f"c{client}", SceneRequest(links=links), 10**12, 0)
        scenes.describe(0)
        worst_s = max(worst_s, time.process_time() - begin_s)
    assert worst_s < 0.02


def test_the_patterns_of_all_clients_are_bounded() -> None:
    scenes = ActiveScenes(SceneRequest(), NAMES)
    links = ("*" * 100,) * 100
    for client in range(3):
        scenes.check_size(f"c{client}", links)
        scenes.set_client_scene(f"c{client}", SceneRequest(links=links), 10**12, 0)
    scenes.check_size("c0", links)  # it replaces its own
    held = scenes.version
    with pytest.raises(ValueError, match="characters"):
        scenes.check_size("c3", links)
    scenes.set_client_scene("c0", SceneRequest(links=("*",)), 10**12, 0)
    assert scenes.version == held + 1
