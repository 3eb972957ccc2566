"""Status columns of the hand frame agree with the statuses of contact messages."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from handtouch import columns, wire
from handtouch.core.pipeline import Pipeline
from handtouch.wire import ForceStatus, PadState, PositionStatus

PERIOD_NS = 5_000_000
PLANE, ROUND, RESISTED = range(3)


class _Recorder:
    """Subscribes to everything and keeps the messages."""

    def __init__(self) -> None:
        self.messages: list[Any] = []

    def has_subscriber(self, topic: str) -> bool:  # noqa: ARG002
        return True

    def send(self, message: wire.OutgoingMessage) -> None:
        self.messages.append(wire.decode(wire.encode(message)))


class _Driver:
    """A pipeline whose three pads are touched, or not."""

    def __init__(self, bench: Any) -> None:
        self.sent = _Recorder()
        self.pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, self.sent)
        self.pipeline.node_state[:] = PadState.CLEAR
        self._bench = bench
        self.touched = [self.counts(pad, 1e-3) for pad in range(3)]
        self.sync_ns = 10**9
        for _ in range(30):  # until the baselines are known
            self.run_cycle()

    def counts(self, pad: int, current_a: float) -> bytes:
        """Return the sample of a contact with a total current."""
        data: bytes = self._bench.counts(pad, 0.4, 0.6, current_a).tobytes()
        return data

    def run_cycle(self, *pads: int) -> tuple[wire.HandFrame, dict[str, wire.Contact]]:
        """Run a cycle with contacts on these pads; return the hand frame, and the contacts by link."""
        self.sent.messages.clear()
        self.sync_ns += PERIOD_NS
        self.pipeline.begin_cycle(self.sync_ns, self.sync_ns)
        for pad, data in enumerate(self.touched):
            sample = data if pad in pads else bytes(len(data))
            self.pipeline.slab.write_pdo(pad, sample, self.sync_ns + 1000)
        self.pipeline.tick_if_due(self.sync_ns + PERIOD_NS - 1)
        (frame,) = (m for m in self.sent.messages if isinstance(m, wire.HandFrame))
        contacts = {m.link: m for m in self.sent.messages if isinstance(m, wire.Contact) and m.event != "end"}
        return frame, contacts


def _nothing(driver: _Driver) -> None:
    del driver


def _unreliable_position(driver: _Driver) -> None:
    calibration = driver.pipeline.calibrations[ROUND]
    driver.pipeline.set_calibration(ROUND, replace(calibration, position_unreliable=True))


def _saturated(driver: _Driver) -> None:
    driver.touched[RESISTED] = driver.counts(RESISTED, 9.4e-3)


def _unknown_baseline(driver: _Driver) -> None:
    driver.pipeline.tick.baseline.known[PLANE] = False


def _position_only(driver: _Driver) -> None:
    every = np.ones(3, np.bool_)
    driver.pipeline.tick.set_requested(every, np.arange(3) != ROUND, np.ones(3, np.int64))


@pytest.mark.parametrize(
    ("change", "link", "position", "force"),
    [
        (_nothing, "plane", PositionStatus.VALID, ForceStatus.VALID),
        (_unreliable_position, "round", PositionStatus.UNRELIABLE, ForceStatus.VALID),
        (_saturated, "resisted", PositionStatus.VALID, ForceStatus.LOWER_BOUND),
        (_unknown_baseline, "plane", PositionStatus.VALID, ForceStatus.UNRELIABLE),
        (_position_only, "round", PositionStatus.VALID, ForceStatus.NOT_COMPUTED),
    ],
)
def test_codes_in_the_hand_frame_are_the_statuses_of_the_contacts(
    bench: Any,
    request: pytest.FixtureRequest,
    change: Any,
    link: str,
    position: PositionStatus,
    force: ForceStatus,
) -> None:
    driver = _Driver(bench)
    for _ in range(4):
        driver.run_cycle(PLANE, ROUND, RESISTED)
    request.addfinalizer(partial(bench.model.set_calibration, ROUND, bench.model.calibrations[ROUND]))
    change(driver)
    frame, contacts = driver.run_cycle(PLANE, ROUND, RESISTED)
    values = columns(frame)
    row = frame.links.index(link)
    assert (values["position_status"][row], values["force_status"][row]) == (position, force)
    for row, name in enumerate(frame.links):
        assert PositionStatus(values["position_status"][row]).text == contacts[name].position_status
        assert ForceStatus(values["force_status"][row]).text == contacts[name].force_status


def test_a_pad_without_a_contact_has_no_status(bench: Any) -> None:
    driver = _Driver(bench)
    for _ in range(4):
        driver.run_cycle(PLANE)
    frame, contacts = driver.run_cycle(PLANE)
    assert list(contacts) == ["plane"]
    values = columns(frame)
    assert values["position_status"].tolist() == [PositionStatus.VALID, 0, 0]
    assert values["force_status"].tolist() == [ForceStatus.VALID, 0, 0]
    for _ in range(4):
        frame, _ = driver.run_cycle()
    assert not any(np.count_nonzero(columns(frame)[name]) for name in ("position_status", "force_status"))


def test_the_force_is_unreliable_from_begin_to_end_of_a_contact_older_than_the_baseline(bench: Any) -> None:
    """A pad touched since the start: its zero was never measured."""
    driver = _Driver(bench)
    driver.pipeline.tick.reset_pad(PLANE)  # its node was replaced
    statuses = []
    for number in range(60):
        driver.run_cycle(*[PLANE] * (number < 50))
        statuses += [m.force_status for m in driver.sent.messages if isinstance(m, wire.Contact)]
    assert len(statuses) > 49
    assert set(statuses) == {"unreliable"}


def test_on_a_pad_whose_contacts_never_fit_one_that_does_is_unreliable_until_others_fit(bench: Any) -> None:
    """As with a dead channel, whose contacts near a corner look like those of another place."""
    driver = _Driver(bench)
    right = driver.touched[PLANE]
    odd = np.frombuffer(right, "<i2").copy()
    odd[1] = 0

    def press(sample: bytes) -> wire.Contact:
        driver.touched[PLANE] = sample
        for _ in range(30):
            driver.run_cycle()
        return [driver.run_cycle(PLANE)[1] for _ in range(6)][-1]["plane"]

    assert press(right).position_status == "valid"
    for _ in range(12):
        assert press(odd.tobytes()).position_status == "unreliable"
    fits = press(right)
    assert (fits.position_status, fits.force_status) == ("unreliable", "unreliable")
    statuses = [press(right).position_status for _ in range(8)]
    assert statuses[-1] == "valid"
