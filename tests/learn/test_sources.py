"""A simulation, a subscriber and a recording give the same bytes for the same touch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np

from handtouch import wire
from handtouch.client.hand_arrays import HandArrays
from handtouch.client.window import HandWindow
from handtouch.learn import TouchFeatures
from handtouch.simulate import TactileReading
from tests.record.conftest import Hand, deployment, make_hand, model

__all__ = ["deployment", "make_hand", "model"]  # fixtures


def test_every_source_of_one_tick_gives_the_same_bytes(make_hand: Callable[..., Hand]) -> None:
    """`TactileSensor` takes its arrays from the pipeline that publishes frames, before they are encoded."""
    hand = make_hand()
    random = np.random.default_rng(3)
    features = TouchFeatures(("round", "plane"))
    frames: list[wire.HandFrame] = []
    read: list[bytes] = []
    for tick in range(120):
        hand.stroke_step(tick % 40 / 40, random)
        columns: dict[str, Any] = dict(hand.pipeline.messages.frame_columns())
        for name in ("covariance_m2", "mount_covariance_m2"):
            columns[name] = columns[name].reshape(-1, 3, 3)
        reading = {field.name: columns.get(field.name, np.zeros(0)) for field in fields(TactileReading)}
        frame = next(m for m in reversed(hand.sink.messages) if isinstance(m, wire.HandFrame))
        frames.append(frame)
        read.append(
            features.of(TactileReading(**reading), now_ns=frame.t_ns, links=["h/plane", "h/round"]).tobytes()
        )
        assert features.of(HandArrays(frame)).tobytes() == read[-1]
        recorded = wire.decode(wire.encode(frame))
        assert isinstance(recorded, wire.HandFrame)
        assert features.of(HandArrays(recorded)).tobytes() == read[-1]
    assert features.of(HandWindow(frames)).tobytes() == b"".join(read)
    touched = features.of(HandWindow(frames))[:, features.names.index("plane.touched")]
    assert 10 < touched.sum() < 110


def test_a_source_is_anything_with_the_columns(make_hand: Callable[..., Hand]) -> None:
    hand = make_hand()
    hand.stroke(50)
    frame = next(m for m in reversed(hand.sink.messages) if isinstance(m, wire.HandFrame))
    arrays = HandArrays(frame)
    names = (
        *("state", "sample_ns", "position_m", "covariance_m2", "position_status"),
        *("force_n", "force_std_n", "force_status"),
    )
    plain = SimpleNamespace(**{name: arrays.column(name).array for name in names}, t_ns=frame.t_ns)
    features = TouchFeatures(frame.links)
    assert features.of(plain, links=frame.links).tobytes() == features.of(arrays).tobytes()
