"""Checks of the TPDOs that carry the channels: mapping, configuration, answers to SYNC, counts."""

from __future__ import annotations

import math
import statistics
import struct
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from handtouch.canbus import cia301
from handtouch.canbus.nodes.boot import configure_node, set_transmission
from handtouch.canbus.objects.mapping import NodeTpdo, PdoMapping, read_mapping, write_entries
from handtouch.canbus.objects.sdo import BootStepError
from handtouch.core.slab import ChannelField
from handtouch.procedures.conformance.node_link import MS, SyncCycle
from handtouch.procedures.conformance.results import RateMeasurement, Verdict
from handtouch.procedures.conformance.session import NodeSession

_SILENCE_NS = 300 * MS
_TRIAL_PERIOD_NS, _TRIAL_SYNCS = 20 * MS, 5
_EVENT_TIMER_MS = 50
_MAX_LATE_SHARE = 0.01
_MAX_ATTEMPTS = 3
_MAX_SYNC_ERROR = 0.2
"""Error of SYNC over a period; above it this computer, not the node, may be the cause of late TPDOs."""
_MAX_NOISE_RATIO = 2.0
_NOISE_COUNTS_LIMIT = 0.01
"""Fraction of the range above which noise is a fault where the deployment states none."""
_TPDO_CHECKS = ("pdo.configure", "pdo.remapping")
_STREAM_CHECKS = (
    "pdo.length",
    "pdo.complete",
    "pdo.delay",
    "pdo.without_sync",
    "pdo.event_timer",
    "channels.range",
    "channels.noise",
)

Counts = Sequence[tuple[float, ...]]


def check_mapping(session: NodeSession) -> None:
    """Find the TPDOs with the channels, as handtouch does at boot; the node is in pre-operational."""
    node, report = session.node, session.report
    may_remap = session.enter_preoperational if node.allow_pdo_remapping else None
    try:
        mapping = read_mapping(session.sdo, node.node_id, node.tpdo_numbers, node.channels, may_remap)
    except BootStepError as error:
        report.failed("pdo.mapping", str(error))
        report.not_tested("no TPDO with the channels", *_TPDO_CHECKS, *_STREAM_CHECKS)
        return
    session.mapping = mapping
    session.link.pdo_ids = {tpdo.cob_id for tpdo in mapping.tpdos}
    names = ", ".join(f"TPDO{tpdo.number} with COB-ID 0x{tpdo.cob_id:X}" for tpdo in mapping.tpdos)
    report.passed("pdo.mapping", names)


def configure(session: NodeSession) -> None:
    """Check disabling, and configure the TPDOs as handtouch does; the node is in pre-operational."""
    mapping, report = session.mapping, session.report
    if mapping is None:
        return
    remapping = []
    try:
        for tpdo in mapping.tpdos:
            session.sdo.write_tpdo(tpdo.number, 1, tpdo.disabled_entry)
            remapping += _remap(session, tpdo)
            session.sdo.write_tpdo(tpdo.number, 1, tpdo.enabled_entry)
        enabled = PdoMapping(tuple(_as_enabled(tpdo) for tpdo in mapping.tpdos), mapping.layout)
        result = configure_node(session.sdo, enabled, session.node, session.enter_preoperational)
    except BootStepError as error:
        report.failed("pdo.configure", str(error))
        return
    report.passed("pdo.configure", result.refusal)
    if not remapping:
        report.passed("pdo.remapping")
    elif all(constant for constant, _ in remapping):
        report.not_tested("the mapping is read-only, which is allowed", "pdo.remapping")
    else:
        report.failed("pdo.remapping", "; ".join(text for constant, text in remapping if not constant))


def check_stream(session: NodeSession) -> None:
    """Check the TPDOs of an operational node: silence, answers to SYNC at each rate, counts."""
    mapping, report = session.mapping, session.report
    if mapping is None or report.verdict("pdo.configure") is Verdict.FAILED:
        report.not_tested("the TPDO can't be configured", *_STREAM_CHECKS)
        return
    state = session.enter(cia301.START_NODE, cia301.OPERATIONAL)
    link = session.link
    if state not in (None, cia301.OPERATIONAL) and not any(
        cycle.pdos for cycle in link.send_syncs(_TRIAL_PERIOD_NS, _TRIAL_SYNCS)
    ):
        report.not_tested("the node doesn't enter operational", *_STREAM_CHECKS)
        return
    link.pdos.clear()
    link.wait(_SILENCE_NS)
    silent = len(link.pdos)
    report.assess("pdo.without_sync", [f"{silent} TPDOs in {_SILENCE_NS // MS} ms"] if silent else [])
    counts: list[tuple[float, ...]] = []
    lengths: set[tuple[int, int]] = set()
    for factor in (4, 2, 1):
        measurement, cycles = _measure_rate(session, mapping, factor * session.options.sync_period_ms)
        report.rates.append(measurement)
        counts += _counts_of(cycles, mapping)
        lengths |= {(cob_id, len(data)) for cycle in cycles for cob_id, data, _ in cycle.pdos}
    _assess_rates(session)
    sizes = {tpdo.cob_id: tpdo.size_bytes for tpdo in mapping.tpdos}
    wrong = [
        f"COB-ID 0x{cob_id:X}: {length} bytes, {sizes[cob_id]} are mapped"
        for cob_id, length in sorted(lengths)
        if length != sizes[cob_id]
    ]
    if lengths:
        report.assess("pdo.length", wrong)
    else:
        report.not_tested("no TPDO", "pdo.length")
    _assess_counts(session, mapping, counts)
    _check_event_timer(session, mapping)


