"""The ring of samples: whole, in order, one contact's only; questions worth their bits."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.percept.stream import LENGTH, Sample, Stream, Turns


def sample(pads: list[int], t_ns: int, contact: int, force_n: float) -> Sample:
    made = Sample(np.array(pads), np.full(len(pads), t_ns), np.full(len(pads), contact, np.uint32))
    made["force_n"] = np.full(len(pads), force_n)
    made["pad_m"] = np.full((len(pads), 2), force_n * 1e-3)
    return made


@pytest.mark.parametrize("count", [1, LENGTH - 1, LENGTH, LENGTH + 1, 3 * LENGTH + 7])
def test_a_window_holds_the_last_samples_in_order(count: int) -> None:
    stream = Stream(3)
    for k in range(count):
        stream.add(sample([1, 2], 5 * k, 7, float(k)))
    window = stream.window(2)
    expected = np.arange(max(0, count - LENGTH), count)
    assert window["force_n"].tolist() == expected.tolist()
    assert window.t_ns.tolist() == (5 * expected).tolist()
    assert np.allclose(window["pad_m"][:, 1], 1e-3 * expected)
    assert window.t_s[-1] == 0
    assert stream.window(2, 4)["force_n"].tolist() == expected[-4:].tolist()
    assert len(stream.window(0)) == 0


def test_a_new_contact_has_none_of_the_samples_before_it() -> None:
    stream = Stream(2)
    for k in range(10):
        stream.add(sample([0], k, 1, 1.0))
    assert stream.add(sample([0], 10, 2, 5.0)).tolist() == [0]
    assert stream.window(0)["force_n"].tolist() == [5.0]
    assert np.isnan(stream.latest(np.array([0]), "force_n", back=1)).all()
    stream.end(np.array([0]))
    assert len(stream.window(0)) == 0


def test_what_is_not_known_of_a_sample_is_nan() -> None:
    stream = Stream(1)
    stream.add(sample([0], 1, 1, 1.0))
    assert np.isnan(stream.window(0)["palm_position_m"]).all()


def test_the_pad_that_has_waited_longest_has_its_turn_and_none_too_soon() -> None:
    turns, ready = Turns(3, 100), np.array([True, True, False])
    taken = []
    for t_ns in range(0, 200, 20):
        if (pad := turns.due(ready, t_ns)) is not None:
            turns.took(pad, t_ns)
            taken.append((t_ns, pad))
    assert taken == [(0, 0), (20, 1), (100, 0), (120, 1)]
