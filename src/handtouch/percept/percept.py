"""Runs the parts that are wanted on a tick's samples, one slow fit at a time, and chooses what to ask.

Public names: `Perceiver`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.ask import Ask, Asker, Question
from handtouch.percept.stream import KINDS, IntArray, Part, Percept, Sample, Stream

_FIT_NS = 10_000_000
"""From one fit to the next, whatever the tick's period: a hundredth of a second's work each at most."""


class Perceiver:
    """Of n pads; `step` it after every tick. `parts` by kind; a part is run for its `wanted` pads alone."""

    def __init__(self, stream: Stream, parts: Sequence[Part]) -> None:
        self.stream = stream
        self.parts = list(parts)
        self.asker = Asker()
        self.asks = np.zeros(stream.size, dtype=np.bool_)
        """pads (n,) that questions may be asked of"""
        self.fits = 0
        """done so far"""
        self._fit_ns = 0
        self._next = 0  # part that is asked first what to fit

    def want(self, wanted: NDArray[np.bool_], asks: NDArray[np.bool_]) -> None:
        """Run each part for the pads of its row (kinds, n), rows as KINDS; ask about these pads (n,)."""
        changed = np.zeros(self.stream.size, dtype=np.bool_)
        for part in self.parts:
            pads = wanted[KINDS.index(part.kind)]
            changed |= pads != part.wanted
            part.wanted = pads.copy()
        self.stream.end(np.flatnonzero(changed))  # for every part a contact begins with its first sample
        self.asks = asks.copy()

    def step(self, sample: Sample, ended: IntArray, t_ns: int) -> tuple[list[Percept], list[Ask]]:
        """Take in a tick: samples of contacts, and pads (k,) whose contacts ended; time [ns] of the tick."""
        found: list[Percept] = []
        if len(ended):
            gone = ended[self.stream.contact[ended] > 0]
            for part in self.parts:
                if len(mine := gone[part.wanted[gone]]):
                    found += part.end(self.stream, mine, t_ns)
            self.stream.end(gone)
        if len(sample.pads):
            began = self.stream.add(sample)
            for part in self.parts:
                found += self._judge(part, sample, began)
        found += self._fit(t_ns)
        return found, self._ask(t_ns)

    def _judge(self, part: Part, sample: Sample, began: IntArray) -> Sequence[Percept]:
        mine = part.wanted[sample.pads]
        count = np.count_nonzero(mine)
        if not count:
            return ()
        if count < len(mine):
            some = Sample(sample.pads[mine], sample.t_ns[mine], sample.contact[mine])
            some.values = sample.values[mine]
            sample, began = some, began[part.wanted[began]]
        return part.step(self.stream, sample, began)

    def _fit(self, t_ns: int) -> Sequence[Percept]:
        """One fit at most: parts take turns."""
        if t_ns - self._fit_ns < _FIT_NS:
            return ()
        for number in range(len(self.parts)):
            part = self.parts[(self._next + number) % len(self.parts)]
            if part.wanted.any() and (pad := part.due(self.stream, t_ns)) is not None:
                self._next += number + 1
                self._fit_ns = t_ns
                self.fits += 1
                return part.fit(self.stream, pad, t_ns)
        return ()

    def _ask(self, t_ns: int) -> list[Ask]:
        if not self.asks.any() or not self.asker.due(t_ns):
            return []
        questions = [
            question
            for part in self.parts
            if part.wanted.any()
            for question in part.questions(t_ns)
            if self._may_ask(question)
        ]
        return self.asker.choose(questions, t_ns)

    def _may_ask(self, question: Question) -> bool:
        pads = self.stream.hand_of == question.hand if question.pad < 0 else question.pad
        return bool(np.any(self.asks[pads]))
