"""`handtouch replay`: what was recorded through the same pipeline as live: identical contacts each time.

A CAN log drives the pipeline as a bus does (`replay`); a recording has every tick's own input
(`replay_recording`).

Public names: `replay`, `Summary`, `run`, `served`, `pacer`.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import can
import zmq

from handtouch import wire
from handtouch.canbus.bus.router import SYNC_ID, Counters, Router
from handtouch.canbus.objects.channels import channels_of, in_order
from handtouch.canbus.objects.mapping import from_eds
from handtouch.config import ConfigError, Deployment, load
from handtouch.daemon.model import PadModel
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.publisher import Publisher
from handtouch.daemon.security import Gate
from handtouch.keys import KeysError
from handtouch.wire import PadState

_SERVICES = (0x080, 0x580, 0x600, 0x700)
"""EMCY, SDO and heartbeat of our nodes are no strangers."""
_RHYTHM_SYNCS = 50
_QUIET_PERIODS = 8
"""A pause in the log is ticked through for this many periods: long enough for every pad to go stale."""


@dataclass
class Summary:
    """What a replay found: recorded time, ticks, contacts that began, and the counters of each bus.

    `period_s` is the log's own, from its SYNCs. `unmatched` counts the frames of channels that no bus of the
    deployment has.
    """

    period_s: float
    log_s: float = 0.0
    ticks: int = 0
    contacts: int = 0
    buses: dict[str, Counters] = field(default_factory=dict)
    unmatched: dict[str, int] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        """Of all buses."""
        return sum(counters.samples for counters in self.buses.values())


class _Outlet:
    """Hands contacts to whoever called `replay`, and everything to subscribers if there is a publisher."""

    def __init__(self, take: Callable[[wire.Contact], None], publisher: Publisher | None) -> None:
        self._take = take
        self._publisher = publisher
        self.contacts = 0

    def wants(self, topic: str) -> bool:
        return topic.startswith("contact/") or (self._publisher is not None and self._publisher.wants(topic))

    def send(self, message: wire.Outgoing) -> None:
        if isinstance(message, wire.Contact):
            self.contacts += message.event == "begin"
            self._take(message)
        if self._publisher is not None:
            self._publisher.send(message)


class _Feeder:
    """Drives a pipeline by the stamps of a log; the SYNC of the channel `clock` is the one that counts."""

    def __init__(self, deployment: Deployment, outlet: _Outlet, period_ns: int, clock: str | None) -> None:
        self.pipeline = Pipeline(PadModel(deployment), period_ns, deployment.daemon.window, outlet)
        self.routers = {bus.name: Router(self.pipeline.slab) for bus in deployment.buses}
        self.unmatched: dict[str, int] = {}
        self._by_channel = {str(bus.channel): self.routers[bus.name] for bus in deployment.buses}
        self._only = next(iter(self.routers.values())) if len(self.routers) == 1 else None
        self._clock = clock
        self._known = {SYNC_ID}
        pads = [pad for hand in deployment.hands for pad in hand.pads]
        for slot, pad in enumerate(pads):
            kind = deployment.nodes[pad.node]
            channels = in_order(channels_of(kind.channels, kind.eds), pad.electrodes)
            mapping = from_eds(kind.eds, pad.node_id, channels)
            self.pipeline.slab.arrange(slot, mapping.layout)
            for number, tpdo in enumerate(mapping.tpdos):
                self.routers[pad.bus].route(tpdo.cob_id, slot, number, tpdo.size)
            self._known |= {base + pad.node_id for base in _SERVICES}
        self.pipeline.node_state[:] = PadState.CLEAR

    def feed(self, message: can.Message, t_ns: int) -> None:
        """One frame of the log."""
        self._pass_time(t_ns)
        if _is_sync(message) and str(message.channel) == self._clock:
            self.pipeline.begin(t_ns, t_ns)
            return
        router = self._only or self._by_channel.get(str(message.channel))
        if router is None:
            channel = str(message.channel)
            self.unmatched[channel] = self.unmatched.get(channel, 0) + 1
            return
        frame = router.accept_message(message, t_ns)
        if frame is not None and frame[0] not in self._known and frame[0] != 0:
            router.counters.foreign += 1
        self.pipeline.advance(t_ns)

    def _pass_time(self, t_ns: int) -> None:
        """Tick what fell due before `t_ns`, by the timer where SYNC is missing."""
        pipeline, cycle = self.pipeline, self.pipeline.cycle
        if cycle.t_ns == 0:
            cycle.t_ns = t_ns
        pipeline.advance(t_ns)
        for _ in range(_QUIET_PERIODS):
            if t_ns < cycle.overdue_ns:
                return
            sync_ns = cycle.t_ns + cycle.period_ns
            pipeline.begin(sync_ns, sync_ns)
            pipeline.advance(min(t_ns, sync_ns + cycle.window_ns))
        pipeline.begin(t_ns, t_ns)


def replay(
    log: Path,
    deployment: Deployment,
    take: Callable[[wire.Contact], None],
    *,
    pace: Callable[[int], None] = lambda _: None,
    publisher: Publisher | None = None,
) -> Summary:
    """Run the pipeline over a log in any format that python-can reads; `take` gets every contact message.

    Times are the log's own stamps, in ns, and so is the period, where the log has SYNCs. A deployment's buses
    are told apart by their channel in the log; where there is only one, all frames are its. `pace` is called
    with each frame's stamp before the frame is fed: it may sleep to keep the recorded speed.

    Raises ValueError naming the log when python-can can't read it, OSError when it isn't there.
    """
    period_ns, clock = _rhythm(log, round(deployment.daemon.sync_period_ms * 1e6))
    outlet = _Outlet(take, publisher)
    feeder = _Feeder(deployment, outlet, period_ns, clock)
    if publisher:
        publisher.present.update(feeder.pipeline.messages.present())
    first_ns = t_ns = 0
    for message in _messages(log):
        t_ns = round(message.timestamp * 1e9)
        first_ns = first_ns or t_ns
        pace(t_ns)
        feeder.feed(message, t_ns)
    feeder.pipeline.end(t_ns)
    return Summary(
        period_s=period_ns * 1e-9,
        log_s=(t_ns - first_ns) * 1e-9,
        ticks=feeder.pipeline.ticks,
        contacts=outlet.contacts,
        buses={name: router.counters for name, router in feeder.routers.items()},
        unmatched=feeder.unmatched,
    )


def _rhythm(log: Path, period_ns: int) -> tuple[int, str | None]:
    """Period and channel of the log's first SYNCs; the period given and None if it has none."""
    stamps: list[float] = []
    channel: str | None = None
    for message in _messages(log):
        if _is_sync(message) and channel in (None, str(message.channel)):
            channel = str(message.channel)
            stamps.append(message.timestamp)
            if len(stamps) > _RHYTHM_SYNCS:
                break
    steps = sorted(later - earlier for earlier, later in itertools.pairwise(stamps))
    return (round(steps[len(steps) // 2] * 1e9) if steps else period_ns), channel


def _is_sync(message: can.Message) -> bool:
    special = message.is_extended_id or message.is_error_frame or message.is_remote_frame
    return message.arbitration_id == SYNC_ID and not special


def _messages(log: Path) -> Iterator[can.Message]:
    if not log.is_file():
        raise FileNotFoundError(f"{log}: no such log")
    try:
        with can.LogReader(log) as reader:
            yield from reader
    except Exception as error:  # readers raise anything, and all of it means that the log can't be read
        raise ValueError(
            f"{log}: python-can can't read it ({error}); it reads candump .log, .asc, .blf, .csv, .db, .trc "
            "and these with .gz"
        ) from error


def pacer(speed: float) -> Callable[[int], None]:
    """A function that sleeps until a stamp is due at `speed` times the recorded speed; 0: never sleeps."""
    if speed == 0:
        return lambda _: None
    start: list[int] = []

    def pace(t_ns: int) -> None:
        if not start:
            start.extend((time.monotonic_ns(), t_ns))
        ahead_s = (start[0] + (t_ns - start[1]) / speed - time.monotonic_ns()) * 1e-9
        if ahead_s > 1e-3:
            time.sleep(ahead_s)

    return pace


def run(
    path: Path,
    config_path: Path | None = None,
    *,
    speed: float | None = None,
    nominal: bool = False,
    as_json: bool = False,
    report: Path | None = None,
    publish: bool = False,
    locator: str | None = None,
    tolerance_mm: float | None = None,
) -> int:
    """`handtouch replay`: print contacts, or publish them too, and tell how they compare with recorded ones.

    `speed` times as fast as recorded, 0: as fast as it goes, None: that, or as recorded if it is published.

    Exit status 0, 1 (it can't be read, holds no sample of the deployment, or contacts come out otherwise than
    recorded by the same deployment), 2 (usage or config).
    """
    take = _print_json if as_json else _print_line
    if speed is None:
        speed = 1.0 if publish else 0.0
    try:
        deployment = load(config_path) if config_path else None
        if locator and locator not in (known := locator_names()):
            print(f"--locator {locator}: there are {', '.join(known)}", file=sys.stderr)
            return 2
        if is_recording(path):
            from handtouch.daemon import replay_recording

            other = replay_recording.Other(nominal, locator, tolerance_mm)
            with ExitStack() as stack:
                serve = partial(served, publish=publish, speed=speed, stack=stack)
                return replay_recording.replay(path, deployment, other, serve, take, report, stack)
        if deployment is None:
            print(
                f"{path}: a CAN log needs the deployment file of its hand: replay LOG CONFIG", file=sys.stderr
            )
            return 2
        if nominal or report or locator or tolerance_mm is not None:
            print(
                "--nominal, --locator, --tolerance-mm and --report are for MCAP recordings", file=sys.stderr
            )
            return 2
        with ExitStack() as stack:
            publisher, pace = served(deployment, publish, speed, stack)
            summary = replay(path, deployment, take, pace=pace, publisher=publisher)
    except (ConfigError, KeysError) as error:
        print(error, file=sys.stderr)
        return 2
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    return _tell(summary, path, config_path)


def locator_names() -> list[str]:
    """What `--locator` takes."""
    from handtouch.daemon.locators import NAMES

    return list(NAMES)


def is_recording(path: Path) -> bool:
    """Whether a file is MCAP rather than a CAN log."""
    from handtouch.record.read import MAGIC

    if path.suffix == ".mcap" or not path.is_file():
        return path.suffix == ".mcap"
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def served(
    deployment: Deployment | None, publish: bool, speed: float, stack: ExitStack
) -> tuple[Publisher | None, Callable[[int], None]]:
    """A publisher if there is to be one, and what keeps the pace."""
    pace = pacer(speed)
    if not publish or deployment is None:
        return None, pace
    context = stack.enter_context(zmq.Context())
    settings = deployment.daemon
    gate = Gate(context, Path(settings.keys) if settings.keys else None)
    stack.callback(gate.close)
    publisher = Publisher(context, settings.live, settings.complete, gate)
    stack.callback(publisher.close)
    return publisher, _serving(pace, publisher, gate)


def _tell(summary: Summary, path: Path, config_path: Path | None) -> int:
    counts = ", ".join(
        f"{name}: {c.frames} frames, {c.samples} samples, {c.short} short, {c.foreign} foreign"
        for name, c in summary.buses.items()
    )
    print(
        f"{summary.contacts} contacts in {summary.log_s:.1f} s of log, {summary.ticks} ticks "
        f"of {1e3 * summary.period_s:.4g} ms; {counts}",
        file=sys.stderr,
    )
    if summary.samples:
        return 0
    others = ", ".join(f"{channel} ({count} frames)" for channel, count in summary.unmatched.items())
    print(
        f"{path}: no frame is a sample of {config_path}; do its buses' channels and node ids fit the log?"
        + (f" Channels of the log that it doesn't have: {others}" if others else ""),
        file=sys.stderr,
    )
    return 1


def _serving(pace: Callable[[int], None], publisher: Publisher, gate: Gate) -> Callable[[int], None]:
    def serve(t_ns: int) -> None:
        gate.poll(time.monotonic_ns())
        publisher.take_subscriptions(t_ns)
        pace(t_ns)

    return serve


def _print_json(contact: wire.Contact) -> None:
    print(json.dumps(asdict(contact)))


def _print_line(contact: wire.Contact) -> None:
    from handtouch.view.lines import contact_line

    if contact.event != "update":
        print(contact_line(contact))
