"""Log levels of node and bus events by severity; `service` states how often frames come."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.canbus.bus.bus_state import BusFault, BusState, ErrorState
from handtouch.canbus.bus.router import BusCounters
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.spec import ErrorChanged, MasterEvent, NodeEvent, SerialChanged
from handtouch.config import Behaviour
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.status_reporter import Buses, Statistics, StatusReporter, Workers
from handtouch.wire.health import Emergency
from tests.sheet.test_bank import Pads

PERIOD_NS = 5_000_000
SECOND_NS = 1_000_000_000


class Rig:
    """A reporter with a master and a bus whose states the test sets."""

    def __init__(self, bench: Any) -> None:
        self.events: list[MasterEvent] = []
        self.bus_state = BusState()
        self.sync = SimpleNamespace(period_ns=PERIOD_NS, overruns=0, report=lambda *_: {})
        self.services: list[wire.Service] = []
        pipeline = self.pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, self)
        master = SimpleNamespace(drain_events=self._drain, states=np.full(3, NodeState.OPERATIONAL))
        port = SimpleNamespace(bus_state=self.bus_state, counters=BusCounters())
        publisher = SimpleNamespace(
            has_subscriber=lambda topic: topic == "service", send=self.services.append, session=1,
            congestion_episodes={}, subscriptions=(),
        )  # fmt: skip
        ports: Any = {"can0": port}
        parts: tuple[Any, ...] = (Buses(master, ports, self.sync), publisher)  # type: ignore[arg-type]
        self.reporter = StatusReporter(
            bench.deployment,
            pipeline,
            *parts,
            started_ns=0,
            statistics=Statistics(lambda: 0, process=dict, refusals=dict, inputs=lambda _: {}),
            workers=Workers(),
        )
        self.now_ns = SECOND_NS

    def has_subscriber(self, _: str) -> bool:
        return False

    def send(self, _: object) -> None:
        raise AssertionError("no subscriber")

    def poll(self, after_ns: int = SECOND_NS) -> None:
        self.now_ns += after_ns
        self.reporter.poll(self.now_ns)

    def update_bus(self, fault: BusFault | None, queue_full: int = 0) -> None:
        self.bus_state.update(self.now_ns, 0, 0, queue_full, fault)

    def bus_lines(self, caplog: pytest.LogCaptureFixture) -> list[tuple[int, str]]:
        return [(r.levelno, r.getMessage()) for r in caplog.records if r.name == "handtouch.bus"]

    def _drain(self) -> list[MasterEvent]:
        events, self.events = self.events, []
        return events


@pytest.fixture
def rig(bench: Any, caplog: pytest.LogCaptureFixture) -> Rig:
    caplog.set_level("INFO", "handtouch")
    return Rig(bench)


@pytest.mark.parametrize(
    ("old", "new", "level"),
    [
        (NodeState.OPERATIONAL, NodeState.FAULTED, logging.ERROR),
        (NodeState.OPERATIONAL, NodeState.ABSENT, logging.WARNING),
        (NodeState.OPERATIONAL, NodeState.STALE, logging.WARNING),
        (NodeState.OPERATIONAL, NodeState.BOOTING, logging.WARNING),
        (NodeState.STALE, NodeState.BOOTING, logging.WARNING),
        (NodeState.SETTLING, NodeState.OPERATIONAL, logging.INFO),
        (NodeState.ABSENT, NodeState.BOOTING, logging.INFO),
        (NodeState.ABSENT, NodeState.ABSENT, logging.INFO),
    ],
)
def test_node_events_are_logged_by_severity(
    rig: Rig, caplog: pytest.LogCaptureFixture, old: NodeState, new: NodeState, level: int
) -> None:
    rig.events = [NodeEvent(0, rig.now_ns, old, new, "no heartbeat for 352 ms")]
    rig.poll()
    (record,) = [record for record in caplog.records if record.name == "handtouch.health"]
    assert record.levelno == level
    assert "(h/plane): " in record.getMessage()
    assert record.getMessage().startswith("node 0x")
    assert "no heartbeat for 352 ms" in record.getMessage()


def test_what_happens_to_several_nodes_at_once_is_one_line_that_is_found_by_each_pad(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    stale, lost = NodeState.STALE, NodeState.ABSENT
    silent = [
        NodeEvent(
            slot, rig.now_ns, NodeState.OPERATIONAL, stale, f"no sample for {20 + slot} ms, as from all"
        )
        for slot in (0, 1)
    ]
    rig.events = [*silent, NodeEvent(0, rig.now_ns, stale, lost, "no heartbeat for 352 ms")]
    rig.poll()
    both, one = [record for record in caplog.records if record.name == "handtouch.health"]
    assert re.fullmatch(
        r"2 nodes 0x.. \(h/plane\), 0x.. \(h/round\): "
        "operational -> stale: no sample for 20 ms, as from all",
        both.getMessage(),
    )
    assert both.__dict__["fields"] == {"hand": ["h"], "link": ["plane", "round"]}
    assert one.getMessage().endswith("(h/plane): stale -> absent: no heartbeat for 352 ms")


def test_a_longer_period_of_frames_is_published_before_the_next_frame_is_late(rig: Rig) -> None:
    rig.poll()
    assert rig.services[-1].frame_period_s == pytest.approx(0.005)
    for change in ("sync", "scene", "none"):
        if change == "sync":
            rig.sync.period_ns = 4 * PERIOD_NS
        elif change == "scene":
            rig.pipeline.state.ticks_per_hand_frame[0] = 10
        before = len(rig.services)
        rig.poll(1_000_000)
        published = rig.services[before:]
        expected = {"sync": [0.02], "scene": [0.2], "none": []}[change]
        assert [service.frame_period_s for service in published] == pytest.approx(expected)
    rig.sync.period_ns = PERIOD_NS  # a shorter one isn't urgent
    before = len(rig.services)
    rig.poll(1_000_000)
    assert len(rig.services) == before
    rig.poll()
    assert rig.services[-1].frame_period_s == pytest.approx(0.05)


def test_emcy_is_a_warning_and_its_clearing_information(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "handtouch.health")
    error = Emergency(0x5000, 1, "2f74000000", "0x5000 device hardware (register: generic)", SECOND_NS)
    rig.events = [ErrorChanged(1, rig.now_ns, error)]
    rig.events += [ErrorChanged(1, rig.now_ns, replace(error, cleared_ns=3 * SECOND_NS))]
    rig.poll()
    logged = [(r.levelno, r.getMessage().partition(": ")[2]) for r in caplog.records]
    assert logged == [
        (
            logging.WARNING,
            "EMCY 0x5000 device hardware (register: generic), manufacturer-specific 2f74000000",
        ),
        (logging.INFO, "EMCY 0x5000 device hardware (register: generic): cleared after 2.0 s"),
    ]


def test_replaced_node_is_a_warning(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    rig.events = [SerialChanged(1, rig.now_ns, 11, 21)]
    rig.poll()
    assert [r.levelno for r in caplog.records if r.name == "handtouch.health"] == [logging.WARNING]


@pytest.mark.parametrize(
    ("state", "level", "text"),
    [
        (ErrorState.WARNING, logging.WARNING, "error-warning: check wiring"),
        (ErrorState.PASSIVE, logging.WARNING, "error-passive: check wiring"),
        (ErrorState.BUS_OFF, logging.ERROR, "bus-off (mostly "),
        (ErrorState.DOWN, logging.ERROR, "no cable: ip link set can0 up"),
    ],
)
def test_bus_states_are_logged_once_by_severity(
    rig: Rig, caplog: pytest.LogCaptureFixture, state: ErrorState, level: int, text: str
) -> None:
    rig.poll()
    rig.update_bus(BusFault(state, "no cable"))
    rig.poll()
    rig.poll()
    rig.now_ns += 2 * SECOND_NS
    rig.update_bus(None)
    rig.poll()
    (level_bad, bad), good = rig.bus_lines(caplog)
    assert level_bad == level
    assert bad.startswith(f"bus can0: active -> {state.value}: {text.partition(' (')[0]}")
    assert good == (logging.INFO, f"bus can0: {state.value} -> active after 4.0 s")


def test_every_transition_between_two_polls_is_logged(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    """A controller that restarts itself is bus-off for a millisecond."""
    rig.poll()
    for classes, byte in ((0x4, 0x04), (0x4, 0x20), (0x40, 0), (0x100, 0)):
        rig.now_ns += 1_000_000
        rig.bus_state.handle_error_frame(classes, bytes((0, byte, 0, 0, 0, 0, 0, 0)), rig.now_ns, 0, 0)
    rig.reporter.poll(rig.now_ns)
    assert [line[0] for line in rig.bus_lines(caplog)] == [
        logging.WARNING,
        logging.WARNING,
        logging.ERROR,
        logging.INFO,
    ]
    assert rig.bus_lines(caplog)[-1][1] == "bus can0: bus-off -> active after 0.0 s"


def test_new_problem_in_the_same_state_is_a_warning(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    rig.poll()
    for count in (10, 20):
        rig.update_bus(None, queue_full=count)
        rig.poll()
    ((level, text),) = rig.bus_lines(caplog)
    assert level == logging.WARNING
    assert text.startswith("bus can0: active: transmit queue full, 10 frames not sent")
    rig.now_ns += 10 * SECOND_NS
    rig.update_bus(None, queue_full=20)
    rig.poll()
    assert rig.bus_lines(caplog)[1:] == [(logging.INFO, "bus can0: active")]


def test_rejected_adaptation_is_logged_once_for_each_pad(
    bench: Any, caplog: pytest.LogCaptureFixture
) -> None:
    sheet = bench.deployment.sheets["s"].model_copy(update={"behaviour": Behaviour()})
    deployment = bench.deployment.model_copy(update={"sheets": {"s": sheet}})
    rig = Rig(replace(bench, deployment=deployment, model=type(bench.model)(deployment)))
    caplog.set_level(logging.INFO, "handtouch.health")
    learned = Pads([False, False]).bank.learned[0]
    for pad in (0, 1):
        rig.pipeline.tick.sheet_force.set_back_force(pad, 0.0, 0.1, learned.tolist())
    for _ in range(3):
        rig.poll()
    lines = [r.getMessage() for r in caplog.records if "adaptation" in r.getMessage()]
    assert len(lines) == 3  # the third pad has a sheet of the same material
    assert sum(line.startswith("h/round: adaptation of its sheet is not compensated") for line in lines) == 1
