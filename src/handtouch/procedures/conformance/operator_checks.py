"""Interactive checks: a power cycle, a press and an error, for which the operator is prompted."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator

from handtouch.canbus import cia301
from handtouch.canbus.nodes.boot import read_identity
from handtouch.canbus.objects.mapping import read_mapping
from handtouch.canbus.objects.sdo import BootStepError
from handtouch.procedures.conformance.node_link import MS
from handtouch.procedures.conformance.pdo_checks import configure, sample_counts
from handtouch.procedures.conformance.session import NodeSession
from handtouch.procedures.dialogue import Dialogue, Key

_NAMES = ("operator.power_cycle", "operator.press", "operator.error")
_POLL_NS = 100 * MS
_SAMPLES = 10
_MIN_RISE_SIGMA, _MIN_RISE_COUNTS = 8.0, 5.0


def check_with_operator(session: NodeSession) -> None:
    """Make the interactive checks, if there is an operator."""
    if session.operator is None:
        session.report.not_tested("needs --interactive", *_NAMES)
        return
    _check_power_cycle(session, session.operator)
    _check_press(session, session.operator)
    _check_error(session, session.operator)


def _check_power_cycle(session: NodeSession, operator: Dialogue) -> None:
    name, link, report = "operator.power_cycle", session.link, session.report
    boots = len(link.boot_ups)
    _prompt(operator, "Switch the node's power off and on again.")
    if why := _wait(session, operator, lambda: link.wait(_POLL_NS, lambda: len(link.boot_ups) > boots)):
        report.not_tested(why, name)
        return
    link.wait(1000 * MS)
    count = len(link.boot_ups) - boots
    link.commanded_boots += count
    problems = [f"{count} boot-up messages"] if count > 1 else []
    try:
        if read_identity(session.sdo) != report.identity:
            problems.append("another identity than before")
        if session.mapping is not None:
            node = session.node
            after = read_mapping(session.sdo, node.node_id, node.tpdo_numbers, node.channels)
            if [t.entries for t in after.tpdos] != [t.entries for t in session.mapping.tpdos]:
                problems.append("another mapping than before")
    except BootStepError as error:
        problems.append(str(error))
    report.assess(name, problems)
    session.start_heartbeat()


def _check_press(session: NodeSession, operator: Dialogue) -> None:
    name, report, mapping = "operator.press", session.report, session.mapping
    if mapping is None:
        report.not_tested("no TPDO with the channels", name)
        return
    session.enter_preoperational()
    configure(session)
    session.enter(cia301.START_NODE, cia301.OPERATIONAL)
    rest = sample_counts(session, mapping, 5 * _SAMPLES)
    if len(rest) < _SAMPLES:
        report.not_tested("no samples", name)
        return
    columns = list(zip(*rest, strict=True))
    means = [statistics.fmean(column) for column in columns]
    limits = [max(_MIN_RISE_SIGMA * statistics.pstdev(column), _MIN_RISE_COUNTS) for column in columns]
    strongest = [0.0] * 4

    def rises() -> list[float]:
        now = sample_counts(session, mapping, _SAMPLES)
        if not now:
            return [0.0] * 4
        return [
            statistics.fmean(column) - mean
            for column, mean in zip(zip(*now, strict=True), means, strict=True)
        ]

    def is_pressed() -> bool:
        present = rises()
        strongest[:] = [max(a, b, key=abs) for a, b in zip(strongest, present, strict=True)]
        return all(rise > limit for rise, limit in zip(present, limits, strict=True))

    _prompt(operator, "Press the pad in its middle with a fingertip, and hold it.")
    if why := _wait(session, operator, is_pressed):
        if not any(abs(rise) > limit for rise, limit in zip(strongest, limits, strict=True)):
            report.not_tested(f"no channel responded; {why}", name)
            return
        bad = [
            f"channel {number} {'falls' if rise < -limit else 'does not respond'} ({rise:+.0f} counts)"
            for number, (rise, limit) in enumerate(zip(strongest, limits, strict=True), 1)
            if rise <= limit
        ]
        report.failed(name, "; ".join(bad) or "the channels didn't respond together")
        return
    _prompt(operator, "Release the pad.")

    def is_released() -> bool:
        return all(abs(rise) < limit for rise, limit in zip(rises(), limits, strict=True))

    if _wait(session, operator, is_released):
        report.failed(name, "the counts don't return to those before the press")
    else:
        report.passed(name, ", ".join(f"{rise:+.0f}" for rise in strongest) + " counts")


def _check_error(session: NodeSession, operator: Dialogue) -> None:
    name, link, report = "operator.error", session.link, session.report
    start = len(link.emergencies)
    _prompt(operator, "Cause an error that the node detects, if there is one: a connector, its supply, heat.")
    if why := _wait(session, operator, lambda: link.wait(_POLL_NS, lambda: len(link.emergencies) > start)):
        report.not_tested(why, name)
        return
    problems = list(_register_problems(session))
    _prompt(operator, "Remove the error.")
    if _wait(session, operator, lambda: link.wait(_POLL_NS, lambda: link.emergencies[-1].code == 0)):
        problems.append("no EMCY 0x0000 after the error was removed")
    problems += _register_problems(session)
    report.assess(name, list(dict.fromkeys(problems)), f"EMCY {link.emergencies[start].text}")


def _register_problems(session: NodeSession) -> Iterator[str]:
    """Compare 0x1001 with the latest EMCY message."""
    latest = session.link.emergencies[-1]
    register = session.sdo.read(cia301.ERROR_REGISTER, 0, "error register")
    if register != latest.register:
        yield f"0x1001 is 0x{register:02X}, in the EMCY message it is 0x{latest.register:02X}"


def _prompt(operator: Dialogue, text: str) -> None:
    operator.print_line(f"{text} (s: skip)", "ask")


def _wait(session: NodeSession, operator: Dialogue, until: Callable[[], bool]) -> str:
    """Poll `until`, which takes some time, until it is true; return why it isn't, empty if it is."""
    end_ns = session.link.now_ns() + round(session.options.operator_timeout_s * 1e9)
    while session.link.now_ns() < end_ns:
        if until():
            return ""
        key = operator.read_key()
        if key is Key.QUIT:
            raise KeyboardInterrupt
        if key is Key.SKIP:
            return "skipped"
    return f"nothing within {session.options.operator_timeout_s:g} s"
