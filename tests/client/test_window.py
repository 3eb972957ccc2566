"""All frames of the last seconds: none left out, none twice, none that is old."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import handtouch
from handtouch import wire
from handtouch.client.window import HandWindow
from tests.client.hand_messages import LINKS, make_frame

PERIOD_NS = 5_000_000
LONGEST_S = 60.0


class Stream:
    """Publishes frames; their times are those of a hand at 200 Hz that ends now."""

    def __init__(self, publisher: Any, hand: handtouch.Hand) -> None:
        self._publisher, self.hand = publisher, hand
        self.seq = 0

    def publish(self, count: int, session: int = 1) -> None:
        now_ns = time.monotonic_ns()
        for back in reversed(range(count)):
            self.seq += 1
            t_ns = now_ns - back * PERIOD_NS
            frame = make_frame(self.seq, session=session, t_ns=t_ns, state=(1, 0, 0), force_n=(self.seq,) * 3)
            self._publisher.send_multipart(wire.encode(frame))

    def window(self, seconds: float | None = None) -> HandWindow:
        """Return the window once the last frame has come; what comes late is read by then."""
        end_s = time.monotonic() + LONGEST_S
        while time.monotonic() < end_s:
            arrays = self.hand.latest()
            if arrays is not None and arrays.frame.seq == self.seq:
                return self.hand.window(seconds)
        raise AssertionError(f"frame {self.seq} never came")


@pytest.fixture
def stream(publisher: Any, endpoints: dict[str, str]) -> Iterator[Stream]:
    with handtouch.Hand("right", endpoint=endpoints["live"], window_s=2.0, max_age_s=LONGEST_S) as hand:
        for _ in range(3):
            publisher.recv()
        yield Stream(publisher, hand)


def numbers(window: HandWindow) -> list[int]:
    return [frame.seq for frame in window.frames]


def test_a_slow_loop_gets_every_frame_whatever_latest_skips(stream: Stream) -> None:
    seen: list[int] = []
    for count in (1, 7, 30, 2):
        stream.publish(count)
        window = stream.window()
        assert window.lost == 0
        seen += [seq for seq in numbers(window) if seq not in seen]
    assert seen == list(range(1, 41))


def test_a_window_holds_the_last_seconds_as_arrays(stream: Stream) -> None:
    stream.publish(100)
    window = stream.window(20.5 * 1e-9 * PERIOD_NS)
    assert numbers(window) == list(range(80, 101))
    assert window.links == LINKS
    assert window.force_n.shape == (21, 3)
    assert window.force_n[:, 0].tolist() == list(range(80, 101))
    assert np.diff(window.t_ns).tolist() == [PERIOD_NS] * 20
    assert window.covariance_m2.shape == (21, 3, 3, 3)
    assert window.touched.all(axis=0).tolist() == [True, False, False]
    assert window.sampled.all()
    assert "21 frames of hand right in 0.100 s, 0 lost" in repr(window)
    with pytest.raises(LookupError, match="palm"):
        window.column("palm_position_m")
    with pytest.raises(AttributeError, match="force_n"):
        _ = window.forces


def test_frames_that_never_came_are_counted(stream: Stream) -> None:
    stream.publish(5)
    stream.seq += 3
    stream.publish(5)
    assert stream.window().lost == 3


def test_a_window_is_of_one_session(stream: Stream) -> None:
    stream.publish(10)
    stream.window()
    stream.seq = 0
    stream.publish(4, session=2)
    assert numbers(stream.window()) == [1, 2, 3, 4]
    with pytest.raises(ValueError, match="sessions"):
        HandWindow([make_frame(1, session=1), make_frame(2, session=2)])


def test_a_window_that_is_not_kept_names_the_remedy(stream: Stream, endpoints: dict[str, str]) -> None:
    stream.publish(3)
    stream.window(2.0)
    with pytest.raises(ValueError, match=r"window_s=2\.5"):
        stream.hand.window(2.5)
    with (
        handtouch.Hand("right", endpoint=endpoints["live"]) as other,
        pytest.raises(ValueError, match="kept"),
    ):
        other.window(1.0)
    with pytest.raises(ValueError, match="window_s"):
        handtouch.Hand("right", window_s=-1.0)


def test_there_is_no_window_of_old_frames(stream: Stream, publisher: Any, endpoints: dict[str, str]) -> None:
    with handtouch.Hand("right", endpoint=endpoints["live"], window_s=1.0, max_age_s=1e-6) as hand:
        for _ in range(3):
            publisher.recv()
        stream.publish(3)
        stream.window()
        for _ in range(100):
            with pytest.raises(LookupError):
                hand.window(1.0)
