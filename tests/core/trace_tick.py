"""Print the modules that a tick with contacts passes, from a stored sample to its messages, uncompiled."""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

import handtouch
from handtouch import wire
from handtouch.config import parse
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.wire import PadState
from tests.deployments import deployment_text, pad_text

PERIOD_NS = 5_000_000
PACKAGE = Path(handtouch.__file__).parent


class EncodingSink:
    """Encodes contacts and hand frames."""

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith(("contact/", "hand/"))

    def send(self, message: wire.OutgoingMessage) -> None:
        wire.encode(message)


def main() -> None:
    text = deployment_text(pad_text("plane", 1))
    model = PadModel(parse(text.replace("[sheet.s]", "[sheet.s]\nbehaviour = {}")))
    pipeline = Pipeline(model, PERIOD_NS, 0.6, EncodingSink())
    pipeline.node_state[:] = PadState.CLEAR
    passed = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and (file := Path(frame.f_code.co_filename)).is_relative_to(PACKAGE):
            passed.add(file.relative_to(PACKAGE).as_posix())

    for tick in range(1, 100):
        sync_ns = tick * PERIOD_NS
        pipeline.begin_cycle(sync_ns, sync_ns)
        counts = np.array([1, 2, 1, 3]) * (1000 if tick > 70 else 1)
        pipeline.slab.write_pdo(0, counts.astype("<i2").tobytes(), sync_ns + 1)
        if tick > 80:
            sys.setprofile(note)
        pipeline.tick_if_due(sync_ns + 2)
        sys.setprofile(None)
    assert pipeline.state.touching.all()
    print(*sorted(passed), sep="\n")


if __name__ == "__main__":
    main()
