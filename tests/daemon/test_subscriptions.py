"""Subscriptions match topics by their prefix, and one connection can't subscribe without bound."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from handtouch import wire
from handtouch.daemon.publisher import (
    CHANGES_PER_S,
    MAX_CHANGES,
    MAX_UNKNOWN_PREFIXES,
    SubscriptionLimits,
    SubscriptionTable,
)

TOPICS = wire.topics_of({"left": ["thumb", "thumb_tip"], "right": ["thumb"]})
STREAMS = ("live", "complete")
PREFIXES = st.sampled_from(TOPICS).flatmap(
    lambda topic: st.integers(0, len(topic)).map(lambda length: topic[:length].encode())
) | st.binary(max_size=4)
SECOND_NS = 1_000_000_000


@given(st.lists(st.tuples(st.booleans(), st.sampled_from(STREAMS), PREFIXES)))
def test_topic_has_a_subscriber_if_a_prefix_of_it_is_subscribed(
    changes: list[tuple[bool, str, bytes]],
) -> None:
    table = SubscriptionTable(TOPICS, STREAMS)
    expected: dict[str, set[bytes]] = {stream: set() for stream in STREAMS}
    for added, stream, prefix in changes:
        assert table.is_known(prefix) == bool(table.topics_under(prefix))
        if added and table.is_known(prefix):
            table.add(stream, prefix)
            expected[stream].add(prefix)
        elif not added:
            table.remove(stream, prefix)
            expected[stream].discard(prefix)
    table.refresh()
    assert table.prefixes == expected["live"] | expected["complete"]
    for topic in TOPICS:
        on = [any(topic.encode().startswith(prefix) for prefix in expected[stream]) for stream in STREAMS]
        assert [table.has_subscriber_on(stream, topic.encode()) for stream in STREAMS] == on
        assert table.has_subscriber(topic) == any(on)


def test_known_prefixes_are_those_of_a_topic() -> None:
    table = SubscriptionTable(TOPICS, STREAMS)
    assert sorted(table.topics_under(b"contact/left/thumb")) == [
        "contact/left/thumb",
        "contact/left/thumb_tip",
    ]
    assert sorted(table.topics_under(b"")) == sorted(TOPICS)
    for prefix in (b"contact/left/thumb_", b"h", b"service"):
        assert table.is_known(prefix)
    for prefix in (b"contact/middle", b"services", b"\xff", b"\xff\xff", b"zz"):
        assert not table.is_known(prefix)


def test_connection_is_closed_for_prefixes_without_topic() -> None:
    limits = SubscriptionLimits(len(TOPICS))
    assert all(limits.allow(7, False, second * SECOND_NS) for second in range(MAX_UNKNOWN_PREFIXES))
    assert limits.allow(8, False, SECOND_NS)
    assert not limits.allow(7, False, 60 * SECOND_NS)
    assert limits.allow(7, False, 60 * SECOND_NS)  # left over from the closed connection
    assert all(limits.allow(7, False, (70 + second) * SECOND_NS) for second in range(MAX_UNKNOWN_PREFIXES))


def test_connection_is_closed_for_subscribing_too_often() -> None:
    limits = SubscriptionLimits(len(TOPICS))
    now_ns = 0
    for _ in range(20 * MAX_CHANGES):
        now_ns += round(SECOND_NS / CHANGES_PER_S)
        assert limits.allow(7, True, now_ns)
    assert all(limits.allow(8, True, now_ns) for _ in range(MAX_CHANGES))
    assert not limits.allow(8, True, now_ns)


def test_client_of_a_large_hand_may_subscribe_to_each_topic_by_itself() -> None:
    limits = SubscriptionLimits(3000)
    assert all(limits.allow(7, True, 0) for _ in range(6000))
