"""What skipping saves: ticks, processor time, bus load and duty of the nodes by scene, beside everything on.

*Hand*: nodes, daemon and a subscriber in processes of their own; 15 pads at 200 Hz on one bus of 1 Mbit/s,
udp_multicast over loopback. Scenes are changed at run time in the same daemon, by turns; medians over the
turns, with the least and the greatest. *Duty*: share of the time in which a node's sheet has its potential,
mean of the nodes. *Bare loop*: sends SYNC and receives the same frames by the daemon's own compiled
receiver, wakes up for each that comes, and does nothing else. *Spaced*: the nodes' frames follow each other
as on a bus of this bit rate; else the stand-ins send all at once. A node outside the scene is stopped; one
in it that is untouched for `idle_after_s` transmits when a channel changes by `delta_counts`, and at least
ten times a second; when all do so, SYNC slows down to `idle_sync_period_ms`. *Wake-up*: periods from the
first event frame of a touched pad to its next sample at full rate, touched at random times; then the share of
the full rate.

*Tick*: the daemon's pipeline from the last sample to encoded messages, with the preparation of the next;
processor time. Cases take turns on the same samples; the median, and quartiles of the ratio to everything
on in the same tick. All pads touched by contacts that slide 0.1 mm a tick; *palm and base*: steady presses
on some of 15 pads, joint states at 1 kHz. Contacts have 20 times the threshold's current.

*Candidates to go*: what saves less than 3 %, or not in every turn.
"""

from __future__ import annotations

import multiprocessing
import select
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import can
import numpy as np
import zmq
from numpy.typing import NDArray

from benchmarks.page import Report, Rows, options, progress
from benchmarks.served_hand import (
    PORT,
    ProcessorShare,
    SpacedBus,
    daemon_process,
    in_own_network,
    on_loopback,
    open_bus,
)
from benchmarks.touched_pads import PipelineCase, Touches, hands, in_turns_of
from handtouch.canbus.bus.port import Port
from handtouch.client import request
from handtouch.config import Deployment, load, shipped
from handtouch.config.tables import SceneRequest
from handtouch.core.pad_model import PadModel
from handtouch.core.slab import Slab
from handtouch.device import DeviceBus
from handtouch.hand.robot_models import RobotModels

TOUCH = np.array([900, 700, 800, 600])
IDLE_AFTER_S = 0.5
FOLLOWED = 40  # periods that a woken pad's samples are followed for
CONTACTS, EVERYTHING = ("contact/",), ("contact/", "hand/")
MAX_TO_BARE_LOOP = 1.2
MIN_SAVING = 0.03
BOOT_TIMEOUT_S = 60.0


# The hand


@dataclass(frozen=True)
class HandCase:
    """A scene, and what is touched and subscribed; `is_idle`: nodes transmit on changes while untouched;
    `is_spaced`: their frames follow each other as on a bus."""

    name: str
    touched: int = 15
    subscribed: bool = True
    is_idle: bool = False
    is_spaced: bool = False
    scene: dict[str, Any] = field(default_factory=dict)


ALL_ON, NOTHING = "everything on", "no outputs, no subscriber"
HAND_CASES = (
    HandCase(ALL_ON),
    HandCase("position only", scene={"outputs": ["position"]}),
    HandCase("a tenth of the rate", scene={"rate_hz": 20.0}),
    HandCase("no subscriber", subscribed=False),
    HandCase(NOTHING, subscribed=False, scene={"outputs": []}),
    HandCase("a fifth of the links", scene={"links": ["thumb_*"]}),
    HandCase("untouched", touched=0),
    HandCase(f"{ALL_ON}, event-driven", is_idle=True),
    HandCase("one pad touched, event-driven", touched=1, is_idle=True),
    HandCase("untouched, event-driven", touched=0, is_idle=True),
    HandCase("a fifth of the links, event-driven", 0, is_idle=True, scene={"links": ["thumb_*"]}),
    HandCase(f"{NOTHING}, spaced", subscribed=False, is_spaced=True, scene={"outputs": []}),
)
NODES = ((False, False), (True, False), (False, True))
"""`is_idle` and `is_spaced` of the nodes"""
BARE_LOOP = "bare loop, 15 pads"


