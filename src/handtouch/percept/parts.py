"""Which parts there are: the one place that a new kind of perception is entered.

Public names: `made`.
"""

from __future__ import annotations

from handtouch.percept.hardness import Hardness
from handtouch.percept.motion import Motion
from handtouch.percept.percept import Perceiver
from handtouch.percept.shape import Shape
from handtouch.percept.stream import Part, Stream
from handtouch.percept.texture import Texture


def made(stream: Stream, period_ns: int) -> Perceiver:
    """Everything that perceives, on a stream of samples that come every `period_ns`."""
    parts: list[Part] = [
        Motion(stream, period_ns),
        Hardness(stream.size),
        Shape(stream.size),
        Texture(stream.size),
    ]
    return Perceiver(stream, parts)
