"""The unit in one pad's place: what is known of its gains, how far it is trusted, what there is to say of it.

Public: `Unit`, `Trust`, `Outcome`. A unit that replaced another is in quarantine until its own calibration is
there: from the store, from ordinary contacts, or from a person. Pure; time is an argument.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from handtouch.field.model import ForwardModel
from handtouch.supervise.calibration import LEAST_GAIN, MOST_GAIN, Gains, four, matrix
from handtouch.supervise.gains import BATCH, HOPELESS, GainEstimator, GainStatus
from handtouch.supervise.link import Finding
from handtouch.supervise.places import Place

FloatArray = NDArray[np.float64]
_TOLERANCES = (0.05, 0.2)
"""Standard deviation of log gains that a unit begins with; where it explains nothing, the next one."""
_AT_ONCE = BATCH // 2
"""Places that are given to the estimator together: one by one they take several times as long."""
_FIRST_AGAIN = 4 * BATCH
"""Contacts after which the gains of a unit that was known are stored anew; then twice as many each time."""
_WANTED = 0.02
"""Standard deviation of the least certain log gain that is good enough to be trusted. It is that of a
direction which hardly moves a place: by 0.3 to 0.5 % of the pad's length, rms, from 1:1 to 2:1."""
_CALIBRATE = "`handtouch calibrate` measures them with a person's help"


class Trust(StrEnum):
    """How far a unit's calibration is relied upon."""

    NOMINAL = "nominal"
    """the deployment file's word is all there is, and nothing speaks against it"""
    TRUSTED = "trusted"
    """its own calibration is applied"""
    QUARANTINED = "quarantined"
    """another unit than the one before, or one that changed: no calibration of it is there yet"""
    PERSON = "person"
    """the same, and it can't be calibrated by itself"""


@dataclass(frozen=True)
class Outcome:
    """What follows from contacts. apply: the gains are to be used; store: they are also to be kept."""

    apply: bool = False
    store: bool = False