class Nodes:
    """Nodes of a deployment with settable touches, and a receiver that records the send times of frames."""

    def __init__(self, deployment: Deployment, *, is_spaced: bool = False) -> None:
        self.pads = [pad for hand in deployment.hands for pad in hand.pads]
        self.touched: set[int] = set()
        self.seen: list[tuple[int, float]] = []
        self._noise = np.random.default_rng(4)
        self._buses = [open_bus(), open_bus()]
        bus: Any = self._buses[0]
        if is_spaced:
            bus = SpacedBus(bus, deployment.buses[0].bitrate_bit_s)
        self._bus = DeviceBus(bus, self._sample)
        self._devices = [self._bus.add(pad.node_id, serial=pad.serial) for pad in self.pads]
        self._notifier = can.Notifier(self._buses[1], [self._record_frame])

    @contextmanager
    def running(self) -> Iterator[Nodes]:
        self._bus.start()
        try:
            yield self
        finally:
            self._bus.stop()
            self._notifier.stop()
            for bus in self._buses:
                bus.shutdown()

    def duty(self) -> float:
        """Return the share of the nodes whose sheet has its potential now."""
        return statistics.mean(device.is_excited for device in self._devices)

    def _record_frame(self, message: can.Message) -> None:
        if 0x280 < message.arbitration_id < 0x300:
            self.seen.append((message.arbitration_id - 0x280, message.timestamp))

    def _sample(self, t_ns: int) -> NDArray[np.int64]:  # noqa: ARG002
        counts = np.rint(self._noise.standard_normal((len(self.pads), 4))).astype(np.int64)
        for slot in self.touched:
            counts[slot] += TOUCH
        return counts


def write_config(folder: Path, *, is_idle: bool) -> Path:
    """Write the hand's deployment, with nodes that switch their excitation."""
    config = on_loopback(folder, PORT)
    kind = 'excitation_object = "0x2100:0:u8"\n' + ("idle = { delta_counts = 12 }\n" if is_idle else "")
    text = config.read_text().replace("heartbeat_ms = 100\n", f"heartbeat_ms = 100\n{kind}")
    config.write_text(text.replace("[touch]", f"[scene]\nidle_after_s = {IDLE_AFTER_S}\n\n[touch]"))
    return config


@contextmanager
def serving(config: Path, *, is_spaced: bool = False) -> Iterator[tuple[Nodes, int, str]]:
    """Run nodes and daemon; yield nodes, daemon's process and control endpoint when all are up."""
    deployment = load(config)
    with Nodes(deployment, is_spaced=is_spaced).running() as nodes, daemon_process(config) as pid:
        control, end_s = deployment.daemon.control, time.monotonic() + BOOT_TIMEOUT_S
        while any(
            pad["node_state"] not in ("operational", "stopped")
            for pad in request("status", endpoint=control, timeout_s=60)["pads"]
        ):
            if time.monotonic() > end_s:
                raise TimeoutError("the hand never became operational")
            time.sleep(0.1)
        yield nodes, pid, control


def read_messages(endpoint: str, stop: Event) -> None:
    """Read all contacts and hand frames in a process, until `stop`."""
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        for topic in EVERYTHING:
            socket.subscribe(topic)
        socket.connect(endpoint)
        while not stop.is_set():
            if socket.poll(50):
                socket.recv_multipart()


@contextmanager
def subscriber(endpoint: str, wanted: bool) -> Iterator[None]:
    """Run a subscriber in a process, if wanted."""
    stop = multiprocessing.Event()
    process = multiprocessing.Process(target=read_messages, args=(endpoint, stop), daemon=True)
    if wanted:
        process.start()
    try:
        yield
    finally:
        stop.set()
        if wanted:
            process.join()


