"""Sample buffers: complete, in order, of one contact only."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.percept.estimator import FitSchedule
from handtouch.percept.samples import SAMPLES_PER_CONTACT, ContactBuffer, ContactSamples


def sample(pads: list[int], t_ns: int, contact: int, force_n: float) -> ContactSamples:
    made = ContactSamples(np.array(pads), np.full(len(pads), t_ns), np.full(len(pads), contact, np.uint32))
    made["force_n"] = np.full(len(pads), force_n)
    made["pad_m"] = np.full((len(pads), 2), force_n * 1e-3)
    return made


@pytest.mark.parametrize(
    "count",
    [1, SAMPLES_PER_CONTACT - 1, SAMPLES_PER_CONTACT, SAMPLES_PER_CONTACT + 1, 3 * SAMPLES_PER_CONTACT + 7],
)
def test_window_holds_the_last_samples_in_order(count: int) -> None:
    stream = ContactBuffer(3)
    for k in range(count):
        stream.add_samples(sample([1, 2], 5 * k, 7, float(k)))
    expected = np.arange(max(0, count - SAMPLES_PER_CONTACT), count)
    assert stream.window(2, "force_n").tolist() == expected.tolist()
    assert np.allclose(stream.window(2, "pad_m")[:, 1], 1e-3 * expected)
    assert stream.window(2, "force_n", 4).tolist() == expected[-4:].tolist()
    assert len(stream.window(0, "force_n")) == 0


def test_new_contact_starts_with_an_empty_window() -> None:
    stream = ContactBuffer(2)
    for k in range(10):
        stream.add_samples(sample([0], k, 1, 1.0))
    stream.add_samples(sample([0], 10, 2, 5.0))
    assert stream.window(0, "force_n").tolist() == [5.0]
    assert stream.latest_field(np.array([0, 1]), "force_n").tolist()[0] == 5.0
    stream.end_contacts(np.array([0]))
    assert len(stream.window(0, "force_n")) == 0
    assert np.isnan(stream.latest_field(np.array([0]), "force_n")).all()


def test_unknown_fields_are_nan() -> None:
    stream = ContactBuffer(1)
    stream.add_samples(sample([0], 1, 1, 1.0))
    assert np.isnan(stream.window(0, "palm_position_m")).all()


def test_longest_waiting_pad_is_fitted_first_and_none_too_early() -> None:
    turns, ready = FitSchedule(3, 100), np.array([True, True, False])
    taken = []
    for t_ns in range(0, 200, 20):
        if (pad := turns.next_pad(ready, t_ns)) is not None:
            turns.mark_fitted(pad, t_ns)
            taken.append((t_ns, pad))
    assert taken == [(0, 0), (20, 1), (100, 0), (120, 1)]
