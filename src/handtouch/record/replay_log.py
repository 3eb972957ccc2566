"""Replay of a CAN log: the frames drive the pipeline as a live bus does; contacts are identical each time.

Public names: `replay_log`, `LogReplaySummary`.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import can

from handtouch import __version__, wire
from handtouch.canbus import cia301
from handtouch.canbus.bus.router import BusCounters, Router
from handtouch.canbus.objects.mapping import mapping_from_eds
from handtouch.config import Deployment
from handtouch.config.channels import channel_states, node_channels, order_channels
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.record.replay_sink import ContactCallback, ReplayPublisher, ReplaySink
from handtouch.wire import PadState

_NODE_COB_BASES = (0x080, 0x580, 0x600, 0x700)
"""COB-ID bases of EMCY, SDO and heartbeat, which a deployment's nodes send besides TPDOs."""
_PERIOD_SYNCS = 50
_MAX_DISORDER_S = 0.5
"""Frames of several adapters in one file are out of order by less; stamps that go back farther do so for a
cause."""
_WRAP_S = 2**32 * 1e-6
"""Microseconds of 32 bits begin again after this time."""
_MAX_WRAP_ERROR_S = 60.0
"""Longest pause between the frames before and after a wrap"""


@dataclass
class LogReplaySummary:
    """Result of a replay: recorded time, ticks, contacts begun, and the counters of each bus.

    `period_s`: from the log's SYNCs. `unmatched`: frames by channel, of channels without a bus in the
    deployment.
    """

    period_s: float
    log_s: float = 0.0
    ticks: int = 0
    contacts: int = 0
    buses: dict[str, BusCounters] = field(default_factory=dict)
    unmatched: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @property
    def samples(self) -> int:
        """Samples of all buses."""
        return sum(counters.samples for counters in self.buses.values())


class _LogReplayer:
    """Pipeline driven by the stamps of a log; cycles begin at the SYNCs of `sync_channel`."""

    def __init__(
        self,
        deployment: Deployment,
        sink: ReplaySink,
        period_ns: int,
        sync_channel: str | None,
        log_channels: Collection[str],
    ) -> None:
        self.pipeline = Pipeline(
            PadModel(deployment), period_ns, deployment.daemon.sample_window_fraction, sink
        )
        self.routers = {bus.name: Router(self.pipeline.slab) for bus in deployment.buses}
        self.unmatched: dict[str, int] = {}
        self._by_channel = {str(bus.channel): self.routers[bus.name] for bus in deployment.buses}
        is_only = len(self.routers) == 1 and (
            len(log_channels) == 1 or not self._by_channel.keys() & log_channels
        )
        self._only_router = next(iter(self.routers.values())) if is_only else None
        self._sync_channel = sync_channel
        self._known_ids = {cia301.SYNC}
        pads = [entry.pad for entry in deployment.pads]
        for slot, pad in enumerate(pads):
            kind = deployment.nodes[pad.node]
            channels = order_channels(node_channels(kind), pad)
            mapping = mapping_from_eds(kind.eds, pad.node_id, channels, channel_states(pad))
            self.pipeline.slab.set_layout(slot, mapping.layout, bool(mapping.states))
            for number, tpdo in enumerate(mapping.tpdos):
                self.routers[pad.bus].route(tpdo.cob_id, slot, number, tpdo.size_bytes)
            self._known_ids |= {base + pad.node_id for base in _NODE_COB_BASES}
        self.pipeline.node_state[:] = PadState.CLEAR
        # by the timer in a pause of the log: enough for every contact to end
        self._max_pause_ticks = int(self.pipeline.model.touch.max_gap_periods.max()) + 2

    def process_frame(self, message: can.Message, t_ns: int) -> None:
        """Process a frame of the log."""
        self._advance_to(t_ns)
        if _is_sync(message) and str(message.channel) == self._sync_channel:
            self.pipeline.begin_cycle(t_ns, t_ns)
            return
        router = self._only_router or self._by_channel.get(str(message.channel))
        if router is None:
            channel = str(message.channel)
            self.unmatched[channel] = self.unmatched.get(channel, 0) + 1
            return
        frame = router.accept_message(message, t_ns)
        if frame is not None and frame[0] not in self._known_ids and frame[0] != 0:
            router.counters.unknown_frames += 1
        self.pipeline.tick_if_due(t_ns)

    def _advance_to(self, t_ns: int) -> None:
        """Run the ticks due before `t_ns`, by the timer where SYNC is missing."""
        pipeline, cycle = self.pipeline, self.pipeline.cycle
        if cycle.sync_ns == 0:
            cycle.sync_ns = t_ns
        pipeline.tick_if_due(t_ns)
        for _ in range(self._max_pause_ticks):
            if t_ns < cycle.sync_overdue_ns:
                return
            sync_ns = cycle.sync_ns + cycle.period_ns
            pipeline.begin_cycle(sync_ns, sync_ns)
            pipeline.tick_if_due(min(t_ns, sync_ns + cycle.window_ns))
        pipeline.begin_cycle(t_ns, t_ns)