def measure_case(
    case: HandCase, config: Path, seconds: float, served: tuple[Nodes, int, str]
) -> dict[str, Any]:
    """Return the figures of a case in a running hand."""
    nodes, pid, control = served
    request("scene", reset=True, endpoint=control, timeout_s=60)
    if case.scene:
        request("scene", endpoint=control, timeout_s=60, **case.scene)
    nodes.touched = set(range(case.touched))
    with subscriber(load(config).daemon.live, case.subscribed):
        time.sleep(2 * IDLE_AFTER_S + 0.5)
        share, duty = ProcessorShare(), []
        before, start_s = request("status", endpoint=control, timeout_s=60), time.monotonic()
        share.start(pid)
        while time.monotonic() < start_s + seconds:
            duty.append(nodes.duty())
            time.sleep(0.05)
        processor = share.stop()
        after, took_s = request("status", endpoint=control, timeout_s=60), time.monotonic() - start_s
    (bus,) = after["service"]["buses"]
    buses = [status["service"]["buses"][bus] for status in (before, after)]
    bits, samples = (buses[1][key] - buses[0][key] for key in ("bits", "samples"))
    ticks = after["service"]["ticks"] - before["service"]["ticks"]
    return {
        "case": case.name,
        "samples/s": samples / took_s,
        "ticks/s": ticks / took_s,
        "bus load, %": 100 * bits / took_s / load(config).buses[0].bitrate_bit_s,
        "duty, %": 100 * statistics.mean(duty),
        "processor, % of a core": 100 * processor,
    }


def bare_loop(config: Path, stop: Event) -> None:
    """Start the nodes, send SYNC and receive by the daemon's receiver into a slab."""
    deployment = load(config)
    pads = [pad for hand in deployment.hands for pad in hand.pads]
    period_ns, slab = round(deployment.daemon.sync_period_ms * 1e6), Slab(len(pads))
    port = Port.open(deployment.buses[0], slab)
    for slot, pad in enumerate(pads):
        port.route(0x280 + pad.node_id, slot)
        port.send(0, bytes([1, pad.node_id]))
    next_ns = time.monotonic_ns()
    while not stop.is_set():
        now_ns = time.monotonic_ns()
        if now_ns >= next_ns:
            port.send(0x80, b"")
            slab.begin_cycle(now_ns)
            next_ns += period_ns
        if select.select([port.fileno()], (), (), max(0, next_ns - now_ns) * 1e-9)[0]:
            port.drain()
    port.close()


def measure_bare_loop(config: Path, seconds: float, *, is_spaced: bool) -> dict[str, Any]:
    stop = multiprocessing.Event()
    with Nodes(load(config), is_spaced=is_spaced).running() as nodes:
        nodes.touched = set(range(15))
        time.sleep(0.5)  # they boot
        process = multiprocessing.Process(target=bare_loop, args=(config, stop), daemon=True)
        process.start()
        time.sleep(1.0)
        share, count = ProcessorShare(), len(nodes.seen)
        share.start(process.pid or 0)
        time.sleep(seconds)
        row = {
            "case": bare_loop_of(is_spaced=is_spaced),
            "samples/s": (len(nodes.seen) - count) / seconds,
            "processor, % of a core": 100 * share.stop(),
        }
        stop.set()
        process.join()
    return row


def bare_loop_of(*, is_spaced: bool) -> str:
    """Return the name of the bare loop that gets frames of these nodes."""
    return f"{BARE_LOOP}, spaced" if is_spaced else BARE_LOOP


def measure_hand(folder: Path, turns: int, seconds: float) -> Rows:
    """Return the rows of all turns."""
    rows = []
    for turn in range(turns):
        for is_idle, is_spaced in NODES:
            config = write_config(folder, is_idle=is_idle)
            with serving(config, is_spaced=is_spaced) as served:
                for case in (
                    one for one in HAND_CASES if (one.is_idle, one.is_spaced) == (is_idle, is_spaced)
                ):
                    rows.append({"turn": turn, **measure_case(case, config, seconds, served)})
                    progress(rows[-1])
        for is_spaced in (False, True):
            rows.append({"turn": turn, **measure_bare_loop(config, seconds, is_spaced=is_spaced)})
            progress(rows[-1])
    return rows


