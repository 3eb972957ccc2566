"""The pipeline from SYNC to messages: one tick per cycle, end reasons of contacts."""

from __future__ import annotations

from typing import Any

import pytest

from handtouch import wire
from handtouch.core.pipeline import Pipeline
from handtouch.wire import PadState

PERIOD_NS = 5_000_000
PLANE = 0


class CollectingSink:
    """Collects all messages."""

    def __init__(self) -> None:
        self.messages: list[Any] = []

    def has_subscriber(self, _: str) -> bool:
        return True

    def send(self, message: wire.OutgoingMessage) -> None:
        self.messages.append(wire.decode(wire.encode(message)))

    def contacts(self) -> list[wire.Contact]:
        return [message for message in self.messages if isinstance(message, wire.Contact)]


class Rig:
    """A pipeline with a touched pad."""

    def __init__(self, bench: Any) -> None:
        self.sink = CollectingSink()
        self.pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, self.sink)
        self.pipeline.node_state[:] = PadState.CLEAR
        self.touch = bench.counts(PLANE, 0.5, 0.5, 1e-3).tobytes()
        self.t_ns = 10**9

    def cycle(self, pads: tuple[int, ...] = (0, 1, 2)) -> None:
        self.t_ns += PERIOD_NS
        self.pipeline.begin_cycle(self.t_ns, self.t_ns)
        for pad in pads:
            self.pipeline.slab.write_pdo(
                pad, self.touch if pad == PLANE else bytes(8), self.t_ns + 1000 + pad
            )
        self.pipeline.tick_if_due(self.t_ns + 2000)


@pytest.fixture
def rig(bench: Any) -> Rig:
    made = Rig(bench)
    made.cycle()
    made.pipeline.tick_if_due(made.t_ns + PERIOD_NS // 2 + PERIOD_NS // 4)
    for _ in range(3):
        made.cycle()
    assert made.sink.contacts()[0].event == "begin"
    return made


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        (PadState.LOST, "lost"),
        (PadState.FAULTED, "faulted"),
        (PadState.STARTING, "restarted"),
        (PadState.STALE, "stale"),
    ],
)
def test_a_contact_ends_with_the_state_of_its_node(rig: Rig, state: PadState, reason: str) -> None:
    rig.pipeline.node_state[PLANE] = state
    rig.cycle()
    last = rig.sink.contacts()[-1]
    assert (last.event, last.end_reason) == ("end", reason)


def test_messages_of_a_gap_are_marked_and_age(rig: Rig) -> None:
    fresh = rig.sink.contacts()[-1]
    for _ in range(4):
        rig.cycle(pads=(1, 2))
        rig.pipeline.tick_if_due(rig.t_ns + PERIOD_NS * 3 // 4)
    gap = rig.sink.contacts()[-4:]
    assert [(m.event, m.id, m.t_ns, m.fresh) for m in gap] == [("update", fresh.id, fresh.t_ns, False)] * 4
    assert [m.position_m for m in gap] == [fresh.position_m] * 4
    ages = [message.age_s for message in gap]
    assert ages == sorted(ages)
    assert ages[-1] - ages[0] > 2 * PERIOD_NS * 1e-9
    rig.cycle()
    assert (rig.sink.contacts()[-1].fresh, rig.sink.contacts()[-1].id) == (True, fresh.id)


def test_end_of_session_ends_contacts_and_sends_a_last_frame(rig: Rig) -> None:
    rig.pipeline.end_session(rig.t_ns + PERIOD_NS)
    last = rig.sink.contacts()[-1]
    assert (last.event, last.end_reason) == ("end", "stopped")
    frames = [message for message in rig.sink.messages if isinstance(message, wire.HandFrame)]
    assert set(frames[-1].state) == {PadState.STARTING}
    assert not any(frames[-1].contact_id)


def test_every_cycle_is_ticked_once_even_if_late(rig: Rig) -> None:
    ticks = rig.pipeline.ticks
    for _ in range(4):
        rig.t_ns += PERIOD_NS
        rig.pipeline.begin_cycle(rig.t_ns, rig.t_ns)
    assert rig.pipeline.ticks == ticks + 3


def test_the_tick_runs_with_the_last_expected_sample(rig: Rig) -> None:
    ticks = rig.pipeline.ticks
    rig.t_ns += PERIOD_NS
    rig.pipeline.begin_cycle(rig.t_ns, rig.t_ns)
    for pad in range(3):
        assert rig.pipeline.tick_if_due(rig.t_ns + pad) is None
        rig.pipeline.slab.write_pdo(pad, bytes(8), rig.t_ns + 1000 + pad)
    assert rig.pipeline.tick_if_due(rig.t_ns + 3) is not None
    assert rig.pipeline.ticks == ticks + 1