def replay_log(
    log: Path,
    deployment: Deployment,
    on_contact: ContactCallback,
    *,
    pace: Callable[[int], None] = lambda _: None,
    publisher: ReplayPublisher | None = None,
) -> LogReplaySummary:
    """Run the pipeline over a log in any format that python-can reads; `on_contact` gets its contacts.

    Times are the log's stamps in ns, and the period is that of its SYNCs, if it has any. The deployment's
    buses are identified by their channel in the log; a single bus gets all frames of a log that doesn't have
    its channel, or no other. Stamps that go back, by a clock that was set or a counter that wrapped,
    continue, which is among the summary's warnings. `pace` is called with each frame's stamp before the frame
    is processed; it may sleep, to keep the recorded speed.

    Raises ValueError naming the log if python-can can't read it or its stamps don't advance, OSError if it
    doesn't exist.
    """
    period_ns, sync_channel, channels = _survey_log(log, round(deployment.daemon.sync_period_ms * 1e6))
    contacts = 0

    def count(contact: wire.Contact) -> None:
        nonlocal contacts
        contacts += contact.event == "begin"
        on_contact(contact)

    replayer = _LogReplayer(deployment, ReplaySink(count, publisher), period_ns, sync_channel, channels)
    stamps = _LogClock()
    if publisher is not None:
        publisher.retained_messages.update(replayer.pipeline.messages.retained_messages())
    first_ns = t_ns = service_ns = 0
    services = itertools.count(1)
    for message in _read_log(log):
        t_ns = stamps.advance(message.timestamp)
        first_ns = first_ns or t_ns
        if publisher is not None and t_ns >= service_ns:
            _send_service(publisher, deployment, period_ns, next(services), t_ns)
            service_ns = t_ns + round(wire.SERVICE.period_s * 1e9)
        pace(t_ns)
        replayer.process_frame(message, t_ns)
    replayer.pipeline.end_session(t_ns)
    return LogReplaySummary(
        period_s=period_ns * 1e-9,
        log_s=(t_ns - first_ns) * 1e-9,
        ticks=replayer.pipeline.ticks,
        contacts=contacts,
        buses={name: router.counters for name, router in replayer.routers.items()},
        unmatched=replayer.unmatched,
        warnings=stamps.warnings,
    )


def _send_service(
    publisher: ReplayPublisher, deployment: Deployment, period_ns: int, seq: int, t_ns: int
) -> None:
    """Publish that this is a replay, without which clients take its frames for old."""
    service = wire.Service(
        v=wire.SCHEMA_VERSION,
        session=0,
        seq=seq,
        t_ns=t_ns,
        wall_offset_ns=0,
        version=__version__,
        pid=os.getpid(),
        uptime_s=0.0,
        period_s=period_ns * 1e-9,
        hands=deployment.links_by_hand,
        ticks=0,
        overruns=0,
        rate_hz=0.0,
        core_compiled=True,
        tick_us={},
        loop={},
        contacts=0,
        rejected={},
        process={},
        buses={},
        congestion_episodes={},
        subscriptions=(),
        retained=False,
        replay=True,
    )
    publisher.send(service)
    publisher.retained_messages["service"] = lambda _: replace(service, retained=True)


class _LogClock:
    """Time of a log [ns], which never goes back by more than the order of frames of several adapters."""

    def __init__(self) -> None:
        self.warnings: list[str] = []
        self._offset_s = self._last_s = 0.0

    def advance(self, stamp_s: float) -> int:
        """Return the time of the next frame."""
        t_s = stamp_s + self._offset_s
        back_s = self._last_s - t_s
        if back_s > _MAX_DISORDER_S:
            wrapped = 0 <= _WRAP_S - back_s < _MAX_WRAP_ERROR_S
            self._offset_s += _WRAP_S if wrapped else back_s
            cause = "a counter of 32 bits wrapped" if wrapped else "the clock was set"
            self.warnings.append(
                f"stamps go back by {back_s:.3f} s after {self._last_s:.3f} s: {cause}; continued"
            )
            t_s = stamp_s + self._offset_s
        self._last_s = max(self._last_s, t_s)
        return round(t_s * 1e9)


def _survey_log(log: Path, period_ns: int) -> tuple[int, str | None, set[str]]:
    """Return period and channel of the log's first SYNCs, and the channels of the frames until then.

    The given period and None if it has no SYNC.
    """
    stamps: list[float] = []
    channel: str | None = None
    channels, frames, clock = set[str](), list[int](), _LogClock()
    for message in _read_log(log):
        channels.add(str(message.channel))
        frames.append(clock.advance(message.timestamp))
        if _is_sync(message) and channel in (None, str(message.channel)):
            channel = str(message.channel)
            stamps.append(frames[-1] * 1e-9)
            if len(stamps) > _PERIOD_SYNCS:
                break
    if len(frames) > 1 and max(frames) == min(frames):
        raise ValueError(
            f"{log}: its stamps don't advance: all {len(frames)} frames are of one time; record it with "
            "time stamps"
        )
    steps = sorted(later - earlier for earlier, later in itertools.pairwise(stamps))
    period_s = steps[len(steps) // 2] if steps else period_ns * 1e-9
    if period_s <= 0:
        raise ValueError(f"{log}: the stamps of its SYNCs don't advance; record it with time stamps")
    return round(period_s * 1e9), channel, channels


def _is_sync(message: can.Message) -> bool:
    special = message.is_extended_id or message.is_error_frame or message.is_remote_frame
    return message.arbitration_id == cia301.SYNC and not special


def _read_log(log: Path) -> Iterator[can.Message]:
    if not log.is_file():
        raise FileNotFoundError(f"{log}: no such log")
    try:
        with can.LogReader(log) as reader:
            yield from reader
    except Exception as error:  # readers raise any exception; each means that the log is malformed
        raise ValueError(
            f"{log}: python-can can't read it ({error}); it reads candump .log, .asc, .blf, .csv, .db, .trc "
            "and these with .gz"
        ) from error
