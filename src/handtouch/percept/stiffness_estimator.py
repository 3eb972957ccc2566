"""Percept `stiffness`: how hard what a pad with two sheets touches is, by force and contact radius.

Under a round tip of radius R a contact has the radius a, a^3 = 3 F R / (4 E), with E the contact modulus:
1 / E is the sum of (1 - nu^2) / (Young's modulus) of the object and of the skin (Hertz; Johnson, *Contact
Mechanics*, eq. 4.22 to 4.24). So E / R = 3 F / (4 a^3), at each force alike; under a flat object the radius
doesn't grow with the force, and there is no such number.

The published radius is drawn towards what the pad's table expects; here that is taken back, so that the
estimate is by the two currents alone. With s the part of the table's variance that the currents removed, they
alone say ln a = expected + (published - expected) / s, with the variance published / s.

Public names: `StiffnessEstimator`, `ExpectedRadius`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from handtouch.arrays import IntArray
from handtouch.field import ContactLaw
from handtouch.percept.estimator import PerceptEstimator
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate

_MIN_GROWTH = 3.0
"""Greatest over least force of a contact: the radius then grows by 1.44 under a round tip, and not at all
under a flat object"""
_ROUND_EXPONENT = 1 / 3
"""Of radius by force under a round tip; 0 under a flat object"""
_EXPONENT_SIGMA = 2.0
"""Standard deviations from which on the one or the other is excluded"""
_MIN_SHARE = 0.2
"""Least part of the table's variance that the currents remove: below it errors are five times those of the
published radius"""
_ONE_SHEET = "the pad has one sheet: a second one measures the contact's radius (second_sheet)"
_NO_RADIUS = "no radius by both sheets: contact_radius_status of contact has the reason"
_NO_GROWTH = f"the force must change {_MIN_GROWTH:g}-fold during a contact"
_FLAT = "the radius doesn't grow with the force as under a round object"
_OPEN = (
    "the laws of both sheets aren't known well enough to tell a round object from a flat one: calibrate them"
)


class ExpectedRadius(NamedTuple):
    """What the tables of a pad's two sheets say of the radii of contacts.

    law: of the first sheet. exponent_std: standard deviation of the exponent of radius by force, by the
    errors of both alphas: hypot of those, each over its alpha, over 2 / (lesser alpha) - 2 / (greater one).
    """

    law: ContactLaw
    exponent_std: float


class _Press:
    """Sums over the samples of one contact, each weighted by the inverse variance of its ln(E / R)."""

    def __init__(self, contact: int) -> None:
        self.contact, self.samples = contact, 0
        self.least_n, self.greatest_n = math.inf, 0.0
        self.weight = self.of_modulus = self.of_std = 0.0
        self.of_force = self.of_radius = self.of_force2 = self.of_product = 0.0

    def add(self, force_n: float, log_radius: float, log_modulus: float, std: float) -> None:
        log_force, weight = math.log(force_n), std**-2
        self.samples += 1
        self.least_n, self.greatest_n = min(self.least_n, force_n), max(self.greatest_n, force_n)
        self.weight += weight
        self.of_modulus += weight * log_modulus
        self.of_std += weight * std
        self.of_force += weight * log_force
        self.of_radius += weight * log_radius
        self.of_force2 += weight * log_force * log_force
        self.of_product += weight * log_force * log_radius

    @property
    def growth(self) -> float:
        """Greatest over least force so far; 0 without samples."""
        return self.greatest_n / self.least_n

    @property
    def exponent(self) -> float:
        """Slope of ln radius by ln force."""
        mean = self.of_force / self.weight
        return (self.of_product - mean * self.of_radius) / (self.of_force2 - mean * self.of_force)


class StiffnessEstimator(PerceptEstimator):
    """Estimates the contact modulus over the tip's radius under each of n pads.

    expected: (n,) radii on the pads; None for pads of one sheet.
    """

    kind = "stiffness"

    def __init__(self, expected: Sequence[ExpectedRadius | None]) -> None:
        super().__init__(len(expected))
        self._expected = list(expected)
        self._contacts: dict[int, _Press] = {}

    def process_samples(self, buffer: ContactBuffer, sample: ContactSamples) -> Sequence[PerceptEstimate]:
        """Process a tick's samples of requested pads; return an estimate of each."""
        columns = zip(
            sample.pads.tolist(),
            sample.contact_id.tolist(),
            sample.sample_ns.tolist(),
            sample["force_n"].tolist(),
            sample["force_std_n"].tolist(),
            sample["contact_radius_m"].tolist(),
            sample["contact_radius_std_m"].tolist(),
            strict=True,
        )
        found = []
        for pad, number, t_ns, *values in columns:
            contact = self._contacts.get(pad)
            if contact is None or contact.contact != number:
                contact = self._contacts[pad] = _Press(number)
            if (expected := self._expected[pad]) is not None:
                _add_sample(contact, expected.law, *values)
            reason = _ONE_SHEET if expected is None else _missing(contact, expected.exponent_std)
            found.append(_estimate(contact, int(buffer.hand_index[pad]), pad, t_ns, reason))
        return found

    def end_contacts(self, buffer: ContactBuffer, pads: IntArray) -> None:  # noqa: ARG002
        """Forget the contacts that ended."""
        for pad in pads.tolist():
            self._contacts.pop(pad, None)


def _add_sample(
    contact: _Press, law: ContactLaw, force_n: float, force_std_n: float, radius_m: float, std_m: float
) -> None:
    """Add a sample, unless force or radius aren't known, or the currents say too little about the radius."""
    if not (force_n > 0 and radius_m > 0 and math.isfinite(force_std_n + std_m)):
        return
    expected_m = float(law.radius(force_n))
    expected2 = math.log1p(float(np.divide(law.radius_std_m, law.radius_m)) ** 2)
    published2 = math.log1p((std_m / radius_m) ** 2)
    share = 1.0 - published2 / expected2 if expected2 > 0 else 0.0
    if share < _MIN_SHARE:
        return
    log_radius = math.log(expected_m) + math.log(radius_m / expected_m) / share
    # an error of the second law moves force and radius apart: the errors add
    std = force_std_n / force_n + 3.0 * math.sqrt(published2 / share)
    contact.add(force_n, log_radius, math.log(0.75 * force_n) - 3.0 * log_radius, std)


def _missing(contact: _Press, exponent_std: float) -> str:
    """Return why there is no estimate of a contact so far; empty if there is one."""
    if not contact.samples:
        return _NO_RADIUS
    if contact.growth < _MIN_GROWTH:
        return f"{_NO_GROWTH}; so far {contact.growth:.2g}-fold"
    spread = _EXPONENT_SIGMA * exponent_std
    may_be_flat, may_be_round = contact.exponent < spread, contact.exponent > _ROUND_EXPONENT - spread
    return "" if not may_be_flat else _OPEN if may_be_round else _FLAT


def _estimate(contact: _Press, hand: int, pad: int, t_ns: int, reason: str) -> PerceptEstimate:
    state = "invalid" if reason == _FLAT else "undetermined" if reason else "estimated"
    values = {}
    if state == "estimated":
        values = {
            "modulus_per_radius_pa_per_m": math.exp(contact.of_modulus / contact.weight),
            "modulus_per_radius_log_std": contact.of_std / contact.weight,
            "growth_exponent": contact.exponent,
        }
    evidence = {"samples": contact.samples}
    return PerceptEstimate(
        "stiffness", hand, pad, contact.contact, t_ns, state, values=values, evidence=evidence, reason=reason
    )