def hand_table(rows: Rows) -> Rows:
    """Return a row for each case, with processor times over those of everything on in the same turn."""
    share = {(row["turn"], row["case"]): row["processor, % of a core"] for row in rows}
    idle = {case.name: case.is_idle for case in HAND_CASES}
    spaced = [bare_loop_of(is_spaced=True), *(case.name for case in HAND_CASES if case.is_spaced)]
    found = []
    for name in dict.fromkeys(row["case"] for row in rows):
        own = [row for row in rows if row["case"] == name]
        first = f"{ALL_ON}, event-driven" if idle.get(name) else ALL_ON
        ratios = [row["processor, % of a core"] / share[row["turn"], first] for row in own]
        bare = bare_loop_of(is_spaced=name in spaced)
        to_bare = [row["processor, % of a core"] / share[row["turn"], bare] for row in own]
        row = {
            key: statistics.median(row[key] for row in own) if key in own[0] else None
            for key in ("samples/s", "ticks/s", "bus load, %", "duty, %")
        }
        found.append(
            {
                "case": name,
                **row,
                "processor, % of a core": spread_of([row["processor, % of a core"] for row in own]),
                "of everything on, %": spread_of([100 * ratio for ratio in ratios]),
                "of the bare loop": spread_of(to_bare),
            }
        )
    return found


def spread_of(values: Sequence[float]) -> list[float]:
    """Return least, median and greatest."""
    return [min(values), statistics.median(values), max(values)]


def wakes(folder: Path, trials: int) -> dict[str, Any]:
    """Measure the periods from the first event frame of a touched idle pad to sampling at full rate."""
    config = write_config(folder, is_idle=True)
    period_s, chance, found = load(config).daemon.sync_period_ms * 1e-3, np.random.default_rng(7), []
    with serving(config) as (nodes, _, _):
        for _ in range(trials):
            nodes.touched = set()
            time.sleep(IDLE_AFTER_S + 0.4 + chance.uniform(0, 0.1))
            slot = int(chance.integers(len(nodes.pads)))
            first, touched_s = len(nodes.seen), time.time()
            nodes.touched = {slot}
            time.sleep((FOLLOWED + 5) * period_s)
            node_id = nodes.pads[slot].node_id
            stamps = np.array([at for who, at in nodes.seen[first:] if who == node_id and at > touched_s])
            found.append(full_rate_after(stamps, period_s))
    delays, rates = np.array(found).T
    return {
        "trials": trials,
        "period, ms": period_s * 1e3,
        "median, periods": float(np.median(delays)),
        "95 %": float(np.percentile(delays, 95)),
        "worst": float(delays.max()),
        "within two periods, %": 100 * float((delays <= 2).mean()),
        "rate after": float(np.median(rates)),
    }


def full_rate_after(stamps: NDArray[np.float64], period_s: float) -> tuple[float, float]:
    """Return the periods from the first frame to the second, and the fraction of the full rate afterwards.

    Event frames come when something moves; a pad that is pressed and held sends its second frame because of
    the SYNC that it follows from then on.
    """
    since = (stamps - stamps[0]) / period_s
    later = since[(since > 0) & (since < FOLLOWED)]
    if not len(later):
        return np.inf, 0.0
    return float(later[0]), len(later) / (FOLLOWED - float(later[0]))


# The tick

SCENES: dict[str, tuple[tuple[str, ...], SceneRequest]] = {
    ALL_ON: (EVERYTHING, SceneRequest()),
    "contacts subscribed": (CONTACTS, SceneRequest()),
    "no subscriber": ((), SceneRequest()),
    "no outputs: begin, current and end only": (EVERYTHING, SceneRequest(outputs=())),
    NOTHING: ((), SceneRequest(outputs=())),
    "position only": (EVERYTHING, SceneRequest(outputs=("position",))),
    "a tenth of the rate": (EVERYTHING, SceneRequest(rate_hz=20.0)),
    "a fifth of the links": (EVERYTHING, SceneRequest(links=("thumb_*",))),
}
PLAIN = ("position", "force")
STATED = {"mount_std_mm": 0.3, "mount_std_deg": 1.0, "joint_std_deg": 0.3}
EXACT = dict.fromkeys(STATED, 0.0)
FRAMES: dict[str, tuple[tuple[str, ...], dict[str, float] | None]] = {
    "palm and base, uncertain mounts and joints": ((*PLAIN, "palm", "base"), STATED),
    "palm and base": ((*PLAIN, "palm", "base"), EXACT),
    "palm, uncertain mounts and joints": ((*PLAIN, "palm"), STATED),
    "palm": ((*PLAIN, "palm"), EXACT),
    "URDF, palm not asked for": (PLAIN, STATED),
    "no URDF": (PLAIN, None),
}
"""Outputs, and what the file states of the hand; None: no URDF."""


