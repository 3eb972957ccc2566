"""Contact messages of any computed numbers: readable, as the codec encodes them, nil where not finite."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.pipeline import Pipeline
from handtouch.core.stages.publish import ContactEncoder
from handtouch.core.stages.rows import VALUE_SLICES
from handtouch.core.state import TickState
from handtouch.wire import ForceStatus, FrameStatus, PositionStatus
from handtouch.wire.status import MAX_SILENT_PERIODS

ODD = np.array([np.nan, np.inf, -np.inf, 0.0, 1e30, -1e-30, 1.0])
INTEGERS = np.array([0, 1, 0x7F, 0x80, 0xFF, 0x100, 0xFFFF, 0x10000, 0xFFFFFFFF, 1 << 32, 1 << 62])
PARTS = {"position_m": 3, "normal": 3, "covariance_m2": 9}
FRAMES = {"palm": 0, "base": 15}


class DiscardingSink:
    def has_subscriber(self, topic: str) -> bool:  # noqa: ARG002
        return False

    def send(self, message: Any) -> None:
        """Discard the message."""


def fill_state(state: TickState, rng: np.random.Generator) -> None:
    """Write odd numbers into a state."""
    for column in (
        *(state.values, state.peak_force_n, state.total_current_a, state.uncompensated_force_n),
        *(state.palm_values, state.force_vector, state.frame_force_vector),
    ):
        column[:] = rng.choice(ODD, column.shape) if rng.random() < 0.3 else rng.normal(size=column.shape)
    parts = state.parts.reshape(state.pads, 2, -1)
    parts[:] = rng.normal(size=parts.shape) if rng.random() < 0.5 else np.nan
    parts[:, :, 15:17] = rng.choice(ODD, (state.pads, 2, 2))
    parts[:, :, 17] = rng.integers(1, 1 << 40, (state.pads, 2))
    state.total_current_a[:] = rng.normal(size=state.pads)  # of finite counts
    for integers in (state.contact_seq, state.sample_ns, state.begin_ns, state.silent_ns):
        integers[:] = rng.choice(INTEGERS, state.pads)
    state.contact_id[:], state.group_id[:] = rng.choice(INTEGERS[1:9], (2, state.pads))
    state.solved[:], state.known[:] = True, True
    for truths in (state.palm_requested, state.base_requested, state.synchronous):
        truths[:] = rng.random(state.pads) < 0.5
    state.force_vector_status[:] = rng.integers(len(ForceStatus), size=state.pads)
    state.palm_status[:], state.base_status[:] = rng.integers(len(FrameStatus), size=(2, state.pads))


def finite(values: Any) -> Any:
    """Return numbers as messages have them: nil unless all are finite."""
    numbers = np.atleast_1d(values).tolist()
    if not all(map(math.isfinite, numbers)):
        return None
    return tuple(numbers) if np.ndim(values) else numbers[0]


@pytest.mark.parametrize("event", ["begin", "update", "end"])
def test_a_contact_message_has_the_values_of_its_columns(bench: Any, event: wire.ContactEvent) -> None:
    pipeline = Pipeline(copy.deepcopy(bench.model), 5_000_000, 0.6, DiscardingSink())
    rng, state, columns, pad = np.random.default_rng(1), pipeline.state, pipeline.tick.columns, 1
    pipeline.model.set_calibration(pad, ActiveCalibration("default"))
    tick = pipeline.tick
    encoder = ContactEncoder(
        pipeline.model, tick.state, tick.columns, tick.sheet_force.modelled, session=1 << 52
    )
    for number in range(300):
        if number == 200:
            pipeline.model.set_calibration(
                pad, ActiveCalibration("c" * 300, diagnoses=("drift", "gain_step"))
            )
        fill_state(state, rng)
        pipeline.tick.refresh()
        retained, now_ns = bool(rng.random() < 0.5), int(state.sample_ns[pad]) + 1234
        sent = encoder.encode(pad, event, 10**9, now_ns, "stale" if event == "end" else "", retained)
        contact = wire.decode(wire.encode(sent))
        assert isinstance(contact, wire.Contact)
        assert wire.encode(contact)[1] == sent.payload
        t_ns = 10**9 if event == "end" else int(state.sample_ns[pad])
        begin_ns = int(state.begin_ns[pad])
        assert (contact.t_ns, contact.begin_ns, contact.seq) == (t_ns, begin_ns, state.contact_seq[pad])
        assert (contact.duration_s, contact.age_s) == ((t_ns - begin_ns) * 1e-9, 1234 * 1e-9)
        assert (contact.event, contact.retained, contact.id) == (event, retained, state.contact_id[pad])
        located = all(finite(getattr(columns, name)[pad]) for name in ("position_m", "normal", "pad_m"))
        mount = columns.values[pad, VALUE_SLICES["mount_covariance_m2"]]
        added = mount if np.isfinite(mount).all() else 0.0 * INTEGERS[:9]
        expected = [
            finite(getattr(columns, name)[pad].reshape(-1) + (added if name == "covariance_m2" else 0.0))
            for name in PARTS
        ]
        assert contact.mount_covariance_m2 == (finite(mount) if located else None)
        assert [getattr(contact, name) for name in PARTS] == (expected if located else [None] * 3)
        assert contact.pad_m == (finite(columns.pad_m[pad]) if located else None)
        has_std = columns.force_status[pad] in (ForceStatus.VALID, ForceStatus.UNRELIABLE)
        assert contact.force_std_n == (finite(columns.force_std_n[pad]) if has_std else None)
        for name in ("force_n", "residual", "residual_std", "total_current_a"):
            assert getattr(contact, name) == finite(getattr(columns, name)[pad])
        assert contact.peak_force_n == finite(state.peak_force_n[pad])
        assert contact.uncompensated_force_n is None  # nothing is compensated
        assert contact.position_status == PositionStatus(columns.position_status[pad]).text
        assert contact.force_status == ForceStatus(columns.force_status[pad]).text
        limit_ns = 0 if state.synchronous[pad] else MAX_SILENT_PERIODS * state.max_sample_period_ns[pad]
        assert contact.fresh == (state.silent_ns[pad] <= limit_ns)
        requested = bool(state.palm_requested[pad] or state.base_requested[pad])
        assert contact.group == (state.group_id[pad] if requested else 0)
        assert contact.joints_age_s == (finite(state.palm_values[pad, 30]) if requested else None)
        for frame, at in FRAMES.items():
            status = FrameStatus(getattr(state, f"{frame}_status")[pad] if requested else 0)
            assert getattr(contact, f"{frame}_status") == status.text
            for name, width in PARTS.items():
                values = finite(state.palm_values[pad, at : at + width])
                assert getattr(contact, f"{frame}_{name}") == (
                    values if status == FrameStatus.VALID else None
                )
                at += width
        vectors = {
            "force_vector_n": state.force_vector[pad, :3],
            "force_vector_covariance_n2": state.force_vector[pad, 3:],
            "palm_force_vector_n": state.frame_force_vector[pad, :3],
            "base_force_vector_n": state.frame_force_vector[pad, 3:],
        }
        vector_status = ForceStatus(state.force_vector_status[pad])
        assert contact.force_vector_status == vector_status.text
        for name, column in vectors.items():
            present = vector_status != ForceStatus.NOT_COMPUTED
            assert getattr(contact, name) == (finite(column) if present else None)
        rows = state.parts[pad].reshape(2, -1) if np.isfinite(state.parts[pad, 0]) else ()
        assert [tuple(part.values()) for part in contact.parts] == [
            (
                row[:3].tolist(),
                row[3:6].tolist(),
                (row[6:15] + added).tolist(),
                finite(row[15]),
                finite(row[16]),
                int(row[17]),
            )
            for row in rows
        ]
        later = number >= 200
        assert (len(contact.calibration_id), len(contact.diagnoses)) == ((300, 2) if later else (7, 0))
        assert contact.end_reason == ("stale" if event == "end" else "")
