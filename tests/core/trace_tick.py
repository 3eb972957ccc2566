"""Print the modules that most ticks with contacts pass, from a stored sample to its messages, uncompiled."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

import handtouch
from handtouch import wire
from handtouch.config import parse
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.table_cache import build_pad_model
from handtouch.wire import PadState
from tests.deployments import deployment_text, pad_text

PERIOD_NS = 5_000_000
TRACED_TICKS = 19
PACKAGE = Path(handtouch.__file__).parent


class EncodingSink:
    """Takes contacts and hand frames."""

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith(("contact/", "hand/"))

    def send(self, message: wire.OutgoingMessage) -> None:
        assert isinstance(message, wire.EncodedMessage)


def main() -> None:
    text = deployment_text(pad_text("plane", 1))
    model = build_pad_model(parse(text.replace("[sheet.s]", "[sheet.s]\nbehaviour = {}")))
    pipeline = Pipeline(model, PERIOD_NS, 0.6, EncodingSink())
    pipeline.node_state[:] = PadState.CLEAR
    passed: set[str] = set()
    ticks_of: Counter[str] = Counter()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and (file := Path(frame.f_code.co_filename)).is_relative_to(PACKAGE):
            passed.add(file.relative_to(PACKAGE).as_posix())

    for tick in range(1, 81 + TRACED_TICKS):
        sync_ns = tick * PERIOD_NS
        pipeline.begin_cycle(sync_ns, sync_ns)
        counts = np.array([1, 2, 1, 3]) * (1000 if tick > 70 else 1)
        pipeline.slab.write_pdo(0, counts.astype("<i2").tobytes(), sync_ns + 1)
        if tick > 80:
            sys.setprofile(note)
        pipeline.tick_if_due(sync_ns + 2)
        sys.setprofile(None)
        ticks_of.update(passed)
        passed.clear()
    assert pipeline.state.touching.all()
    print(*sorted(module for module, ticks in ticks_of.items() if ticks > TRACED_TICKS / 2), sep="\n")


if __name__ == "__main__":
    main()
