"""A daemon and a node that switches its electrodes: schedule by SYNC, one and two contacts, lost states."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import wire
from handtouch.canbus.bus.port import open_bus
from handtouch.cli.demo import in_process_deployment
from handtouch.config import Deployment, load, shipped
from handtouch.config.channels import resolve_channels
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.device import Device, DeviceBus
from handtouch.device.faults import LineFaults
from handtouch.field import ElectrodeNetwork
from handtouch.hand import pad_network
from handtouch.record.recording import Recording

from .conftest import run_in_threads
from .served_daemon import ServedDaemon

PRESS_SYNCS, REST_SYNCS = 30, 10


def switched_finger() -> Deployment:
    """Return the finger of the shipped file, in this process."""
    made = in_process_deployment(load(shipped.path("switched.toml")))
    settings = {"supervise": True, "sync_period_ms": 20.0, "store": "calibrations.db"}
    return made.model_copy(update={"daemon": made.daemon.model_copy(update=settings)})


class Finger:
    """Nodes of both pads; the tip is pressed at the places of `touches`, fractions of its rectangle."""

    def __init__(self, deployment: Deployment) -> None:
        self._pads = [entry.pad for entry in deployment.pads]
        tip = pad_network(self._pads[0], deployment.sheets["soft"])
        always = ElectrodeNetwork.from_arcs(tip.a, tip.b, tip.arcs, tip.sheet_ohm_per_square)
        self.a, self.b = tip.a, tip.b
        # each state by itself, not the sum of both that the daemon has
        self._states = [
            always.with_series_ohm([20.0 if k in state else math.inf for k in range(8)])
            for state in tip.states
        ]
        self.touches: list[tuple[float, float]] = []
        self._syncs, self._rng = 0, np.random.default_rng(1)
        self.bus = DeviceBus(open_bus(deployment.buses[0]), self._sample)
        self.devices: list[Device] = []
        for pad in self._pads:
            node = deployment.nodes[pad.node]
            channels = tuple((c.index, c.sub) for c in resolve_channels(node.channels, node.eds))
            self.devices.append(self.bus.add(pad.node_id, serial=pad.serial, channels=channels))
        wired = [self._pads[0].electrode_names.index(name) for name in self._pads[0].electrodes]
        self.devices[0].wiring = (*wired, *range(8, 16))

    def _sample(self, _sync_ns: int) -> NDArray[np.int64]:
        self._syncs += 1
        counts = self._rng.normal(size=(2, 8))
        if self._syncs % (PRESS_SYNCS + REST_SYNCS) < PRESS_SYNCS:
            for s, t in self.touches:
                counts[0] += 8000 * sum(one.fractions(s * self.a, t * self.b) for one in self._states)
        return np.rint(counts).astype(np.int64)


class Served(ServedDaemon):
    """The daemon with its nodes."""

    def __init__(self, daemon: HandtouchDaemon, finger: Finger) -> None:
        super().__init__(daemon)
        self.finger = finger

    def updates(self, count: int) -> list[wire.Contact]:
        """Wait for so many further updates."""
        first = len(self.contacts)

        def some() -> list[wire.Contact] | None:
            found = [one for one in list(self.contacts[first:]) if one.event == "update" and one.fresh]
            return found if len(found) >= count else None

        return list(self.wait("updated", some))


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    deployment = switched_finger()
    finger = Finger(deployment)
    with HandtouchDaemon.open(deployment, folder=tmp_path_factory.mktemp("switched")) as daemon:
        finger.bus.start()
        made = Served(daemon, finger)
        with run_in_threads(daemon.run, made.listen):
            yield made
        finger.bus.stop()


def off_mm(contact: wire.Contact, place: tuple[float, float]) -> float:
    assert contact.position_m is not None
    true = (np.array(place) - 0.5) * (24.0, 18.0)
    return float(np.hypot(*(1e3 * np.array(contact.position_m[:2]) - true)))


def test_the_node_sends_each_state_at_its_count_of_sync(served: Served) -> None:
    served.finger.touches = [(0.3, 0.35)]
    served.updates(5)
    node = served.finger.devices[0]
    assert node.read_object(0x1019, 0) == 2
    written = {(n, sub): node.read_object(0x1800 + n, sub) for n in (1, 2) for sub in (2, 6)}
    assert sorted(written[n, 6] for n in (1, 2)) == [1, 2]
    assert {written[n, 2] for n in (1, 2)} == {2}


def test_a_contact_is_located_from_both_states_in_every_cycle(served: Served) -> None:
    served.finger.touches = [(0.3, 0.35)]
    found = served.updates(60)[10:]
    valid = [contact for contact in found if contact.position_status == "valid"]
    assert len(valid) > 0.8 * len(found)  # a press begins and ends between two states
    assert max(off_mm(contact, (0.3, 0.35)) for contact in valid) < 0.5
    assert np.median([off_mm(contact, (0.3, 0.35)) for contact in valid]) < 0.1
    assert len({contact.t_ns for contact in found}) == len(found)

    def step_ms() -> float:
        return float(np.median(np.diff([contact.t_ns for contact in served.updates(50)]))) * 1e-6

    served.wait("in every cycle", lambda: 15 < step_ms() < 25)  # a busy machine is slower for a while


def test_two_contacts_are_published_as_parts(served: Served) -> None:
    served.finger.touches = [(0.2, 0.3), (0.75, 0.7)]
    pairs = [contact for contact in served.updates(60)[20:] if contact.parts]
    assert len(pairs) > 10
    at = np.array([np.array(part["position_m"])[:2] * 1e3 / [24, 18] + 0.5 for part in pairs[-1].parts])
    np.testing.assert_allclose(at[np.argsort(at[:, 0])], [[0.2, 0.3], [0.75, 0.7]], atol=0.06)


def test_lost_states_and_a_reboot_leave_no_wrong_sample(served: Served) -> None:
    served.finger.touches = [(0.6, 0.4)]
    served.updates(40)
    first = len(served.contacts)
    node = served.finger.devices[0]
    node.line = LineFaults(lost=0.3, data_only=True)
    served.updates(20)
    node.line = None
    node.reboot()
    served.updates(40)
    found = [
        contact
        for contact in served.contacts[first:]
        if contact.event == "update" and contact.position_status == "valid"
    ]
    assert max(off_mm(contact, (0.6, 0.4)) for contact in found) < 0.5


def test_gains_of_shared_channels_are_not_learned(served: Served) -> None:
    def reported() -> str | None:
        texts = [h.calibration_progress for h in list(served.health) if h.link == "tip"]
        return texts[-1] if texts and "switch_states" in texts[-1] else None

    assert "gains aren't learned" in served.wait("reported", reported)


def test_a_recording_of_a_switched_pad_is_replayed_bit_for_bit(rig: Any) -> None:
    settings = rig.config.read_text().partition("[[bus]]")[0]
    rig.config.write_text(
        settings + "[[bus]]" + shipped.path("switched.toml").read_text().partition("[[bus]]")[2]
    )
    rig.scenario.write_text(
        'repeat = true\npause_s = 0.5\n[[touch]]\nlink = "tip"\nfrom_s = 1.0\nduration_s = 2.0\n'
        "path = [[0.3, 0.4], [0.5, 0.5]]\nforce_n = [1.0]\n"
    )
    rig.simulate()
    rig.start("run")
    rig.wait_operational(2)
    with rig.recording() as out:
        rig.wait("touched twice", lambda status: status["service"]["contacts"] >= 2)
    outcome = rig.replay(out)
    assert outcome["equal"] == outcome["compared"] > 20
    contacts = [entry.payload for entry in Recording(out).read("contact")]
    assert any(contact.get("position_status") == "valid" for contact in contacts)
