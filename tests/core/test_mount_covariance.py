"""The covariance that a pad's mount adds to positions on its link."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import wire
from handtouch.config import parse
from handtouch.core.pipeline import run_tick
from handtouch.core.slab import Cycle, Slab
from handtouch.core.stages.publish import ContactEncoder
from handtouch.core.tick import TickProcessor
from handtouch.core.tick_messages import TickMessages
from handtouch.daemon.table_cache import build_pad_model
from handtouch.hand.pads import rotation_from_rpy
from tests.core.conftest import TOLERANT_DEPLOYMENT

PERIOD_NS = 5_000_000
STD_MM, STD_DEG = 0.4, 2.0
STATED = f"mount_std_mm = {STD_MM}\nmount_std_deg = {STD_DEG}\n"
UNSTATED = "mount_std_mm = 0.0\nmount_std_deg = 0.0\n"


def messages(stated: str) -> tuple[wire.Contact, dict[str, NDArray[Any]]]:
    """Return the message of a contact on the first pad, and the columns of the hand's frame."""
    model = build_pad_model(parse(TOLERANT_DEPLOYMENT.replace("[[hand]]\n", "[[hand]]\n" + stated)))
    slab, cycle, tick = Slab(model.size), Cycle(PERIOD_NS, 0.6), TickProcessor(model, PERIOD_NS)
    network = model.networks[0]
    counts = network.fractions(0.8 * network.a, 0.3 * network.b) * 1e-3 / model.ampere_per_count[0]
    for k in range(3):
        t_ns = 10**9 + k * PERIOD_NS
        slab.begin_cycle(t_ns)
        cycle.begin_cycle(t_ns)
        slab.write_pdo(0, np.rint(counts).astype("<i2").tobytes(), t_ns + 1000)
        run_tick(tick, slab, np.zeros(model.size, np.uint8), cycle)
    encoder = ContactEncoder(model, tick.state, tick.columns, tick.sheet_force.modelled, session=7)
    encoded = encoder.encode(0, "update", t_ns, t_ns, "", False)
    contact = wire.decode(wire.encode(encoded))
    assert isinstance(contact, wire.Contact)
    return contact, TickMessages(model, tick).frame_columns()


def test_the_covariance_on_the_link_includes_the_mount_and_states_it_apart() -> None:
    (contact, columns), (exact, exact_columns) = messages(STATED), messages(UNSTATED)
    assert contact.position_m == exact.position_m
    mount = np.reshape(contact.mount_covariance_m2 or (), (3, 3))
    total, pad = (np.reshape(one.covariance_m2 or (), (3, 3)) for one in (contact, exact))
    np.testing.assert_allclose(total, pad + mount, rtol=1e-12)
    assert exact.mount_covariance_m2 == (0.0,) * 9
    # as mounts with such errors move the point
    rng, origin = np.random.default_rng(5), np.array([0.010, 0.0, 0.005])  # of the pad on its link
    arm = np.array(contact.position_m) - origin
    turns = [rotation_from_rpy(np.radians(rng.normal(0, STD_DEG, 3))) @ arm for _ in range(20_000)]
    moved = np.array(turns) + rng.normal(0, STD_MM * 1e-3, (20_000, 3))
    np.testing.assert_allclose(np.cov(moved.T), mount, atol=0.05 * mount.max())
    for name, matrix in (("covariance_m2", total), ("mount_covariance_m2", mount)):
        np.testing.assert_allclose(columns[name][0].reshape(3, 3), matrix, rtol=1e-6)
    assert np.linalg.matrix_rank(exact_columns["covariance_m2"][0].reshape(3, 3), tol=1e-12) == 2


@pytest.mark.parametrize("name", ["covariance_m2", "mount_covariance_m2"])
def test_a_pad_without_contact_has_no_covariance(name: str) -> None:
    _, columns = messages(STATED)
    assert np.isnan(columns[name][1:]).all()