class Unit:
    """One pad's place and the unit in it; `model` is the pad's."""

    def __init__(self, model: ForwardModel) -> None:
        self._model = model
        self.serial: int | None = None
        self.trust = Trust.NOMINAL
        self.learns = False
        """contacts of this unit tell anything that can be kept"""
        self._why = ""
        self._swap: tuple[str, str] = ("", "")  # kind and cause of the quarantine
        self._waiting: list[Place] = []
        self.since_ns, self._attempt, self._store_at = 0, 0, 0
        self._known = False  # the estimate began from gains of its own
        self._common = 1.0  # their geometric mean, which contacts can't tell
        self._estimator = GainEstimator(model)
        self.estimate = self._estimator.estimate

    def enter(
        self,
        serial: int,
        before: int | None,
        own: Gains | None,
        obstacle: str,
        t_ns: int,
        *,
        foreign: bool = False,
    ) -> None:
        """A unit is in this place from now on.

        before: serial number of the one that was here, None if nobody knows. own: its stored gains. obstacle:
        why nothing can be kept for it; empty if it can. foreign: what is stored was taken over from another.
        """
        self.serial, self.learns, self._why = serial, not obstacle, obstacle
        self.since_ns = t_ns
        swapped = before is not None and before != serial
        self._swap = "swapped unit", f"another unit: serial {before} was here, {serial} is"
        self._begin(0, own)
        self.trust = Trust.TRUSTED if own else Trust.QUARANTINED if swapped else Trust.NOMINAL
        if foreign:
            self.trust = Trust.NOMINAL
        self._ask_a_person_where_hopeless()

    def adopt(self, own: Gains, *, foreign: bool = False) -> None:
        """Go on from these gains: a person gave them, or went back to them."""
        self._begin(0, own)
        self.trust = Trust.NOMINAL if foreign else Trust.TRUSTED

    def weigh(self) -> None:
        """Its contact law was measured: that is what forces need, whatever isn't known of the gains."""
        if self.doubted:
            self.trust = Trust.TRUSTED

    def forget(self) -> None:
        """Go on from the deployment file's word; one that is doubted goes on learning."""
        if not self.doubted:
            self._begin(0)
            self.trust = Trust.NOMINAL

    def add(self, place: Place) -> Outcome:
        """Take a place that was touched; what follows."""
        if not self.learns or self._estimator.shape_deviation > HOPELESS:
            return Outcome()
        self._waiting.append(place)
        if len(self._waiting) < _AT_ONCE:
            return Outcome()
        waiting, self._waiting = self._waiting, []
        before = self.estimate.contacts
        currents = np.transpose([waiter.currents for waiter in waiting])
        self._estimator.add(currents, np.transpose([waiter.noise for waiter in waiting]), place.t_ns)
        self.estimate = self._estimator.estimate
        if self.estimate.contacts == before:
            return Outcome()
        self._bound()
        return self._judge(place.t_ns)

    @property
    def doubted(self) -> bool:
        """Whether its forces can't be relied upon."""
        return self.trust in (Trust.QUARANTINED, Trust.PERSON)

    @property
    def gains(self) -> Gains:
        """The gains as contacts, and what was stored, tell them."""
        return Gains(four(self._common * self.estimate.gains), matrix(self.estimate.covariance))

    @property
    def calibrating(self) -> str:
        """How far its calibration by itself is, in words."""
        if self._why:
            return self._why
        if self.serial is None:
            return ""
        if self.trust is Trust.TRUSTED and self._known and not self.estimate.contacts:
            return f"gains given or stored, known to {100 * self.estimate.std:.2g} %; contacts refine them"
        return f"gains {self.estimate.status}: {self.estimate.reason}"

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What there is to say of it: why it is not trusted, and what helps."""
        if not self.doubted:
            return ()
        kind, cause = self._swap
        if self.trust is Trust.PERSON:
            reason = self._why or self.estimate.reason
            remedy = f"it can't be calibrated by contacts: {_CALIBRATE}"
        else:
            reason = self.estimate.reason
            remedy = (
                "it calibrates itself by ordinary contacts: touch the pad all over with different forces; "
                "until then its forces are invalid, and its places less certain"
            )
        evidence = f"no calibration of its own is stored; {reason}"
        since_ns = self.since_ns
        return (
            Finding(
                kind=kind, cause=cause, evidence=evidence, remedy=remedy, since_ns=since_ns, strength=False
            ),
        )

    def _bound(self) -> None:
        """Contacts that are none can lead an estimate anywhere."""
        least, most = (self._common * limit(self.estimate.gains) for limit in (np.min, np.max))
        if least >= LEAST_GAIN and most <= MOST_GAIN:
            return
        reason = (
            f"gains from {least:.2g} to {most:.2g} would explain its contacts, and no amplifier has these "
            f"({LEAST_GAIN:g} to {MOST_GAIN:g} are taken): the pad isn't as configured, or is touched by "
            "several things at once"
        )
        self.estimate = replace(self.estimate, status=GainStatus.INVALID, reason=reason)

    def _judge(self, t_ns: int) -> Outcome:
        """A batch of contacts was taken."""
        status = self.estimate.status
        if status is GainStatus.INVALID:
            return self._doubt(t_ns)
        if status is GainStatus.UNESTIMATED:
            return Outcome(apply=self.trust in (Trust.QUARANTINED, Trust.PERSON))
        news = self.trust is not Trust.TRUSTED
        if not news and self.estimate.contacts < self._store_at:
            return Outcome()
        self._store_at = 2 * self.estimate.contacts
        self.trust = Trust.TRUSTED
        return Outcome(apply=True, store=True)

    def _doubt(self, t_ns: int) -> Outcome:
        """No gains near these explain the contacts."""
        reason = self.estimate.reason
        if self.trust in (Trust.TRUSTED, Trust.NOMINAL):
            self.trust, self.since_ns = Trust.QUARANTINED, t_ns
            self._swap = "changed gains", f"its gains aren't what they were: {reason}"
            self._begin(0)
        elif self._attempt + 1 < len(_TOLERANCES):
            self._begin(self._attempt + 1)
        else:
            self.trust = Trust.PERSON
            self._begin(0)  # it goes on trying
        self._ask_a_person_where_hopeless()
        return Outcome(apply=True)

    def _ask_a_person_where_hopeless(self) -> None:
        if self.trust is Trust.QUARANTINED and (self._estimator.shape_deviation > HOPELESS or self._why):
            self.trust = Trust.PERSON

    def _begin(self, attempt: int, own: Gains | None = None) -> None:
        self._attempt, self._waiting, self._known = attempt, [], own is not None
        start, covariance = (own.factors, own.covariance) if own else (None, None)
        self._common = math.exp(np.log(own.factors).mean()) if own else 1.0
        self._estimator = GainEstimator(
            self._model,
            tolerance=_TOLERANCES[attempt],
            wanted_std=_WANTED,
            start=start,
            covariance=covariance,
        )
        self.estimate = self._estimator.estimate
        self._store_at = _FIRST_AGAIN
