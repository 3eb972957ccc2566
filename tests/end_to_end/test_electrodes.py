"""A daemon with nodes of three and six channels: contacts, tare, and a dead electrode among six."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import wire
from handtouch.canbus.bus.port import open_bus
from handtouch.cli.demo import in_process_deployment
from handtouch.client import request
from handtouch.config import Deployment, parse
from handtouch.config.channels import resolve_channels
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.device import DeviceBus
from handtouch.hand import pad_network, pad_surface
from tests.deployments import SIX_ARCS, THREE_ARCS, arcs_text

from .conftest import run_in_threads
from .served_daemon import MAX_WAIT_S, ServedDaemon

PRESS_SYNCS, REST_SYNCS = 20, 10
DEAD = 3
LINKS = ("three", "six")


def two_discs() -> Deployment:
    """Return a deployment of two discs, with three and with six electrodes."""
    whole, pads, nodes = parse(arcs_text(SIX_ARCS)), [], {}
    for node_id, (link, arcs) in enumerate(zip(LINKS, (THREE_ARCS, SIX_ARCS), strict=True), 1):
        one = parse(arcs_text(arcs))
        nodes[link] = one.nodes["arcs"]
        changes = {"link": link, "node": link, "node_id": node_id, "serial": 100 + node_id}
        pads.append(one.pads[1].pad.model_copy(update=changes))
    hands = (whole.hands[0].model_copy(update={"pads": tuple(pads)}),)
    made = in_process_deployment(whole.model_copy(update={"nodes": nodes, "hands": hands}))
    settings = {"supervise": True, "sync_period_ms": 10.0, "store": "calibrations.db"}
    return made.model_copy(update={"daemon": made.daemon.model_copy(update=settings)})


class Nodes:
    """Nodes of the two pads, pressed at another position again and again; a wire of the second may be
    broken."""

    def __init__(self, deployment: Deployment) -> None:
        self._pads = [entry.pad for entry in deployment.pads]
        self._whole = [pad_network(pad, deployment.sheets[pad.sheet]) for pad in self._pads]
        self._broken = self._whole[1].with_series_ohm([np.inf if k == DEAD else 0.0 for k in range(6)])
        self.is_pressed = self.is_broken = False
        self.positions: list[tuple[int, NDArray[np.float64]]] = [(0, np.full(2, 0.5))]
        """times of the first SYNCs of presses, and their positions as fractions of the rectangle"""
        self._syncs, self._rng = 0, np.random.default_rng(1)
        self.bus = DeviceBus(open_bus(deployment.buses[0]), self._sample)
        for pad in self._pads:
            node = deployment.nodes[pad.node]
            channels = tuple((c.index, c.sub) for c in resolve_channels(node.channels, node.eds))
            self.bus.add(pad.node_id, serial=pad.serial, channels=channels)

    def _sample(self, sync_ns: int) -> NDArray[np.int64]:
        self._syncs += 1
        phase = self._syncs % (PRESS_SYNCS + REST_SYNCS)
        if phase == 0:
            self.positions.append((sync_ns, self._rng.uniform(0.2, 0.8, 2)))
        counts = self._rng.normal(size=(2, 6))
        if self.is_pressed and phase < PRESS_SYNCS:
            networks = self._whole[0], self._broken if self.is_broken else self._whole[1]
            for row, network in enumerate(networks):
                shares = network.fractions(*(self.positions[-1][1] * (network.a, network.b)))
                counts[row, : len(shares)] += 6000 * shares
        return np.rint(counts).astype(np.int64)

    def error_mm(self, contact: wire.Contact) -> float:
        """Return the distance of a contact from the position that was pressed at its time."""
        row = LINKS.index(contact.link)
        network, surface = self._whole[row], pad_surface(self._pads[row])
        at = [position for since_ns, position in self.positions if since_ns < contact.t_ns][-1]
        assert contact.position_m is not None
        true = surface.point(*(at * (network.a, network.b)))
        return 1e3 * float(np.linalg.norm(np.subtract(contact.position_m, true)))


class Served(ServedDaemon):
    """The daemon with its nodes."""

    def __init__(self, daemon: HandtouchDaemon, nodes: Nodes) -> None:
        super().__init__(daemon)
        self.nodes = nodes

    def errors_mm(self, link: str, after_ns: int = 0) -> list[float] | None:
        """Return the errors of valid positions since then; None before there are fifty."""
        errors = [
            self.nodes.error_mm(contact)
            for contact in list(self.contacts)
            if contact.link == link and contact.event == "update" and contact.t_ns > after_ns
            and contact.position_status == "valid"
        ]  # fmt: skip
        return errors if len(errors) >= 50 else None


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    deployment = two_discs()
    nodes = Nodes(deployment)
    with HandtouchDaemon.open(deployment, folder=tmp_path_factory.mktemp("electrodes")) as daemon:
        nodes.bus.start()
        made = Served(daemon, nodes)
        with run_in_threads(daemon.run, made.listen):
            yield made
        nodes.bus.stop()


def test_a_pad_of_fewer_channels_than_another_is_tared(served: Served) -> None:
    endpoint = served.daemon.control.endpoint

    def tared() -> Any:
        answer = request("tare", endpoint=endpoint, key="", timeout_s=MAX_WAIT_S, pads=["*"])
        return answer if all(pad["tared"] for pad in answer["pads"]) else None

    answer = served.wait("tared", tared)
    assert [len(pad["offset_counts"]) for pad in answer["pads"]] == [3, 6]


def test_contacts_of_nodes_with_three_and_six_channels_are_located(served: Served) -> None:
    served.nodes.is_pressed = True
    for link in LINKS:
        errors_mm = served.wait("located", partial(served.errors_mm, link))
        assert np.median(errors_mm) < 0.1


def test_location_continues_without_a_dead_electrode(served: Served) -> None:
    served.nodes.is_pressed = served.nodes.is_broken = True

    def diagnosed() -> wire.Health | None:
        dead = (h for h in list(served.health) if any(f["kind"] == "dead_electrode" for f in h.diagnoses))
        return next(dead, None)

    health = served.wait("diagnosed", diagnosed)
    assert health.link == "six"
    (diagnosis,) = health.diagnoses
    assert "electrode d carries no current" in diagnosis["cause"]
    assert np.median(served.wait("located", lambda: served.errors_mm("six", health.t_ns + 10**9))) < 0.1