def sample_counts(session: NodeSession, mapping: PdoMapping, count: int) -> Counts:
    """Return the counts of that many SYNCs; SYNCs without a whole sample are left out."""
    cycles = session.link.send_syncs(round(4 * session.options.sync_period_ms * MS), count)
    return _counts_of(cycles, mapping)


def _measure_rate(
    session: NodeSession, mapping: PdoMapping, period_ms: float
) -> tuple[RateMeasurement, list[SyncCycle]]:
    """Measure one rate; repeated if TPDOs were late, since this computer may have paused."""
    session.progress(f"SYNC every {period_ms:g} ms")
    attempts = []
    for _ in range(_MAX_ATTEMPTS):
        cycles = session.link.send_syncs(round(period_ms * MS), session.options.syncs)
        attempts.append((_measure(cycles, mapping, period_ms, session.options.window_fraction), cycles))
        if not attempts[-1][0].late:
            break
    return min(attempts, key=lambda attempt: attempt[0].late)


def _measure(
    cycles: Sequence[SyncCycle], mapping: PdoMapping, period_ms: float, window_fraction: float
) -> RateMeasurement:
    ids = {tpdo.cob_id for tpdo in mapping.tpdos}
    delays_us, received = [], 0
    window_us = period_ms * 1e3 * window_fraction
    for cycle in cycles:
        arrivals = {cob_id: arrival for cob_id, _, arrival in reversed(cycle.pdos)}  # the first of each
        received += len(cycle.pdos)
        if arrivals.keys() == ids:
            delays_us.append((max(arrivals.values()) - cycle.sync_ns) * 1e-3)
    expected = len(cycles) * len(ids)
    gaps = [b.sync_ns - a.sync_ns for a, b in pairwise(cycles)]
    delays_us.sort()
    late = sum(delay > window_us for delay in delays_us)
    return RateMeasurement(
        period_ms=period_ms,
        syncs=len(cycles),
        missing=max(0, expected - received),
        extra=max(0, received - expected),
        late=late + (len(cycles) - len(delays_us)),
        median_us=round(statistics.median(delays_us), 1) if delays_us else None,
        p99_us=round(delays_us[math.ceil(0.99 * len(delays_us)) - 1], 1) if delays_us else None,
        max_us=round(delays_us[-1], 1) if delays_us else None,
        jitter_us=round(statistics.pstdev(delays_us), 1) if delays_us else None,
        worst_sync_error_us=round(max(abs(gap - period_ms * MS) for gap in gaps) * 1e-3, 1),
    )


def _assess_rates(session: NodeSession) -> None:
    report = session.report
    lost, late, texts = [], [], []
    for rate in report.rates:
        name = f"{1e3 / rate.period_ms:g} Hz"
        if rate.missing:
            lost.append(f"{name}: {rate.missing} of {rate.syncs} SYNCs without TPDO")
        if rate.extra:
            lost.append(f"{name}: {rate.extra} TPDOs too many")
        if rate.median_us is None:
            continue
        text = f"{name}: median {rate.median_us / 1e3:.2f} ms, longest {(rate.max_us or 0) / 1e3:.2f} ms"
        texts.append(f"{text}, jitter {rate.jitter_us:.0f} us")
        if rate.late - rate.missing > _MAX_LATE_SHARE * rate.syncs:
            window_ms = rate.period_ms * session.options.window_fraction
            late.append(f"{text}; {rate.late} of {rate.syncs} later than {window_ms:g} ms")
    report.assess("pdo.complete", lost)
    period_error = max(rate.worst_sync_error_us / 1e3 / rate.period_ms for rate in report.rates)
    if not texts:
        report.not_tested("no TPDO", "pdo.delay")
    elif late and period_error > _MAX_SYNC_ERROR:
        paused = f"this computer paused: its SYNCs were up to {period_error:.0%} of a period early or late"
        report.not_tested(f"{paused}; {'; '.join(late)}", "pdo.delay")
    else:
        report.assess("pdo.delay", late, "; ".join(texts))


