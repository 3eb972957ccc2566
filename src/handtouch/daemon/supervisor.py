"""The daemon's side of the slow half: sends it what comes in, and does between two ticks what it says.

Public name: `Supervisor`. Everything here is of the hot thread; the process is `process.Process`. A unit that
took another's place is put into quarantine here, at once, whether the slow half lives or not.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.nodes.master import Master, NodeEvent, NodeState, SerialChanged
from handtouch.config import Deployment
from handtouch.daemon.blocks import Blocks
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.process import Process
from handtouch.daemon.rest import Turns
from handtouch.supervise.calibration import Law, four
from handtouch.supervise.link import (
    Alive,
    Calibrate,
    ContactLaw,
    Finding,
    Judged,
    Start,
    Word,
    WordError,
    plain,
    put,
    read_word,
    serials,
)

_UNKNOWN_GAINS = 0.05**2 * (np.eye(4) - 0.25)
"""Covariance of log gains of a unit that nobody knows; their sum can't be seen."""
_GIVEN_GAINS = 0.01**2 * (np.eye(4) - 0.25)
"""The same of gains that a person gave: what measuring them by known currents leaves."""
_RESTS = (
    "rests without potential, for its sheet has got used to load and hides light touches; it feels nothing "
    "until another pad of the hand is touched, or its turn is over"
)
_KNOWN = (NodeState.CONFIGURING, NodeState.OPERATIONAL)
"""By then a node has told who it is."""
_NO_PLACE = 0.5**2 * (np.eye(4) - 0.25)
"""The same where a fault makes places worth nothing: they are stated to be anywhere on the pad, about."""
_log = logging.getLogger("handtouch.supervise")


