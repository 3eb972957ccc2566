"""Which parts there are: the one place that a new kind of perception is entered.

Public names: `made`.
"""

from __future__ import annotations

from handtouch.percept.hardness import Hardness
from handtouch.percept.motion import Motion
from handtouch.percept.percept import Perceiver
from handtouch.percept.shape import PairDistance, Shape
from handtouch.percept.stream import Part, Stream
from handtouch.percept.texture import Texture


def made(stream: Stream, period_ns: int, pair_m: PairDistance | None = None) -> Perceiver:
    """Everything that perceives, on a stream of samples that come every `period_ns`; pair_m: see `Shape`."""
    parts: list[Part] = [
        Motion(stream, period_ns),
        Hardness(stream.size),
        Shape(stream.size, pair_m=pair_m),
        Texture(stream.size),
    ]
    return Perceiver(stream, parts)