def _assess_counts(session: NodeSession, mapping: PdoMapping, counts: Counts) -> None:
    report = session.report
    if len(counts) < 2:
        report.not_tested("no samples", "channels.range", "channels.noise")
        return
    range_problems, noise_problems = [], []
    columns = list(zip(*counts, strict=True))
    report.channel_noise = [round(statistics.pstdev(column), 2) for column in columns]
    for number, (field, column) in enumerate(zip(mapping.layout, columns, strict=True), 1):
        low, high = field.limits
        span = high - low
        if max(column) >= high or (min(column) <= low and low < 0):
            range_problems.append(f"channel {number} reads {column[-1]:g}, the end of its range")
            continue
        noise = statistics.pstdev(column)
        expected = session.node.noise_counts
        limit = _NOISE_COUNTS_LIMIT * span if expected is None else _MAX_NOISE_RATIO * expected
        if noise == 0:
            noise_problems.append(f"channel {number} reads {column[0]:g} in all {len(column)} samples")
        elif noise > limit:
            noise_problems.append(f"channel {number} has noise of {noise:.1f} counts, above {limit:g}")
    if sum("above" in problem for problem in noise_problems) > 1:
        noise_problems.append("was the pad touched?")
    noises = ", ".join(f"{noise:g}" for noise in report.channel_noise)
    report.assess("channels.range", range_problems)
    report.assess("channels.noise", noise_problems, f"{noises} counts (1 sigma)")


def _check_event_timer(session: NodeSession, mapping: PdoMapping) -> None:
    """Check the event-driven transmission that handtouch uses while a pad is idle."""
    report, link = session.report, session.link
    if len(mapping.tpdos) > 1:
        report.not_tested("the channels are in several TPDOs, so idling isn't used", "pdo.event_timer")
        return
    tpdo = _as_enabled(mapping.tpdos[0])
    index = cia301.TPDO_COMMUNICATION + tpdo.number - 1
    try:
        if session.sdo.read_optional(index, 5, "event timer") is None:
            report.not_tested(f"no event timer (0x{index:04X}:05), which is allowed", "pdo.event_timer")
            return
        session.enter_preoperational()
        session.sdo.write_tpdo(tpdo.number, 1, tpdo.disabled_entry)
        session.sdo.write_tpdo(tpdo.number, 5, _EVENT_TIMER_MS)
        session.sdo.write_tpdo(tpdo.number, 1, tpdo.enabled_entry)
        set_transmission(session.sdo, tpdo, True)
    except BootStepError as error:
        report.failed("pdo.event_timer", str(error))
        return
    session.enter(cia301.START_NODE, cia301.OPERATIONAL)
    link.pdos.clear()
    link.wait(10 * _EVENT_TIMER_MS * MS)
    received = len(link.pdos)
    problems = [f"{received} TPDOs in 10 periods of the event timer"] if received < 5 else []
    report.assess("pdo.event_timer", problems, f"{received} TPDOs in {10 * _EVENT_TIMER_MS} ms")
    session.enter_preoperational()
    link.pdos.clear()


def _remap(session: NodeSession, tpdo: NodeTpdo) -> list[tuple[bool, str]]:
    """Write a disabled TPDO's mapping again; return the refusals, each with True for a read-only one."""
    try:
        write_entries(session.sdo, tpdo.number, tpdo.entries)
    except BootStepError as error:
        code = getattr(error.__cause__, "code", None)
        return [(code in (0x06010000, 0x06010002), str(error))]
    return []


def _as_enabled(tpdo: NodeTpdo) -> NodeTpdo:
    return replace(tpdo, enabled=True)


def _counts_of(cycles: Sequence[SyncCycle], mapping: PdoMapping) -> list[tuple[float, ...]]:
    """Return the counts of the cycles in which every TPDO arrived with the length of its mapping."""
    samples = []
    for cycle in cycles:
        data = {cob_id: payload for cob_id, payload, _ in reversed(cycle.pdos)}
        payloads = [data.get(tpdo.cob_id, b"") for tpdo in mapping.tpdos]
        sizes = [tpdo.size_bytes for tpdo in mapping.tpdos]
        if [len(payload) for payload in payloads] == sizes:
            samples.append(tuple(_count(field, payloads[field.pdo]) for field in mapping.layout))
    return samples


def _count(field: ChannelField, payload: bytes) -> float:
    raw = int.from_bytes(payload, "little") >> field.first_bit & (1 << field.bits) - 1
    if field.counts_per_unit is not None:
        (value,) = struct.unpack("<f", raw.to_bytes(4, "little"))
        return float(value * field.counts_per_unit)
    return float(raw - (1 << field.bits) if field.signed and raw >> field.bits - 1 else raw)
