"""The slow half of the supervisor: what can wait seconds is worked out here, in a process of its own.

Public: `SlowHalf`: messages of the daemon in, words for it out (`link`). It calibrates the units by their
contacts, keeps calibrations and baselines in the store, and says what is wrong. Pure but for the store.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from handtouch.field.network import ElectrodeNetwork
from handtouch.hand import network_of
from handtouch.supervise import archive as archives
from handtouch.supervise.archive import Archive
from handtouch.supervise.calibration import Four, Gains, Provenance, Version, four, matrix
from handtouch.supervise.link import (
    Alive,
    Block,
    Calibrate,
    ContactLaw,
    Finding,
    Judged,
    Start,
    Word,
    read_block,
)
from handtouch.supervise.places import Places
from handtouch.supervise.unit import Trust, Unit
from handtouch.supervise.upkeep import Upkeep, back_force

_log = logging.getLogger("handtouch.supervise")
_ALIVE_NS = 500_000_000
_LOOK_NS = 2_000_000_000
"""Time between two looks whether others have stored anything."""
_MOST_FINDINGS = 8


class Diagnosing(Protocol):
    """Who says what is the matter with pads: `diagnoses.Diagnoses`."""

    def take(self, block: Block) -> Sequence[tuple[int, Finding]]:
        """All that lasts, by pad."""

    def tare(self, pad: int, offset_counts: ArrayLike) -> None:
        """What the channels (4,) of a pad read untouched, as stored."""

    def calibrate(self, pad: int, gains: Four) -> None:
        """The unit in the place of a pad has other gains than the one before, or is known better."""


@dataclass
class _Row:
    """One pad's place."""

    place: archives.Place
    unit: Unit
    places: Places
    version: int = 0
    """number of the newest that is stored of the unit, 0 for none"""
    refused: str = ""
    """why a stored calibration isn't applied"""
    foreign: str = ""
    """whose calibration it has, if another unit's"""
    told: Judged | None = None


