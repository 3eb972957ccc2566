"""Diagnosis of a pad of 60 x 20 mm, on which electrodes of the short sides get little of most contacts."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import TypeAdapter

from handtouch import config
from handtouch.config import shipped
from handtouch.config.surfaces import PadSurface
from handtouch.field.network import ElectrodeNetwork
from handtouch.supervisor.diagnose import DiagnosisModel
from handtouch.supervisor.diagnose.contact_faults import ContactFaultDetector
from handtouch.supervisor.diagnose.hypotheses import ContactCurrents, HypothesisTables
from handtouch.wire.faults import FaultKind
from tests.exact_pads import electrodes_of

Floats = NDArray[np.float64]
SIDES = ("x0", "xa", "y0", "yb")


@lru_cache(maxsize=1)
def long_pad() -> tuple[ElectrodeNetwork, HypothesisTables, Floats]:
    """Network, tables and covariance of the gains of a pad of the shipped hand, made 60 x 20 mm."""
    whole = config.load(shipped.path("utah_mit.toml"))
    (hand,) = whole.hands
    plane: Any = TypeAdapter(PadSurface).validate_python({"kind": "plane", "length_mm": 60, "width_mm": 20})
    pads = tuple(pad.model_copy(update={"surface": plane}) for pad in hand.pads)
    changed = whole.model_copy(update={"hands": (hand.model_copy(update={"pads": pads}),)})
    model = DiagnosisModel.from_deployment(changed, "right")
    network = electrodes_of(model)[13]
    tables = HypothesisTables(network, model.surfaces[13], model.parts[13](), model.electrodes[13])
    return network, tables, model.gain_covariance[13]


def positions(count: int) -> tuple[Floats, Floats]:
    network = long_pad()[0]
    x, y = np.random.default_rng(7).uniform(0.06, 0.94, (2, count))
    return x * network.a, y * network.b


def name_fault(shares: Floats, until: FaultKind | None = None) -> FaultKind | None:
    """Touch the pad with these shares (k, 4) of a contact's current; the kind of fault found at last.

    `until` : ends once that was found after six contacts in a row
    """
    _, tables, covariance = long_pad()
    detector, rng, alike = ContactFaultDetector(tables, covariance), np.random.default_rng(3), 0
    for number, share in enumerate(shares):
        currents = share * np.exp(rng.uniform(-7, -5)) + rng.normal(scale=5e-8, size=4)
        collected = np.maximum(currents, 1e-7)
        position = collected[[1, 3]] / (collected[[0, 2]] + collected[[1, 3]])
        contact = ContactCurrents(number * 10**9, currents, np.full(4, 5e-8), position)
        detector.add_contact(contact, np.zeros(4, dtype=np.bool_))
        alike = alike + 1 if detector.fault and detector.fault.kind == until else 0
        if alike == 6:
            break
    return detector.fault.kind if detector.fault else None


def test_tables_of_a_long_pad_have_the_currents_of_every_contact() -> None:
    """Between nodes too, within a part of the model's error."""
    network, tables, _ = long_pad()
    currents = network.fractions(*positions(200))
    found = tables.score(None, currents, np.full(currents.shape, 1e-6))
    assert np.abs(found.scores).max() < 1.0
    assert np.quantile(found.rest, 0.95) < 1.0


@pytest.mark.parametrize("channel", range(4))
def test_currents_of_a_long_pad_with_a_dead_electrode_have_a_position(channel: int) -> None:
    """Of nine contacts in ten, also where none of the currents tells much about it."""
    network, tables, _ = long_pad()
    kinds = [(h.kind, h.electrodes) for h in tables.hypotheses]
    dead = kinds.index((FaultKind.DEAD_ELECTRODE, (SIDES[channel],)))
    currents = network.with_open_electrode(channel).fractions(*positions(200))
    found = tables.score(dead, currents, np.full(currents.shape, 1e-6))
    assert np.mean(found.rest > 4) < 0.1
    assert np.mean(np.abs(found.scores) > 1) < 0.05


@pytest.mark.parametrize("channel", range(4))
def test_dead_electrode_of_a_long_pad_is_named(channel: int) -> None:
    shares = long_pad()[0].with_open_electrode(channel).fractions(*positions(40)).T
    assert name_fault(shares, FaultKind.DEAD_ELECTRODE) == FaultKind.DEAD_ELECTRODE


def test_healthy_long_pad_has_no_fault() -> None:
    assert name_fault(long_pad()[0].fractions(*positions(60)).T) is None


def test_healthy_long_pad_that_is_touched_at_one_end_has_no_dead_electrode() -> None:
    """The far electrode carries nothing there."""
    network = long_pad()[0]
    x, y = positions(60)
    assert name_fault(network.fractions(network.a - (network.a - x) / 4, y).T) is None


def test_swapped_cables_of_a_long_pad_are_no_dead_electrode() -> None:
    shares = long_pad()[0].fractions(*positions(60)).T
    assert name_fault(shares[:, [2, 1, 0, 3]], FaultKind.SWAPPED_CABLES) == FaultKind.SWAPPED_CABLES


@pytest.mark.parametrize("channel", [0, 3])
def test_gain_step_of_a_long_pad_is_no_torn_corner(channel: int) -> None:
    """Named, or reported with both causes; the other electrodes of short and long sides are their mirror."""
    shares = long_pad()[0].fractions(*positions(60)).T
    factors = np.where(np.arange(4) == channel, 0.4, 1.0)
    shares[25:] *= factors
    assert name_fault(shares) in (FaultKind.GAIN_STEP, FaultKind.UNEXPLAINED)


@pytest.mark.parametrize("channel", [1, 2, 3])
def test_dead_electrode_of_a_long_pad_that_is_touched_beside_it_is_named(channel: int) -> None:
    """The far electrode carries nothing, either; that is no evidence against it."""
    network = long_pad()[0]
    x, y = positions(60)
    shares = network.with_open_electrode(channel).fractions(network.a - (network.a - x) / 4, y).T
    assert name_fault(shares, FaultKind.DEAD_ELECTRODE) == FaultKind.DEAD_ELECTRODE