def frame_cases(model: PadModel) -> dict[str, PipelineCase]:
    """Return pipelines of the shipped hand by the frames that are asked for."""
    deployment, cases = load(shipped.path("utah_mit.toml")), {}
    for name, (outputs, stated) in FRAMES.items():
        hand = deployment.hands[0].model_copy(update=stated or {})
        robots = RobotModels(deployment.model_copy(update={"hands": (hand,)})) if stated is not None else None
        cases[name] = PipelineCase(
            model, EVERYTHING, SceneRequest.model_validate({"outputs": outputs}), robots
        )
    return cases


def tick_tables(ticks: int) -> tuple[Rows, Rows]:
    """Return the rows of scenes and of frames."""
    scenes, frames = Rows(), Rows()
    for pads in (15, 60):
        model = hands(pads)
        cases = {name: PipelineCase(model, *scene) for name, scene in SCENES.items()}
        scenes += [{"pads": pads, **row} for row in in_turns_of(cases, Touches(model), ticks)]
    for touched in (0, 1, 5, 15):
        model = PadModel(load(shipped.path("utah_mit.toml")))
        rows_of = in_turns_of(frame_cases(model), Touches(model, touched, 0.0), ticks)
        frames += [{"pads touched": touched, **row} for row in rows_of]
    return scenes, frames


def candidates(hand: Rows, *ticks: Rows) -> Rows:
    """Return the cases whose saving of processor time isn't measurable."""
    found = [
        {"where": "daemon", "case": row["case"], "of everything on, %": row["of everything on, %"]}
        for row in hand
        if row["case"] not in (ALL_ON, f"{ALL_ON}, event-driven")
        and not row["case"].startswith(BARE_LOOP)
        and (row["of everything on, %"][1] > 100 * (1 - MIN_SAVING) or row["of everything on, %"][2] > 100)
    ]
    for rows in ticks:
        for row in rows:
            is_first = row["case"] in (ALL_ON, next(iter(FRAMES)))
            if not is_first and row["of everything on, %"][1] > 100 * (1 - MIN_SAVING):
                about = ", ".join(f"{row[key]} {key}" for key in ("pads", "pads touched") if key in row)
                found.append(
                    {"where": f"tick, {about}", **{k: row[k] for k in ("case", "of everything on, %")}}
                )
    return found


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--seconds", type=float, default=4.0, help="of each case of the hand")
    parser.add_argument("--turns", type=int, default=3, help="of the hand")
    parser.add_argument("--trials", type=int, default=30, help="touches of an idle hand")
    asked = parser.parse_args()
    ticks = 20 if asked.quick else 1000
    if asked.quick:
        asked.seconds, asked.turns, asked.trials = 0.5, 1, 3
    in_own_network()
    scenes, frames = tick_tables(ticks)
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        hand = hand_table(measure_hand(Path(folder), asked.turns, asked.seconds))
        report = Report(asked.quick, seconds_of_a_case=asked.seconds, turns=asked.turns, ticks=ticks)
        report.table("Hand (least, median, greatest)", hand)
        report.table("Wake-up", [wakes(Path(folder), asked.trials)])
    report.table("Tick (quartile, median, quartile)", scenes)
    report.table("Palm and base (quartile, median, quartile)", frames)
    report.table("Candidates to go", candidates(hand, scenes, frames))
    for nothing in (row for row in hand if row["case"].startswith(NOTHING)):
        report.limit(
            f"{nothing['case']}: over the bare loop", nothing["of the bare loop"][1], MAX_TO_BARE_LOOP
        )
    return int(not report.keep())


if __name__ == "__main__":
    sys.exit(main())