class SlowHalf:
    """Takes what the daemon sends, block after block; `take` gives what is to be said to it."""

    def __init__(self, start: Start, archive: Archive, diagnoses: Diagnosing | None = None) -> None:
        deployment = start.deployment
        entries = [(hand.name, pad) for hand in deployment.hands for pad in hand.pads]
        models: dict[object, ElectrodeNetwork] = {}
        self._rows = []
        noise = start.noise_counts[:, None] * start.ampere_per_count
        for number, (hand, pad) in enumerate(entries):
            make = (pad.surface, pad.gap_mm, pad.series_ohm, pad.sheet)
            if make not in models:
                models[make] = network_of(pad, deployment.sheets[pad.sheet])
            place = archives.Place(hand, pad.link, start.nominal[number])
            self._rows.append(_Row(place, Unit(models[make]), Places(noise[number])))
        self._ampere_per_count = start.ampere_per_count
        self._archive, self._diagnoses = archive, diagnoses
        self._upkeep = Upkeep(len(entries))
        self._found: dict[int, list[Finding]] = {}
        self._block: Block | None = None
        self._t_ns = self._alive_ns = self._looked_ns = 0

    def take(self, message: dict[str, Any], now: datetime) -> list[Word]:
        """What follows from a message of the daemon's."""
        words: list[Word] = []
        if message["kind"] == "serials":
            self._t_ns = max(self._t_ns, message["t_ns"])
            self._enter(message["serials"], message["before"], now, words)
        elif message["kind"] == "block":
            self._work(read_block(message, len(self._rows)), now, words)
        elif message["kind"] == "put":
            self._put(Calibrate.model_validate(message["word"]), message["given"], words)
        self._look(now, words)
        for pad in range(len(self._rows)):
            self._tell(pad, words)
        if self._t_ns - self._alive_ns >= _ALIVE_NS:
            self._alive_ns = self._t_ns
            words.append(Alive(t_ns=self._t_ns, store=self._archive.trouble[:1000], word=self._summary()))
        return words

    def finish(self, now: datetime) -> None:
        """The daemon is gone or wants no more: keep what isn't kept yet."""
        for pad, row in enumerate(self._rows):
            self._keep_state(pad, row, now, last=True)
        self._archive.close()

    # Units ------------------------------------------------------------------------------------------------

    def _enter(
        self,
        serials: Sequence[int | None],
        before: Sequence[int | None],
        now: datetime,
        words: list[Word],
    ) -> None:
        """Take note of who is where; a unit that is new in its place gets what is stored of it."""
        shared = Counter(serials)
        for pad, (row, serial) in enumerate(zip(self._rows, serials, strict=True)):
            obstacle = _obstacle(serial, shared)
            if serial is None or (serial == row.unit.serial and row.unit.learns == (not obstacle)):
                continue
            last = before[pad] or self._archive.last_in(row.place, now)
            version = None
            if not obstacle:
                version, row.refused = self._archive.own(serial, row.place, now)
            own = archives.grown_old(version, now) if version else None
            row.version, row.foreign = 0, version.provenance.foreign if version else ""
            row.unit.enter(serial, last, own, obstacle, self._t_ns, foreign=bool(row.foreign))
            self._upkeep.forget(pad)
            if self._diagnoses is not None:
                self._diagnoses.calibrate(pad, row.unit.gains.factors)
            name = f"{row.place.hand}/{row.place.link}"
            _log.info(
                "%s: unit %d is %s%s", name, serial, row.unit.trust,
                f", by version {version.number} of {version.written_utc}" if version else "",
            )  # fmt: skip
            if version is not None:
                words.append(self._recall(pad, version, now))

    def _look(self, now: datetime, words: list[Word]) -> None:
        """Take over what others have stored meanwhile: a guided session, a rollback, an import."""
        if self._t_ns - self._looked_ns < _LOOK_NS:
            return
        self._looked_ns = self._t_ns
        if not self._archive.changed(now):
            return
        for pad, row in enumerate(self._rows):
            if row.unit.serial is None or not row.unit.learns:
                continue
            version, row.refused = self._archive.own(row.unit.serial, row.place, now)
            if version is None or version.number == row.version:
                continue
            row.foreign = version.provenance.foreign
            if own := archives.grown_old(version, now):
                row.unit.adopt(own, foreign=bool(row.foreign))
            elif version.calibration.law and row.unit.doubted:
                row.unit.weigh()
            else:
                row.unit.forget()
            if self._diagnoses is not None:
                self._diagnoses.calibrate(pad, row.unit.gains.factors)
            words.append(self._recall(pad, version, now))
            _log.info("%s/%s: %s was stored by others: taken", row.place.hand, row.place.link, version.name)

    def _put(self, word: Calibrate, given: Sequence[str], words: list[Word]) -> None:
        """Go on from what a person put in force; and say it again, as what is stored may have undone it."""
        row = self._rows[word.pad]
        if word.serial != row.unit.serial:
            return
        if "gains" in given:
            row.foreign = ""
            row.unit.adopt(Gains(word.gains, matrix(np.reshape(word.covariance, (4, 4)))))
        if "law" in given:
            row.unit.weigh()
        if self._diagnoses is not None:
            if "gains" in given:
                self._diagnoses.calibrate(word.pad, word.gains)
            if word.offset_counts is not None:
                self._diagnoses.tare(word.pad, word.offset_counts)
        if {"gains", "law"} & {*given}:
            words.append(word)

    def _work(self, block: Block, now: datetime, words: list[Word]) -> None:
        self._t_ns = int(block.t_ns[-1])
        self._block = block
        self._find(block)
        self._upkeep.take(block)
        for pad in np.flatnonzero(block.contact.any(axis=0)).tolist():
            self._learn(pad, block, now, words)
        for pad, row in enumerate(self._rows):
            self._keep_state(pad, row, now)

    def _learn(self, pad: int, block: Block, now: datetime, words: list[Word]) -> None:
        """Give the contacts of a pad to its unit, and do what follows."""
        row = self._rows[pad]
        if not row.unit.learns or pad in self._found:  # what is wrong with a pad is nothing to learn from
            return
        fresh = block.fresh[:, pad]
        currents = (block.counts[:, pad] - block.offset_counts[pad]) * self._ampere_per_count[pad]
        for t_ns, contact, reading in zip(
            block.t_ns[fresh].tolist(), block.contact[fresh, pad].tolist(), currents[fresh], strict=True
        ):
            place = row.places.take(contact, reading, t_ns)
            if place is None:
                continue
            outcome = row.unit.add(place)
            version = self._keep_gains(row, now) if outcome.store else None
            if outcome.apply:
                assert row.unit.serial is not None
                name = version.name if version else f"{row.unit.serial}-learning"
                words.append(_calibrate(pad, row.unit.serial, name, row.unit.gains))
                if self._diagnoses is not None:
                    self._diagnoses.calibrate(pad, row.unit.gains.factors)

    def _keep_gains(self, row: _Row, now: datetime) -> Version | None:
        estimate, serial = row.unit.estimate, row.unit.serial
        assert serial is not None
        residual = estimate.misfit
        origin = Provenance("gains from contacts", contacts=estimate.contacts, residual=residual)
        version = self._kept(row, self._archive.keep(serial, row.place, origin, now, gains=row.unit.gains))
        where = f"{row.place.hand}/{row.place.link}"
        kept = f"kept as {version.name}" if version else "not kept"
        _log.info("%s: gains of unit %d from contacts, %s: %s", where, serial, kept, estimate.reason)
        return version

    def _keep_state(self, pad: int, row: _Row, now: datetime, last: bool = False) -> None:
        serial = row.unit.serial
        if serial is None or not row.unit.learns or row.unit.trust not in (Trust.NOMINAL, Trust.TRUSTED):
            return
        offsets, sheet = self._upkeep.due(pad, self._t_ns, last)
        if offsets is not None or sheet is not None:
            origin = Provenance("baseline and sheet followed")
            first = self._archive.own(serial, row.place, now)[0] is None
            version = self._kept(
                row, self._archive.keep(serial, row.place, origin, now, offsets=offsets, sheet=sheet)
            )
            if version is not None and first:
                self._tare(pad, version)

    @staticmethod
    def _kept(row: _Row, version: Version | None) -> Version | None:
        if version is not None:
            row.version, row.foreign = version.number, version.provenance.foreign
        return version

    def _tare(self, pad: int, version: Version) -> None:
        """From now on, what stands off the baseline of a version is something to explain."""
        if self._diagnoses is not None and version.calibration.offsets is not None:
            self._diagnoses.tare(pad, version.calibration.offsets.counts)

    def _recall(self, pad: int, version: Version, now: datetime) -> Calibrate:
        """All that is stored of the unit in a place."""
        known, row = version.calibration, self._rows[pad]
        row.version = version.number
        self._tare(pad, version)
        gains = row.unit.gains
        if not known.gains and row.unit.trust is Trust.NOMINAL:  # as in the file; nobody knows how sure
            gains = Gains((1.0,) * 4, matrix(np.zeros((4, 4))))
        word = _calibrate(pad, version.serial, version.name, gains)
        found: dict[str, Any] = {}
        if known.offsets:
            found["offset_counts"] = known.offsets.counts
            found["offset_std"] = four(np.sqrt(known.offsets.variance))
        if known.law:
            found["law"] = ContactLaw.model_validate(asdict(known.law))
        if back := back_force(version, archives.age_s(version, now)):
            found["back_n"], found["back_std_n"] = back
        return word.model_copy(update=found)

    # What is told -----------------------------------------------------------------------------------------

    def _find(self, block: Block) -> None:
        self._found = {}
        for pad, finding in self._diagnoses.take(block) if self._diagnoses else ():
            self._found.setdefault(pad, []).append(finding)

    def _tell(self, pad: int, words: list[Word]) -> None:
        """The judgement of a pad, if it changed."""
        row = self._rows[pad]
        calibrating = row.unit.calibrating
        if row.refused:
            calibrating = f"{row.refused}; {calibrating}"
        judged = Judged(
            pad=pad,
            serial=row.unit.serial,
            trust=row.unit.trust.value,
            calibrating=calibrating[:1000],
            findings=(*row.unit.findings, *self._of_store(row), *self._found.get(pad, ()))[:_MOST_FINDINGS],
        )
        if row.unit.serial is not None and judged != row.told:
            row.told = judged
            words.append(judged)

    def _of_store(self, row: _Row) -> tuple[Finding, ...]:
        """That its calibration is another unit's; what a pad lacks while the store is in trouble."""
        if row.foreign:
            return (
                Finding(
                    kind="foreign calibration",
                    cause="a calibration is applied that isn't this unit's own, as somebody took it over",
                    evidence=row.foreign[:1000],
                    remedy="`handtouch calibrations rollback` goes back, `handtouch calibrate` measures it",
                    since_ns=row.unit.since_ns,
                ),
            )
        if not self._archive.trouble or row.unit.trust is Trust.TRUSTED or not row.unit.learns:
            return ()
        return (
            Finding(
                kind="store lost",
                cause="what was known of this unit can't be read",
                evidence=self._archive.trouble[:1000],
                remedy="see to the store; until then it is as the deployment file says, and learns anew",
                since_ns=row.unit.since_ns,
            ),
        )

    def _summary(self) -> str:
        counts = Counter(row.unit.trust.value for row in self._rows if row.unit.serial is not None)
        return ", ".join(f"{count} {trust}" for trust, count in sorted(counts.items())) or "no units yet"


def _calibrate(pad: int, serial: int, name: str, gains: Gains) -> Calibrate:
    covariance = tuple(value for row in gains.covariance for value in row)
    return Calibrate(pad=pad, serial=serial, name=name, gains=gains.factors, covariance=covariance)


def _obstacle(serial: int | None, shared: Counter[int | None]) -> str:
    """Why nothing can be kept for a unit; empty if it can."""
    if not serial:
        return "nothing can be learnt of it: its node tells no serial number (object 0x1018 sub 4)"
    if shared[serial] > 1:
        return (
            f"nothing can be learnt of it: {shared[serial]} nodes tell the serial number {serial}; give each "
            "its own"
        )
    return ""
