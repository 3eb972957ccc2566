"""Messages between daemon and supervisor process round-trip; anything else is refused."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.calibration.calibration import CalibrationState
from handtouch.supervisor.ipc import (
    CalibrationAssessment,
    CalibrationUpdate,
    NodeSerials,
    SampleBlock,
    WorkerMessage,
    WorkerMessageError,
    WorkerStatus,
    pack_message,
    unpack_daemon_message,
    unpack_worker_message,
)
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis

from .conftest import Bench

DIAGNOSIS = Diagnosis(
    kind=FaultKind.GUM, cause="gum", evidence="40 s", remedy="wipe", since_ns=5, pad_m=(0.01, 0.02)
)
MESSAGES: list[WorkerMessage] = [
    WorkerStatus(processed_ns=7, summary="2 calibrated"),
    CalibrationUpdate(
        pad=1, serial=9, calibration_id="9-3", gains=(1, 1, 1, 1.1), covariance=(0.0,) * 16, back_n=0.4
    ),
    CalibrationAssessment(
        pad=0,
        serial=None,
        calibration_state=CalibrationState.MANUAL_REQUIRED,
        calibration_progress="no number",
        diagnoses=(DIAGNOSIS,),
    ),
]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.kind)
def test_message_round_trips(message: WorkerMessage) -> None:
    assert unpack_worker_message(pack_message(message)) == message


@given(st.binary(max_size=200))
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(WorkerMessageError):
        unpack_worker_message(data)


@given(
    st.sampled_from(MESSAGES),
    st.sampled_from(
        [
            "kind",
            "pad",
            "serial",
            "gains",
            "covariance",
            "calibration_state",
            "diagnoses",
            "processed_ns",
            "extra",
        ]
    ),
    st.none()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.lists(st.floats(), max_size=5)
    | st.text(),
)
def test_message_with_any_other_value_is_valid_or_refused(
    message: WorkerMessage, key: str, value: Any
) -> None:
    record = json.loads(pack_message(message))
    record[key] = value
    try:
        made = unpack_worker_message(json.dumps(record).encode())
    except WorkerMessageError:
        return
    assert getattr(made, key) is not None or value is None
    for gain in getattr(made, "gains", ()):
        assert 0.1 <= gain <= 10


def test_messages_of_the_daemon_round_trip(bench: Bench) -> None:
    serials = NodeSerials(now=(1, None), before=(None, 2), sync_ns=5)
    assert unpack_daemon_message(pack_message(serials)) == serials
    counts = np.arange(60.0).reshape(5, 3, 4)
    contact = np.arange(15, dtype=np.uint32).reshape(5, 3)
    block = unpack_daemon_message(bench.block(counts, contact, 100).dump())
    assert isinstance(block, SampleBlock)
    assert (block.counts == counts).all()
    assert (block.contact_id == contact).all()
    assert np.isnan(block.back_n).all()