class Supervisor:
    """Call `step` after every tick, and `note` with what happened to nodes. Times in ns.

    `judged`: of each pad, what the slow half said of it last, None before; `malformed`: its words that were
    no words, and those that came too late: for a unit that isn't there any more.
    """

    def __init__(
        self,
        deployment: Deployment,
        pipeline: Pipeline,
        master: Master,
        store: str,
        process: Process | None = None,
    ) -> None:
        self._pipeline, self._master = pipeline, master
        self._pads = [(hand.name, pad) for hand in deployment.hands for pad in hand.pads]
        self._store = store
        self._start = self._start_of(deployment)
        self.process = process or Process(lambda: self._start.dump())
        self.judged: list[Judged | None] = [None] * pipeline.model.size
        self.malformed = self.late = 0
        self.changed: set[int] = set()
        """pads that there is something new to tell of; whoever tells it clears it"""
        self.needed = np.ones(pipeline.model.size, dtype=np.bool_)
        """pads (n,) that a scene holds"""
        self.rested: Callable[[int], None] = lambda _: None
        """is called with the time when other pads rest, `turns.resting`"""
        rows = pipeline.model.rows_of_hand.values()
        self.turns = Turns(rows, pipeline.model.size, deployment.scene.rest_after_s)
        self._vague = np.zeros(pipeline.model.size, dtype=np.bool_)
        self._spoiling: list[tuple[str, ...]] = [()] * pipeline.model.size
        """of each pad, kinds of the findings that take something from its contacts"""
        self._covariance = np.zeros((pipeline.model.size, 4, 4))
        self._blocks = Blocks(pipeline.model.size)
        self._serials: list[int | None] = [None] * pipeline.model.size
        self._before: list[int | None] = [pad.serial for _, pad in self._pads]
        self._given: dict[int, set[str]] = {}
        """of pads whose calibration a person put in force: what of it"""
        self._awaited: dict[int, str] = {}
        """names of those that the slow half was told of and hasn't taken yet"""
        self._sent_ns = 0
        self._alive: Alive | None = None

    def start(self, now_ns: int) -> None:
        """Start the slow half."""
        self.process.start(now_ns)

    def adopt(self, deployment: Deployment, now_ns: int) -> None:
        """The file was read again: the slow half begins anew with it."""
        self._start = self._start_of(deployment)
        self.process.renew(now_ns)

    def close(self) -> None:
        """End the slow half."""
        self.process.close()

    def note(self, events: Sequence[NodeEvent | SerialChanged], now_ns: int) -> None:
        """Nodes have changed: see who is there now."""
        if not any(isinstance(event, SerialChanged) or event.new in _KNOWN for event in events):
            return
        swapped = [event for event in events if isinstance(event, SerialChanged)]
        known = [status.serial for status in self._master.status()]
        for event in swapped:
            if self._serials[event.slot] is None:
                self._serials[event.slot] = event.before
            if event.after is None:
                known[event.slot] = 0  # there is one, and it tells no number
        for pad, (before, after) in enumerate(zip(self._serials, known, strict=True)):
            if after is None or after == before:
                continue
            if before is not None:
                self._before[pad] = before
            self._serials[pad] = after
            self.judged[pad] = None
            if self._before[pad] is not None and self._before[pad] != after:
                self._quarantine(pad)
        self._introduce(now_ns)

    def put(self, pad: int, given: Collection[str]) -> None:
        """A person put gains, a law or offset_counts in force: the slow half goes on from them.

        It is told of gains and law again when it begins anew; they hold as long as the daemon lives and the
        unit is there, or until contacts tell the gains better.
        """
        if "gains" in given:
            self._covariance[pad] = _GIVEN_GAINS
            self._doubt(pad, bool(self._pipeline.model.quarantined[pad]))
        self._given[pad] = self._given.get(pad, set()) | set(given)
        self._tell_given(pad)
        self._given[pad].discard("offset_counts")  # the baseline goes on from there

    def step(self, now_ns: int) -> None:
        """After a tick: gather it; now and then send what was gathered and do what was said."""
        touching = self._pipeline.tick.contacts.touching
        if self.turns.due(now_ns, touching):
            self._rest(now_ns, touching)
        if self.process.pid is None:
            if self.process.step(now_ns):
                self._blocks.clear()
                self._alive = None
                self._introduce(now_ns)
            return
        block = self._blocks.add(self._pipeline)
        if block is None:
            return
        if self.process.send(block.dump()):
            self._sent_ns = int(block.t_ns[-1])
        for said in self.process.words(now_ns):
            self._take(said)
        self.process.step(now_ns)

    def figures(self) -> dict[str, Any]:
        """How the slow half fares, for `service`."""
        process, alive = self.process, self._alive
        return {
            "state": process.state,
            "pid": process.pid,
            "restarts": process.restarts,
            "died_of": process.why,
            "lag_s": (self._sent_ns - alive.t_ns) * 1e-9 if alive else None,
            "dropped": process.dropped,
            "malformed": self.malformed,
            "late": self.late,
            "word": alive.word if alive else "",
            "store": alive.store if alive else "",
        }

    def told(self, pad: int) -> dict[str, Any]:
        """What `health` says of a pad: trust, calibration, calibrating, findings."""
        judged = self.judged[pad]
        quarantined = bool(self._pipeline.model.quarantined[pad])
        name = self._pipeline.model.calibration[pad]
        rests = (self._resting(pad),) if self.turns.resting[pad] else ()
        if judged is None:
            trust = "quarantined" if quarantined else "nominal"
            return {"trust": trust, "calibration": name, "findings": rests}
        return {
            "trust": judged.trust,
            "calibration": name,
            "calibrating": judged.calibrating,
            "findings": (*rests, *map(plain, judged.findings)),
        }

    def _rest(self, now_ns: int, touching: NDArray[np.bool_]) -> None:
        """Let fading sheets rest, or wake them."""
        strength, turns = self._pipeline.tick.strength, self.turns
        before = turns.resting.copy()
        if not turns.step(now_ns, touching, self.needed, strength.back[0], self._pipeline.model.on_n):
            return
        for group in strength.groups.all:
            group.compensator.set_powered(~turns.resting[group.pads])
        for pad in np.flatnonzero(turns.resting != before).tolist():
            self._say(pad, _RESTS if turns.resting[pad] else "is awake again")
            self.changed.add(pad)
        self.rested(now_ns)

    # Details ----------------------------------------------------------------------------------------------

    def _start_of(self, deployment: Deployment) -> Start:
        model = self._pipeline.model
        scale = np.array(model.ampere_per_count / model.gains)
        return Start(deployment, self._store, tuple(model.nominal), scale, model.noise_counts)

    def _introduce(self, now_ns: int) -> None:
        self.process.send(serials(self._serials, self._before, now_ns))
        for pad in self._given:
            self._tell_given(pad)

    def _tell_given(self, pad: int) -> None:
        model, serial, given = self._pipeline.model, self._serials[pad], self._given[pad]
        if serial is None or not given:
            return
        law, offsets = model.laws[pad], self._pipeline.tick.baseline.expected[pad]
        word = Calibrate(
            pad=pad,
            serial=serial,
            name=model.calibration[pad],
            gains=four(model.gains[pad]),
            covariance=tuple(self._covariance[pad].ravel().tolist()),
            offset_counts=four(offsets) if "offset_counts" in given else None,
            law=ContactLaw(**asdict(law)) if law is not None and "law" in given else None,
        )
        if {"gains", "law"} & given:  # it says those again
            self._awaited[pad] = word.name
        self.process.send(put(word, sorted(given)))

    def _quarantine(self, pad: int) -> None:
        """Another unit: nothing that was known of the one before holds."""
        model = self._pipeline.model
        model.calibrate(pad, np.ones(4), model.nominal[pad])
        self._covariance[pad] = _UNKNOWN_GAINS
        self._given.pop(pad, None)
        self._awaited.pop(pad, None)
        self._vague[pad], self._spoiling[pad] = False, ("swapped unit",)
        self._doubt(pad, quarantined=True)
        self._pipeline.adopt(model, np.array([pad]))
        self._pipeline.tick.renew(pad)
        self.changed.add(pad)
        _log.warning(
            "%s: serial %s was here, %s is: in quarantine until it is calibrated",
            self._name(pad), self._before[pad], self._serials[pad], extra=self._fields(pad),
        )  # fmt: skip

    def _doubt(self, pad: int, quarantined: bool) -> None:
        covariance = _NO_PLACE if self._vague[pad] else self._covariance[pad]
        vague, spoiling = bool(self._vague[pad]), self._spoiling[pad]
        self._pipeline.model.doubt(pad, covariance, quarantined, vague, spoiling)

    def _take(self, said: bytes) -> None:
        """Do what a word says: all of it or nothing."""
        try:
            word = read_word(said)
        except WordError as error:
            self.malformed += 1
            _log.warning("%s", error)
            return
        if isinstance(word, Alive):
            self._alive = word
        elif word.pad >= len(self._pads):
            self.malformed += 1
        elif word.serial != self._serials[word.pad]:
            self.late += 1
        else:
            self._do(word)

    def _do(self, word: Word) -> None:
        if isinstance(word, Calibrate):
            self._calibrate(word)
        elif isinstance(word, Judged):
            self._judge(word)

    def _calibrate(self, word: Calibrate) -> None:
        model, pad = self._pipeline.model, word.pad
        offsets, tick, pads = word.offset_counts, self._pipeline.tick, np.array([pad])
        if offsets is not None and max(map(abs, offsets)) > model.largest_counts[pad] / 2:
            self.malformed += 1
            return
        if self._awaited.get(pad) == word.name:
            del self._awaited[pad]
        elif pad not in self._awaited:  # what is known by now goes before what was given
            self._given.pop(pad, None)
        law = model.laws[pad] if word.law is None else Law(**word.law.model_dump())
        reweighed = law != model.laws[pad]
        model.calibrate(pad, word.gains, word.name, law)
        self._covariance[pad] = np.reshape(word.covariance, (4, 4))
        self._doubt(pad, bool(model.quarantined[pad]))
        if reweighed:
            self._pipeline.adopt(model, pads)
        if offsets is not None:
            tick.assume(pad, offsets, word.offset_std or 0.0)
        if word.back_n is not None:
            tick.strength.assume(pad, word.back_n, word.back_std_n)
        tick.forget(pads)
        self.changed.add(pad)
        _log.info("%s: calibration %s", self._name(pad), word.name, extra=self._fields(pad))

    def _judge(self, word: Judged) -> None:
        model, pad, before = self._pipeline.model, word.pad, self.judged[word.pad]
        self.judged[pad] = word
        mute = word.trust in ("quarantined", "person") or not all(
            finding.strength for finding in word.findings
        )
        vague = not all(finding.location for finding in word.findings)
        spoiling = tuple(f.kind for f in word.findings if not (f.location and f.strength))
        if (mute, vague, spoiling) != (model.quarantined[pad], self._vague[pad], self._spoiling[pad]):
            self._vague[pad], self._spoiling[pad] = vague, spoiling
            self._doubt(pad, mute)
            self._pipeline.tick.forget(np.array([pad]))
        known = {finding.kind for finding in before.findings} if before else set()
        trust = before.trust if before else "nominal"
        for finding in word.findings:
            if finding.kind not in known:
                self._say(pad, f"{finding.cause} ({finding.evidence}): {finding.remedy}")
        for kind in sorted(known - {finding.kind for finding in word.findings}):
            self._say(pad, f"{kind}: over", logging.INFO)
        if word.trust != trust:
            level = logging.INFO if word.trust in ("nominal", "trusted") else logging.WARNING
            self._say(pad, f"{trust} -> {word.trust}: {word.calibrating}", level)
        if (trust, known) != (word.trust, {finding.kind for finding in word.findings}) or before is None:
            self.changed.add(pad)

    def _resting(self, pad: int) -> dict[str, Any]:
        back_n = float(self._pipeline.tick.strength.back[0][pad])
        finding = Finding(
            kind="fading sheet",
            cause="its sheet has got used to load",
            evidence=f"to {back_n:.2f} N, and a touch counts from {self._pipeline.model.on_n[pad]:.2f} N",
            remedy="it rests without potential and feels nothing: touch another pad of the hand to wake it",
            since_ns=self._pipeline.cycle.t_ns,
        )
        return plain(finding)

    def _say(self, pad: int, text: str, level: int = logging.WARNING) -> None:
        _log.log(level, "%s: %s", self._name(pad), text, extra=self._fields(pad))

    def _name(self, pad: int) -> str:
        return f"{self._pads[pad][0]}/{self._pads[pad][1].link}"

    def _fields(self, pad: int) -> dict[str, Any]:
        return {"fields": {"hand": self._pads[pad][0], "link": self._pads[pad][1].link}}
