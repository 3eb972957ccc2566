"""Print a digest of the state after ticks of any samples: `python detect_many.py COUNT`."""

from __future__ import annotations

import hashlib
import sys

import numpy as np

from handtouch.config import parse
from handtouch.core.pipeline import run_tick
from handtouch.core.slab import STANDARD_LAYOUT, ChannelField, Cycle, Slab
from handtouch.core.stages import detect
from handtouch.core.stages.publish import ContactEncoder
from handtouch.core.tick import TickProcessor
from handtouch.daemon.table_cache import build_pad_model
from tests.core.conftest import TOLERANT_DEPLOYMENT

PERIOD_NS = 5_000_000
BEHAVIOUR = """
[sheet.s.behaviour]
preset = "S1"
hysteresis_width = 0.1
"""


def main(count: int) -> None:
    """Run ticks with contacts, noise, missing, late and saturated samples, and pads that aren't up."""
    rng = np.random.default_rng(8)
    model = build_pad_model(parse(TOLERANT_DEPLOYMENT + BEHAVIOUR))
    slab, cycle, tick = Slab(model.size), Cycle(PERIOD_NS, 0.6), TickProcessor(model, PERIOD_NS)
    slab.set_layout(1, (ChannelField(0, 0, 16, signed=False), *STANDARD_LAYOUT[1:]))
    encoder = ContactEncoder(model, tick.state, tick.columns, tick.sheet_force.modelled, session=7)
    digest, t_ns, node_state = hashlib.sha256(), 10**9, np.zeros(model.size, np.uint8)
    tick.state.synchronous[2] = False
    for number in range(count):
        t_ns += PERIOD_NS * (1 + 2 * (number % 13 == 0))
        node_state[0] = 3 * (number % 101 == 100)
        slab.begin_cycle(t_ns)
        cycle.begin_cycle(t_ns)
        pressed = number // 20 % 2
        for pad in range(model.size):
            counts = rng.normal(200.0 * pressed * (pad + 1), 2.0, 4)
            counts[0] = 32767 if rng.random() < 0.01 else abs(counts[0])
            if rng.random() < 0.9:
                data = np.rint(counts).astype("<i2").tobytes()
                slab.write_pdo(pad, data, t_ns + int(rng.integers(-PERIOD_NS, PERIOD_NS)))
        until_ns = t_ns + PERIOD_NS // 2 if number % 7 == 0 else 1 << 62
        run_tick(tick, slab, node_state, cycle, until_ns)
        tick.prepare_next_tick()
        digest.update(tick.state.save())
        digest.update(tick.columns.published_values.tobytes() + tick.columns.force_status.tobytes())
        for pad in range(model.size):
            digest.update(encoder.encode(pad, "update", t_ns, t_ns, "", False).payload)
    assert tick.contacts.begun_count > count // 100
    print("compiled" if detect.__file__.endswith(".so") else "interpreted", digest.hexdigest())


if __name__ == "__main__":
    main(int(sys.argv[1]))
