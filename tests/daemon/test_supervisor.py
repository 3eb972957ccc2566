"""The daemon's side of supervision: messages are applied whole or not at all, without blocking."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.calibration.calibration import CalibrationState, LawParameters
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.spec import NodeEvent, SerialChanged
from handtouch.config import Behaviour
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.block_buffer import BlockBuffer
from handtouch.daemon.supervisor_client import SupervisorClient
from handtouch.supervisor.ipc import (
    CalibrationAssessment,
    CalibrationUpdate,
    ManualCalibration,
    SampleBlock,
    WorkerMessage,
    WorkerStatus,
    pack_message,
    unpack_daemon_message,
)
from handtouch.wire import PadState
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis

PERIOD_NS = 5_000_000
SECOND_NS = 1_000_000_000
GUM = Diagnosis(kind=FaultKind.GUM, cause="chewing gum", evidence="60 s", remedy="wipe it", since_ns=1)


class FakeProcess:
    """A stand-in for the process, with messages from the test."""

    def __init__(self) -> None:
        self.waiting: list[bytes] = []
        self.sent: list[bytes] = []
        self.pid, self.state, self.restarts, self.dropped, self.exit_reason = 1, "running", 0, 0, ""

    def poll(self, now_ns: int) -> bool:  # noqa: ARG002
        return False

    def restart(self, now_ns: int) -> None:  # noqa: ARG002
        """Count the restart."""
        self.restarts += 1

    def send(self, message: bytes) -> bool:
        self.sent.append(message)
        return True

    def receive(self, now_ns: int) -> list[bytes]:  # noqa: ARG002
        received, self.waiting = self.waiting, []
        return received


class Nodes:
    """A master with given serial numbers."""

    def __init__(self, serials: list[int | None]) -> None:
        self.serials = serials
        self.states = [NodeState.OPERATIONAL] * len(serials)

    def status(self) -> list[Any]:
        return [
            type("Status", (), {"serial": serial, "state": state})
            for serial, state in zip(self.serials, self.states, strict=True)
        ]


class LastMessages:
    """Keeps the last message of each topic."""

    def __init__(self) -> None:
        self.last: dict[str, Any] = {}

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith(("contact/", "hand/"))

    def send(self, message: Any) -> None:
        sent = wire.decode(wire.encode(message))
        self.last[wire.topic_of(sent)] = sent


class Rig:
    def __init__(self, bench: Any) -> None:
        self.published = LastMessages()
        self.pipeline = Pipeline(type(bench.model)(bench.deployment), PERIOD_NS, 0.6, self.published)
        self.pipeline.node_state[:] = PadState.CLEAR
        self.nodes, self.process = Nodes([11, 12, 13]), FakeProcess()
        make: Any = SupervisorClient  # nodes and process are stand-ins
        self.switched_ns: list[int] = []
        """times when the excitation of pads was switched"""
        self.supervisor: SupervisorClient = make(
            bench.deployment, self.pipeline, self.nodes, "", self.process,
            on_excitation_changed=self.switched_ns.append,
        )  # fmt: skip
        self.t_ns = SECOND_NS
        self.touched = False
        """True while the first pad is touched"""
        self._counts = bench.counts(0, 0.4, 0.6, 1e-3).astype("<i2").tobytes()
        self.swap(0, None, 11)  # the first known node

    def swap(self, pad: int, before: int | None, after: int | None) -> None:
        self.nodes.serials[pad] = after
        self.supervisor.handle_node_events([SerialChanged(pad, self.t_ns, before, after)], self.t_ns)

    def receive(self, *messages: WorkerMessage | bytes) -> None:
        """Deliver messages to the supervisor client."""
        self.process.waiting = [
            message if isinstance(message, bytes) else pack_message(message) for message in messages
        ]
        while self.process.waiting:
            self.step()
        for _ in range(10):
            self.step()

    def step(self) -> None:
        self.t_ns += PERIOD_NS
        self.pipeline.begin_cycle(self.t_ns, self.t_ns)
        for pad in range(3):
            counts = self._counts if self.touched and pad == 0 else b"\0" * 8
            self.pipeline.slab.write_pdo(pad, counts, self.t_ns + 1000)
        self.pipeline.tick_if_due(self.t_ns + PERIOD_NS)
        self.supervisor.process_tick(self.t_ns)

    def contact(self) -> Any:
        return self.published.last["contact/h/plane"]

    def frame(self) -> Any:
        return self.published.last["hand/h"]


@pytest.fixture
def rig(bench: Any) -> Rig:
    return Rig(bench)


def test_block_of_a_late_tick_leaves_out_samples_of_the_next_cycle(rig: Rig) -> None:
    pipeline, sync_ns = rig.pipeline, rig.t_ns + PERIOD_NS
    pipeline.begin_cycle(sync_ns, sync_ns)
    for pad, delay_ns in enumerate((1000, 2000, PERIOD_NS + 1000)):
        pipeline.slab.write_pdo(pad, b"\0" * 8, sync_ns + delay_ns)
    assert pipeline.finish_cycle(sync_ns + PERIOD_NS, sync_ns + PERIOD_NS + 2000) is not None
    buffer = BlockBuffer(3, 4)
    buffer.max_ticks = 1
    block = buffer.add_tick(pipeline)
    assert block is not None
    assert (block.sync_ns.tolist(), block.fresh.tolist()) == ([sync_ns], [[True, True, False]])


def calibrate(pad: int, serial: int, **changes: Any) -> CalibrationUpdate:
    gains = {"gains": (1.1, 1.0, 1.0, 0.9), "covariance": tuple((1e-4 * np.eye(4)).ravel().tolist())}
    return CalibrationUpdate(
        **{"pad": pad, "serial": serial, "calibration_id": f"{serial}-1", **gains, **changes}
    )


def test_calibration_is_applied_whole(rig: Rig) -> None:
    rig.receive(calibrate(1, 12, offset_counts=(3.0, 4.0, 5.0, 6.0), offset_std=(0.5,) * 4))
    model = rig.pipeline.model
    assert model.gains[1].tolist() == [1.1, 1.0, 1.0, 0.9]
    assert model.calibrations[1].calibration_id == "12-1"
    assert np.diag(model.gain_covariance[1]).tolist() == [1e-4] * 4
    assert rig.pipeline.tick.baseline.expected_counts[1].tolist() == [3.0, 4.0, 5.0, 6.0]
    assert rig.supervisor.changed_pads >= {1}


def test_manual_calibration_is_sent_until_a_better_one_is_estimated(rig: Rig) -> None:
    def sent() -> list[ManualCalibration]:
        messages = map(unpack_daemon_message, rig.process.sent)
        return [message for message in messages if isinstance(message, ManualCalibration)]

    rig.pipeline.set_calibration(1, ActiveCalibration("bench-1", (1.1, 1.0, 1.0, 0.9)))
    rig.supervisor.register_manual_calibration(1, {"gains"})
    assert sent()[-1].given == ("gains",)
    update = sent()[-1].update
    assert (update.serial, update.calibration_id, update.gains) == (12, "bench-1", (1.1, 1.0, 1.0, 0.9))
    rig.step()
    assert np.diag(rig.pipeline.model.gain_covariance[1]) == pytest.approx([0.01**2 * 0.75] * 4)
    rig.swap(0, 11, 11)  # as after a restart of the process, which applies stored calibrations first
    rig.receive(calibrate(1, 12), update)
    assert (len(sent()), rig.pipeline.model.calibrations[1].calibration_id) == (2, "bench-1")
    rig.receive(calibrate(1, 12))  # estimated from contacts
    rig.swap(0, 11, 11)
    assert len(sent()) == 2


@pytest.mark.parametrize(
    ("message", "counter"),
    [
        (b"\xc1 malformed", "malformed"),
        (calibrate(3, 13), "malformed"),  # no such pad
        (calibrate(1, 12, offset_counts=(2e4, 0.0, 0.0, 0.0)), "malformed"),  # beyond half the range
        (calibrate(1, 12, gains=(1.1,) * 6, covariance=None), "malformed"),  # of another number of channels
        (
            CalibrationAssessment(
                pad=1, serial=12, calibration_state=CalibrationState.DEFAULT, dead_electrode=4
            ),
            "malformed",
        ),
        (calibrate(1, 99), "late"),  # of another node
        (CalibrationAssessment(pad=1, serial=99, calibration_state=CalibrationState.CALIBRATED), "late"),
    ],
)
def test_invalid_message_is_counted_and_changes_nothing(
    rig: Rig, message: WorkerMessage | bytes, counter: str
) -> None:
    rig.receive(message)
    assert rig.supervisor.statistics()[counter] == 1
    assert (rig.pipeline.model.gains == 1).all()
    model = rig.pipeline.model
    assert [c.calibration_id for c in model.calibrations] == model.default_calibration_ids


def test_replaced_node_is_quarantined_at_once(rig: Rig) -> None:
    rig.receive(calibrate(0, 11))
    rig.swap(0, 11, 21)
    rig.step()
    model = rig.pipeline.model
    assert model.quarantined.tolist() == [True, False, False]
    assert model.gains[0].tolist() == [1.0] * 4
    assert model.calibrations[0].calibration_id == model.default_calibration_ids[0]
    assert rig.supervisor.health_fields(0)["calibration_state"] == "quarantined"
    rig.receive(calibrate(0, 11))  # about the previous node
    assert rig.supervisor.late == 1
    assert model.gains[0].tolist() == [1.0] * 4
    rig.receive(
        calibrate(0, 21),
        CalibrationAssessment(pad=0, serial=21, calibration_state=CalibrationState.CALIBRATED),
    )
    assert model.quarantined.tolist() == [False] * 3
    assert rig.supervisor.health_fields(0) == {
        "calibration_state": "calibrated", "calibration_id": "21-1",
        "calibration_progress": "", "diagnoses": (), "least_begin_threshold_n": None,
    }  # fmt: skip


def test_refused_node_replaces_none_whatever_happens_to_others(rig: Rig) -> None:
    rig.nodes.serials[0], rig.nodes.states[0] = 21, NodeState.FAULTED
    event = NodeEvent(1, rig.t_ns, NodeState.CONFIGURING, NodeState.OPERATIONAL, "")
    rig.supervisor.handle_node_events([event], rig.t_ns)
    rig.step()
    assert not rig.pipeline.model.quarantined.any()
    assert rig.supervisor.health_fields(0)["calibration_state"] == "default"


def test_node_without_serial_number_counts_as_replaced(rig: Rig) -> None:
    rig.swap(0, 11, None)
    rig.step()
    assert rig.pipeline.model.quarantined[0]


def test_diagnosis_is_published_and_logged_and_its_end_too(rig: Rig, caplog: Any) -> None:
    caplog.set_level("INFO", "handtouch.supervisor")
    rig.receive(
        CalibrationAssessment(pad=2, serial=13, calibration_state=CalibrationState.DEFAULT, diagnoses=(GUM,))
    )
    assert rig.supervisor.health_fields(2)["diagnoses"][0]["remedy"] == "wipe it"
    assert "chewing gum (60 s); wipe it" in caplog.text
    rig.receive(CalibrationAssessment(pad=2, serial=13, calibration_state=CalibrationState.DEFAULT))
    assert rig.supervisor.health_fields(2)["diagnoses"] == ()
    assert "gum: cleared" in caplog.text


def test_a_dead_electrode_is_left_out_until_the_node_is_replaced(rig: Rig) -> None:
    whole = rig.pipeline.model.forward_tables[2]
    state = CalibrationState.DEFAULT
    rig.receive(CalibrationAssessment(pad=2, serial=13, calibration_state=state, dead_electrode=1))
    assert not rig.pipeline.model.forward_tables[2].search_fractions[:, 1].any()
    rig.swap(2, 13, 14)
    rig.step()
    rig.step()
    assert rig.pipeline.model.forward_tables[2] is whole


def test_fault_invalidates_force_and_position_until_it_ends(rig: Rig) -> None:
    rig.receive(calibrate(2, 13))
    before = rig.pipeline.model.gain_covariance[2].copy()
    broken = replace(GUM, position_valid=False, force_valid=False)
    rig.receive(
        CalibrationAssessment(
            pad=2, serial=13, calibration_state=CalibrationState.CALIBRATED, diagnoses=(broken,)
        )
    )
    assert rig.pipeline.model.quarantined[2]
    assert rig.pipeline.model.gain_covariance[2].max() > 100 * before.max()
    rig.receive(CalibrationAssessment(pad=2, serial=13, calibration_state=CalibrationState.CALIBRATED))
    assert not rig.pipeline.model.quarantined[2]
    assert (rig.pipeline.model.gain_covariance[2] == before).all()


def test_contacts_carry_the_effects_of_diagnoses_while_they_last(rig: Rig) -> None:
    rig.receive(
        calibrate(0, 11, gains=(1.0,) * 4),
        CalibrationAssessment(pad=0, serial=11, calibration_state=CalibrationState.CALIBRATED),
    )
    rig.touched = True
    rig.receive(
        CalibrationAssessment(
            pad=0, serial=11, calibration_state=CalibrationState.CALIBRATED, diagnoses=(GUM,)
        )
    )
    assert rig.contact().position_status == rig.contact().force_status == "valid"
    assert (rig.contact().diagnoses, rig.frame().position_status[0]) == ((), wire.PositionStatus.VALID)
    torn = replace(GUM, kind=FaultKind.TORN_CORNER, position_valid=False, force_valid=False)
    rig.receive(
        CalibrationAssessment(
            pad=0, serial=11, calibration_state=CalibrationState.CALIBRATED, diagnoses=(GUM, torn)
        )
    )
    contact = rig.contact()
    assert (contact.position_status, contact.force_status, contact.force_n) == ("unreliable", "invalid", None)
    assert contact.position_m is not None
    assert contact.diagnoses == ("torn_corner",)
    assert rig.frame().position_status == bytes([wire.PositionStatus.UNRELIABLE, 0, 0])
    rig.receive(CalibrationAssessment(pad=0, serial=11, calibration_state=CalibrationState.CALIBRATED))
    contact = rig.contact()
    assert (contact.position_status, contact.force_status, contact.diagnoses) == ("valid", "valid", ())
    rig.swap(0, 11, 21)
    rig.receive()
    rig.step()
    contact = rig.contact()
    assert (contact.position_status, contact.force_status, contact.diagnoses) == (
        "valid",
        "invalid",
        ("node_replaced",),
    )


def test_excitation_of_a_fading_sheet_is_off_until_the_hand_is_touched(bench: Any, caplog: Any) -> None:
    caplog.set_level("INFO", "handtouch.supervisor")
    sheet = bench.deployment.sheets["s"].model_copy(update={"behaviour": Behaviour()})
    scene = bench.deployment.scene.model_copy(update={"excitation_off_after_s": 1.0})
    fading = bench.deployment.model_copy(update={"sheets": {"s": sheet}, "scene": scene})
    rig = Rig(replace(bench, deployment=fading))
    rig.pipeline.tick.sheet_force.set_back_force(1, 2.0, 0.1)
    for _ in range(450):
        rig.step()
    assert rig.supervisor.excitation.off.tolist() == [False, True, False]
    (diagnosis,) = rig.supervisor.health_fields(1)["diagnoses"]
    assert diagnosis["kind"] == "sheet_adapted"
    assert "2.00 N" in diagnosis["evidence"]
    assert "touch another pad" in diagnosis["remedy"]
    assert 1 in rig.supervisor.changed_pads
    assert "h/round: excitation off" in caplog.text
    rig.touched = True
    rig.receive()
    rig.step()
    assert not rig.supervisor.excitation.off.any()
    assert rig.supervisor.health_fields(1)["diagnoses"] == ()
    assert "h/round: excitation on again" in caplog.text
    assert len(rig.switched_ns) == 2


def test_state_of_the_process_is_published(rig: Rig) -> None:
    rig.receive(
        WorkerStatus(
            processed_ns=rig.t_ns - SECOND_NS, summary="3 nominal", store_error="the store is damaged"
        )
    )
    statistics = rig.supervisor.statistics()
    assert statistics["summary"] == "3 nominal"
    assert statistics["store_error"] == "the store is damaged"
    assert statistics["lag_s"] >= 1.0


def modelled(bench: Any) -> Rig:
    """Return a rig whose sheets have a modelled behaviour."""
    sheet = bench.deployment.sheets["s"].model_copy(update={"behaviour": Behaviour()})
    return Rig(replace(bench, deployment=bench.deployment.model_copy(update={"sheets": {"s": sheet}})))


def test_learned_behaviour_of_a_sheet_is_restored_and_sent_until_its_node_is_replaced(bench: Any) -> None:
    rig = modelled(bench)
    fresh = rig.pipeline.tick.sheet_force.learned_of(0)
    learned = fresh.copy()
    learned[1:5] = -3.0
    rig.receive(
        CalibrationUpdate(
            pad=0, serial=11, calibration_id="11-2", gains=(1, 1, 1, 1), back_n=0.2, learned=tuple(learned)
        )
    )
    rig.step()
    np.testing.assert_array_equal(rig.pipeline.tick.sheet_force.learned_of(0), learned)
    rig.process.sent.clear()
    for _ in range(80):
        rig.step()
    blocks = [m for m in map(unpack_daemon_message, rig.process.sent) if isinstance(m, SampleBlock)]
    assert {int(block.learned_pad) for block in blocks} == {0, 1, 2}
    (sent,) = {block.learned.tobytes() for block in blocks if block.learned_pad == 0}
    assert sent == learned.tobytes()
    rig.swap(0, 11, 21)
    rig.step()
    np.testing.assert_array_equal(rig.pipeline.tick.sheet_force.learned_of(0), fresh)


def test_a_new_sheet_on_the_same_node_sets_aside_what_the_old_one_taught(bench: Any) -> None:
    """Law, behaviour and parts; the gains are of the node and stay."""
    rig = modelled(bench)
    fresh = rig.pipeline.tick.sheet_force.learned_of(0)
    learned, deployed = fresh.copy(), rig.pipeline.calibrations[0].law
    learned[1:5] = -3.0
    law = LawParameters(
        contact_ohm_mm2=21_000.0, alpha=1.2, ohm_per_square=2000.0, covariance=((0.0,) * 3,) * 3
    )
    rig.receive(calibrate(0, 11, back_n=0.2, learned=tuple(learned), law=law))
    rig.step()
    assert rig.pipeline.calibrations[0].law != deployed
    rig.receive(calibrate(0, 11, calibration_id="11-2", new_sheet=True))
    rig.step()
    after = rig.pipeline.calibrations[0]
    assert (after.calibration_id, after.law, after.parts) == ("11-2", deployed, None)
    assert after.gains == (1.1, 1.0, 1.0, 0.9)
    np.testing.assert_array_equal(rig.pipeline.tick.sheet_force.learned_of(0), fresh)
    rig.receive(calibrate(0, 11, calibration_id="11-3", law=law))  # the new one's, measured
    rig.step()
    measured = rig.pipeline.calibrations[0].law
    assert measured is not None
    assert measured.contact_ohm_mm2 == 21_000.0


def test_learned_behaviour_that_no_sheet_has_is_refused(bench: Any) -> None:
    rig = modelled(bench)
    before = rig.pipeline.tick.sheet_force.learned_of(0)
    update = CalibrationUpdate(pad=0, serial=11, calibration_id="11-2", gains=(1, 1, 1, 1), back_n=0.2)
    rig.receive(pack_message(update).replace(b'"learned":[]', b'"learned":[1,2,3]'))
    assert rig.supervisor.malformed == 1
    np.testing.assert_array_equal(rig.pipeline.tick.sheet_force.learned_of(0), before)


def test_reloaded_supervisor_has_the_new_file(rig: Rig, bench: Any) -> None:
    node = bench.deployment.nodes["n"].model_copy(update={"full_scale_ma": 30.0})
    changed = bench.deployment.model_copy(update={"nodes": {"n": node}})
    rig.supervisor.restart_with(changed, rig.t_ns)
    assert rig.process.restarts == 1
    assert rig.supervisor.deployment.nodes == changed.nodes
