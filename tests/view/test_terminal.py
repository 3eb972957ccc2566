"""The live table and the lines show contacts with position, force and uncertainty, and the state of nodes."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import pytest
from rich.console import Console

from handtouch import wire
from handtouch.cli import status
from handtouch.view.displays import LineDisplay
from handtouch.view.message_lines import diagnosis_text, message_line, position_std_m
from handtouch.view.terminal import HandView
from handtouch.wire.health import Emergency


def make_part(position_m: list[float], force_n: float | None, force_std_n: float | None) -> wire.ContactPart:
    """Return one of two contacts on a pad."""
    return {
        "position_m": position_m,
        "normal": [0.0, 0.0, 1.0],
        "covariance_m2": [1e-8] * 9,
        "force_n": force_n,
        "force_std_n": force_std_n,
    }


CONTACT = wire.Contact(
    v=1,
    session=1,
    seq=1,
    retained=False,
    t_ns=12_000_000_000,
    event="begin",
    id=7,
    hand="right",
    link="thumb_tip",
    frame="thumb_tip",
    begin_ns=11_500_000_000,
    duration_s=0.5,
    age_s=0.001,
    position_m=(0.0123, -0.004, 0.0056),
    normal=(0.0, 0.0, 1.0),
    covariance_m2=(4e-10, 0, 0, 0, 3e-10, 0, 0, 0, 2e-10),
    pad_m=(0.01, 0.02),
    position_status="valid",
    force_n=1.234,
    force_std_n=0.056,
    peak_force_n=2.5,
    force_status="valid",
    total_current_a=1e-3,
    residual=0.0,
    residual_std=1e-4,
    begin_threshold_n=0.06,
    end_threshold_n=0.03,
    calibration_id="nominal",
    end_reason="",
)
HEALTH = wire.Health(
    v=1,
    session=1,
    seq=1,
    retained=False,
    t_ns=12_000_000_000,
    hand="right",
    link="thumb_tip",
    bus="can0",
    node_id=19,
    state="clear",
    node_state="operational",
    node_state_since_ns=0,
    sampling="sync",
    reason="",
    serial=1003,
    rate_hz=200.0,
    samples=10,
    missed_samples=0,
    age_s=0.001,
    reboots=0,
    heartbeats_missed=0,
    emergencies=(),
)
SERVICE = wire.Service(
    v=1,
    session=1,
    seq=1,
    retained=False,
    t_ns=12_000_000_000,
    wall_offset_ns=0,
    version="0",
    pid=1,
    uptime_s=3.0,
    period_s=0.005,
    hands={"right": ["thumb_tip"]},
    ticks=600,
    overruns=0,
    rate_hz=200.0,
    core_compiled=True,
    tick_us={"p50": 250.0, "p99": 400.0, "max": 500.0},
    buses={"can0": {"load": 0.43}},
    congestion_episodes={},
    loop={},
    contacts=0,
    rejected={},
    process={},
    subscriptions=(),
)


def _page(view: HandView, problem: str = "", width: int = 120, height: int = 40) -> str:
    console = Console(width=width, height=height, force_terminal=False)
    view.problem = problem
    with console.capture() as captured:
        console.print(view, height=height)
    return captured.get()


def _view(*messages: wire.Message) -> HandView:
    view = HandView("test")
    for message in messages:
        view.update(message)
    return view


def test_the_table_shows_a_contact_with_position_force_and_uncertainty() -> None:
    page = _page(_view(HEALTH, SERVICE, CONTACT))
    assert "12.30   -4.00    5.60" in page
    assert "0.030" in page  # mm: root of the summed variances
    assert "1.23 +- 0.06 N" in page
    assert "touched" in page
    assert "1/1 nodes operational" in page
    assert "200 ticks/s" in page
    assert "can0 43 %" in page


def test_an_ended_contact_moves_from_the_table_to_the_events() -> None:
    page = _page(_view(HEALTH, CONTACT, replace(CONTACT, event="end", end_reason="released", seq=2)))
    assert "12.30   -4.00    5.60" not in page
    assert "#7 released after 0.50 s, peak 2.50 N" in page


def test_a_lost_node_is_shown_with_its_reason() -> None:
    lost = replace(HEALTH, seq=2, state="lost", node_state="absent", reason="lost: no heartbeat for 350 ms")
    page = _page(_view(HEALTH, lost))
    assert "lost" in page
    assert "no heartbeat for 350 ms" in page
    assert "0/1 nodes operational" in _page(_view(HEALTH, SERVICE, lost))


def test_a_disconnected_daemon_differs_from_an_untouched_hand() -> None:
    problem = (
        "tcp://127.0.0.1:5581 is no stream of messages, perhaps a control endpoint; the live stream is X"
    )
    for width in (80, 120):
        assert " ".join(_page(_view(), problem, width).replace("│", "").split()).count(problem) == 1
        assert "nodes operational" not in _page(_view(HEALTH, SERVICE), problem, width)
    assert "nodes operational" in _page(_view(HEALTH, SERVICE))


@pytest.mark.parametrize("width", [80, 120])
def test_a_heading_has_no_cut_words_and_names_a_daemon_that_is_late(width: int) -> None:
    late = replace(SERVICE, rate_hz=17.0, overruns=500, congestion_episodes={"live": 12_345})
    page = _page(_view(HEALTH, late), width=width)
    assert "17 of 200 ticks/s" in page
    assert "…" not in page
    idle = _page(_view(HEALTH, replace(SERVICE, rate_hz=74.0)), width=width)  # ticks that nobody needs
    assert "   74 ticks/s" in idle


@pytest.mark.parametrize("width", [80, 120])
def test_pads_that_change_together_are_one_event_with_its_whole_reason(width: int) -> None:
    links = [f"middle_proximal_{k}" for k in range(12)]
    pads = [replace(HEALTH, link=link) for link in links]
    remedy = "as from every pad of bus can0; check that the nodes' programs run, and the host's load"
    silent = [
        replace(pad, node_state="stale", t_ns=pad.t_ns + k, reason=f"no sample for {20 + k} ms, {remedy}")
        for k, pad in enumerate(pads)
    ]
    later = replace(pads[0], t_ns=pads[0].t_ns + 10**9)
    begun = [replace(CONTACT, link=link, id=k) for k, link in enumerate(links[:2])]
    page = " ".join(_page(_view(*pads, *silent, later, *begun), width=width).replace("│", "").split())
    assert page.count("no sample for") == 1
    assert "and 8 more: pad clear, node stale: no sample for 20 ms," in page
    assert remedy in page
    assert "middle_proximal_0: pad clear, node operational" in page
    assert "#0 begins" in page
    assert "#1 begins" in page


def test_lines_in_a_terminal_keep_the_reason_of_a_pad(capsys: pytest.CaptureFixture[str]) -> None:
    display = LineDisplay(columns=80)
    display.show_message(replace(HEALTH, state="stale", reason="no sample for 36 ms; check the cable"))
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert "no sample for 36 ms; check the cable" in " ".join(text.split())


@pytest.mark.parametrize(
    ("contact", "text"),
    [
        (CONTACT, "at (  12.30,   -4.00,    5.60) mm +- 0.030"),
        (replace(CONTACT, force_status="lower_bound", force_std_n=None), "> 1.23 N (saturated)"),
        (replace(CONTACT, force_status="invalid", force_n=None), "force invalid"),
        (
            replace(CONTACT, position_m=None, covariance_m2=None, position_status="invalid"),
            "position invalid",
        ),
        (
            replace(CONTACT, force_vector_status="valid", force_vector_n=(0.5, -0.25, -1.2)),
            "vector (  0.50,  -0.25,  -1.20) N",
        ),
        (replace(CONTACT, force_vector_status="invalid"), "vector invalid"),
        (
            replace(
                CONTACT,
                parts=(
                    make_part([0.001, 0.002, 0.003], 1.5, 0.25),
                    make_part([-0.01, 0.002, 0.003], None, None),
                ),
            ),
            "2 contacts: (1.00, 2.00, 3.00) mm 1.50 +- 0.25 N and (-10.00, 2.00, 3.00) mm",
        ),
        (replace(CONTACT, event="end", end_reason="lost"), "lost after 0.50 s, peak 2.50 N"),
    ],
)
def test_a_contact_line_shows_values_or_their_status(contact: wire.Contact, text: str) -> None:
    assert text in message_line(contact)


def test_every_kind_of_message_has_a_line() -> None:
    frame = wire.HandFrame(
        **{**dict.fromkeys(wire.COLUMNS[wire.HandFrame], b""), "state": b"\1\0"},
        v=1, session=1, seq=1, t_ns=1, tick=5, hand="right", links=("a", "b"), retained=False,
    )  # fmt: skip
    raw = wire.Raw(1, 1, 1, 1, 5, "right", ("a", "b"), b"", b"", b"\1\1", False)
    assert "1 of 2 touched" in message_line(frame)
    assert "2 fresh" in message_line(raw)
    assert "600" not in message_line(HEALTH)
    assert "serial 1003" in message_line(HEALTH)
    assert "200 ticks/s" in message_line(SERVICE)


def test_pads_that_are_off_are_listed_after_faults() -> None:
    assert "operational (event)" in message_line(replace(HEALTH, sampling="event"))
    pads = [
        replace(HEALTH, link=f"pad_{n}", state="off", node_state="stopped", sampling="off") for n in range(40)
    ]
    page = _page(_view(*pads, replace(HEALTH, link="last", state="lost")), height=20)
    assert "lost" in page
    assert "last" in page


def test_a_position_without_covariance_has_no_standard_deviation() -> None:
    assert position_std_m(replace(CONTACT, covariance_m2=None)) != position_std_m(CONTACT)


def test_plain_lines_omit_repetitions(capsys: pytest.CaptureFixture[str]) -> None:
    display = LineDisplay()
    display.show_message(HEALTH)
    display.show_message(replace(HEALTH, seq=2, samples=20))
    display.show_message(replace(HEALTH, seq=3, state="stale", reason="no samples"))
    for k in range(20):
        display.show_message(replace(CONTACT, event="update", t_ns=CONTACT.t_ns + k * 5_000_000))
    printed = capsys.readouterr().out.splitlines()
    assert len([text for text in printed if "health" in text]) == 2
    assert len([text for text in printed if "update" in text]) == 1


def test_json_lines_contain_every_message_completely(capsys: pytest.CaptureFixture[str]) -> None:
    import json

    LineDisplay(as_json=True).show_message(CONTACT)
    assert json.loads(capsys.readouterr().out)["force_n"] == 1.234


def test_json_lines_have_null_for_numbers_that_json_lacks(capsys: pytest.CaptureFixture[str]) -> None:
    import json

    LineDisplay(as_json=True).show_message(replace(CONTACT, residual=math.inf))
    line = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert line["residual"] is None


def _hand(pads: int, touched: int) -> HandView:
    messages: list[wire.Message] = [SERVICE]
    messages += [replace(HEALTH, link=f"middle_proximal_{k}") for k in range(pads)]
    messages += [replace(CONTACT, link=f"middle_proximal_{k}") for k in range(pads - touched, pads)]
    return _view(*messages)


@pytest.mark.parametrize(("width", "height"), [(160, 50), (120, 30), (100, 24), (80, 24), (60, 24), (40, 10)])
def test_the_table_fits_any_terminal_and_lists_touched_pads(width: int, height: int) -> None:
    lines = _page(_hand(15, 2), width=width, height=height).splitlines()
    assert len(lines) <= height
    assert all(len(text) <= width for text in lines)
    text = "\n".join(lines)
    assert "middle_proxi" in text
    assert "touched" in text
    if width >= 80:
        assert "middle_proximal_14" in text
        assert "1.23 +- 0.06 N" in text
        assert "12.30   -4.00    5.60" in text


@pytest.mark.parametrize("height", [12, 24, 50])
def test_events_use_the_height_that_the_pads_leave(height: int) -> None:
    view = HandView()
    view.update(HEALTH)
    for number in range(60):
        view.update(replace(CONTACT, id=number, event="begin"))
    lines = _page(view, width=120, height=height).splitlines()
    assert len(lines) == height
    frame, header, pads = 2, 2, 1
    assert sum("begins" in line for line in lines) == height - frame - header - pads
    assert "#59 begins" in lines[-2]


def test_only_whole_events_are_shown() -> None:
    view = _view(HEALTH, replace(HEALTH, node_state="stale", reason="a long reason " * 20))
    page = _page(view, width=80, height=7)
    assert "stale: a long" in page  # the newest one, cut
    view.update(replace(CONTACT, id=60))
    lines = _page(view, width=80, height=8).splitlines()
    assert sum("reason" in line for line in lines) == 0
    assert any("#60 begins" in line for line in lines)


def test_pads_are_in_the_order_of_the_hand() -> None:
    links = ["thumb_tip", "index_tip", "palm"]
    pads = [replace(HEALTH, link=link) for link in sorted(links)]
    page = _page(_view(*pads, replace(SERVICE, hands={"right": links})))
    assert [page.index(link) for link in links] == sorted(page.index(link) for link in links)


def test_touched_pads_come_first_in_a_small_terminal() -> None:
    page = _page(_hand(40, 3), width=100, height=20)
    assert all(f"middle_proximal_{k} " in page for k in (37, 38, 39))
    assert "more" in page


GUM = {
    "kind": "gum", "cause": "chewing gum, 10 mm from x0", "evidence": "it stands for 60 s",
    "remedy": "wipe it off", "since_ns": 1, "confidence": 0.99, "pad_m": [0.01, 0.02], "size_m": 0.006,
}  # fmt: skip


def test_a_diagnosis_is_shown_once_with_position_and_remedy(
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = replace(HEALTH, calibration_state="quarantined", diagnoses=(GUM,))
    assert "chewing gum, 10 mm from x0 (it stands" in _page(_view(HEALTH, found), width=200)
    assert "calibrated again" in _page(_view(HEALTH, found, replace(HEALTH, calibration_state="calibrated")))
    display = LineDisplay()
    for message in (HEALTH, found, found):
        display.show_message(message)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert "quarantined" in lines[1]
    assert lines[1].endswith("(it stands for 60 s): wipe it off")


def test_a_diagnosis_with_missing_keys_is_shown() -> None:
    assert diagnosis_text({"kind": "new thing"}) == "new thing"


def test_status_shows_diagnoses_the_supervisor_and_the_store(capsys: pytest.CaptureFixture[str]) -> None:
    figures = {
        "state": "running", "pid": 7, "restarts": 1, "exit_reason": "killed by signal 9", "lag_s": 0.31,
        "dropped": 0, "malformed": 0, "late": 0, "summary": "3 calibrated",
        "store_error": "it is damaged",
    }  # fmt: skip
    bus = {
        "state": "active", "load": 0.43, "problem": "no acknowledge", "causes": {"ack": 2}, "lost": 1,
        "sync": {"by": "daemon", "problem": "", "jitter_us": {"p99": 80.0, "max": 90.0}},
    }  # fmt: skip
    service = asdict(SERVICE) | {
        "supervisor": figures, "buses": {"can0": bus}, "congestion_episodes": {"live": 3},
        "loop": {"stages": {"tick": {"sum_s": 0.004, "counts": [3, 1]}}, "late": {"report": 2}},
        "process": {"memory_bytes": 10**8, "cpu_s": 3.5, "loop_cpu_s": 3.0},
    }  # fmt: skip
    errors = (
        Emergency(0x2310, 3, "0000000000", "0x2310 current", 1, cleared_ns=2),
        Emergency(0x5000, 1, "0000000000", "0x5000 device hardware", 3),
    )
    failing = replace(HEALTH, sampling="event", emergencies=tuple(error.to_map() for error in errors))
    pads = [asdict(replace(HEALTH, diagnoses=(GUM,))), asdict(failing)]
    answer = {"service": service, "scene": {"scenes": [], "pads": []}, "pads": pads}
    status.print_status(answer, Console(width=200), verbose=True)
    printed = capsys.readouterr().out
    assert (
        "supervisor running, process 7, 0.3 s behind, 1 restarts (last exit: killed by signal 9)" in printed
    )
    assert "calibration store: it is damaged" in printed
    assert "right/thumb_tip: chewing gum, 10 mm from x0 (it stands" in printed
    assert "600 ticks at 200 Hz, 0 overruns, tick 250 us (p99 400, max 500)" in printed
    assert "congestion episodes: live 3; subscriptions: none" in printed
    assert "mean time per cycle, ms: tick 1.00; late ticks: report 2" in printed
    assert (
        "bus can0: active, load 43 %, SYNC by daemon (jitter p99 80 us, max 90), lost 1; "
        "error frames: ack 2 no acknowledge" in printed
    )
    assert "operational (event)" in printed
    assert "EMCY 0x5000 device hardware" in printed
    assert "0x2310" not in printed  # cleared
    assert not status.is_ok({"state": "clear", "calibration_state": "quarantined"})
    assert not status.is_all_ok(answer | {"pads": []})
    assert status.is_all_ok({"service": {"supervisor": figures | {"store_error": ""}}, "pads": []})
