"""Worst requests: processor time that the worst valid ones take from the daemon's loop.

The shipped hand, all pads touched, 32 clients with scenes of their own and as many characters as are allowed.
Each request is handled as the loop does, without the socket; the reply's encoding counts. Requests take 5 %
of the loop's time at most, whatever they cost: then they wait.
"""

from __future__ import annotations

import gc
import tempfile
import time
from collections.abc import Iterator
from itertools import count as count_up
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from benchmarks.page import Report, options
from handtouch.config import Deployment, load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.core.scene import MAX_CLIENT_CHARACTERS, MAX_CLIENTS
from handtouch.daemon.control import MAX_REPLY_BYTES
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.wire import PadState

REPEATS, QUICK_REPEATS = 200, 5
LIMIT_MS = 2.0


def quiet_deployment(folder: Path) -> Deployment:
    """Return the shipped deployment on a bus without nodes, with endpoints in a folder."""
    deployment = load(shipped.path("utah_mit.toml"))
    endpoints = {name: f"ipc://{folder}/{name}" for name in ("live", "complete", "control", "inputs")}
    update: dict[str, Any] = {**endpoints, "supervise": False, "store": None}
    buses = tuple(
        bus.model_copy(update={"interface": "virtual", "channel": "requests", "options": {}})
        for bus in deployment.buses
    )
    daemon = deployment.daemon.model_copy(update=update)
    return deployment.model_copy(update={"daemon": daemon, "buses": buses})


def worst_requests(names: list[str], count: int) -> dict[str, list[dict[str, Any]]]:
    """Return up to `count` requests by the text of the table's row; those of a row are sent by turns."""
    short, numbers = [name.split("/")[1] for name in names], count_up(100)

    def patterns() -> Iterator[list[str]]:
        """Yield as many as are allowed: sets of characters, which cost most, then names; none twice."""
        for number in islice(numbers, count):
            yield ([f"*[!{number}{digit}]" for digit in range(10)] + short + names)[: 2 * len(names)]

    scene = {"lease_s": 3600.0, "outputs": ["position", "force"]}
    pad = {"hand": names[0].split("/")[0], "pad": short[0]}
    return {
        "`status`": [{"command": "status"}],
        "`snapshot`": [{"command": "snapshot"}],
        "`scene`, a client's with other patterns": [
            {"command": "scene", "name": "worst", "links": links, **scene} for links in patterns()
        ],
        "`scene`, the base": [
            {"command": "scene", "links": links, "outputs": ["position"]} for links in patterns()
        ],
        "`scene`, of no pad": [{"command": "scene", "name": "worst", "links": ["nothing*"], **scene}],
        "`disable`, `enable`": [
            {"command": command, "pads": links, "name": "worst"}
            for links, command in zip(patterns(), cycle(("disable", "enable")), strict=False)
        ],
        "`calibrate`, read": [{"command": "calibrate", **pad}],
        "`tare`, start": [{"command": "tare", "pads": links} for links in patterns()],
        "`log`": [{"command": "log", "level": "info"}],
        "no such command, 60 kB": [{"command": "x" * 60_000}],
        "not msgpack": [],
    }


def main() -> None:
    asked = options(__doc__).parse_args()
    repeats = QUICK_REPEATS if asked.quick else REPEATS
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        deployment = quiet_deployment(Path(folder))
        daemon = HandtouchDaemon.open(deployment, PadModel(deployment), lambda: deployment)
        try:
            rows = measure(daemon, deployment.pad_names, repeats)
        finally:
            daemon.close()
    report = Report(
        asked.quick, requests_of_a_kind=repeats, clients=MAX_CLIENTS, characters=MAX_CLIENT_CHARACTERS
    )
    report.table("Requests", rows)
    report.limit("99 % of the costliest kind", max(row["99 %, ms"] for row in rows), LIMIT_MS, "ms")
    report.limit("longest answer", max(row["answer, bytes"] for row in rows), MAX_REPLY_BYTES, "bytes")
    report.keep()


def measure(daemon: HandtouchDaemon, names: list[str], repeats: int) -> list[dict[str, Any]]:
    """Return the figures of each kind of request."""
    t_ns, control = 10**12, daemon.control
    daemon.pipeline.node_state[:] = PadState.CLEAR
    model = daemon.pipeline.model
    places = [(network, network.fractions(0.3 * network.a, 0.4 * network.b)) for network in model.networks]
    counts = np.rint([shares * 2e-3 / model.ampere_per_count[pad] for pad, (_, shares) in enumerate(places)])
    counts = counts.astype("<i2")
    for _ in range(20):
        t_ns += 5_000_000
        daemon.pipeline.begin_cycle(t_ns, t_ns)
        for pad, row in enumerate(counts):
            daemon.pipeline.slab.write_pdo(pad, row.tobytes(), t_ns + 1000)
        daemon.pipeline.tick_if_due(t_ns + 2000)
        daemon.demand.update(t_ns)
    each = MAX_CLIENT_CHARACTERS // MAX_CLIENTS - 260
    links = list(islice(cycle(names), each // max(map(len, names))))[: 2 * len(names)]
    for client in range(MAX_CLIENTS - 1):
        request = {"v": 1, "command": "scene", "name": f"c{client}", "links": links, "lease_s": 3600.0}
        _, answer = control.start_request(msgpack.packb(request), t_ns)
        assert isinstance(answer, dict)
        assert answer["ok"], answer
    gc.collect()
    gc.freeze()  # as the daemon does before its loop
    rows = []
    for name, requests in worst_requests(names, repeats).items():
        frames = [msgpack.packb({"v": 1, **request}) for request in requests] or [b"\xc1" * 60_000]
        spent, longest = [], 0
        for number in range(repeats):
            t_ns += 200_000_000
            begin_ns = time.thread_time_ns()
            _, answer = control.start_request(frames[number % len(frames)], t_ns)
            if isinstance(answer, dict):
                longest = max(longest, len(msgpack.packb(answer)))
            spent.append((time.thread_time_ns() - begin_ns) * 1e-6)
        median, most = np.percentile(spent, [50, 99]).tolist()
        times = {"median, ms": median, "99 %, ms": most, "worst, ms": max(spent)}
        rows.append({"request": name, **times, "answer, bytes": longest})
    return rows


if __name__ == "__main__":
    main()
